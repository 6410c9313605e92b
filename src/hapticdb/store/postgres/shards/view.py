"""What a reader knows of the coordinator: the revision, the borders, the live versions."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.store.base import NO_KEYS, Keys, Rows
from hapticdb.store.postgres.connecting import wire
from hapticdb.store.postgres.connecting.connection import ServerConnection

NEWEST = """
SELECT environment.revision, epoch, environment.tableoid::bigint FROM environment, distribution"""
# the lock tells those who sweep that somebody still reads this revision (`sweeping`)
HOLDING = """
SELECT environment.revision, epoch, environment.tableoid::bigint,
       pg_advisory_xact_lock_shared(
         (environment.tableoid::bigint << 32) | (environment.revision & 4294967295))
  FROM environment, distribution"""
LOAD = """
WITH changed AS MATERIALIZED (SELECT id, version FROM live WHERE revision > $1)
SELECT environment.revision, epoch, environment.tableoid::bigint,
       (SELECT array_agg(first_key ORDER BY number) FROM shard),
       (SELECT array_agg(writes ORDER BY number) FROM shard),
       (SELECT array_agg(id ORDER BY id) FROM changed),
       (SELECT array_agg(coalesce(version, -1) ORDER BY id) FROM changed)
  FROM environment, distribution"""


class LiveView(NamedTuple):
    """The environment at one revision.

    revision : of the environment; epoch : number of borders moved so far; firsts (S,) int64: first
    row key of each shard; writes (S,) int64: writes that each shard had committed, at least;
    ids (L,) int64: objects that have rows, ascending; versions (L,) int64: the version of the rows
    of each.
    """

    revision: int
    epoch: int
    firsts: Keys
    writes: Keys
    ids: Keys
    versions: Keys

    def are_live(self, ids: Keys, versions: Keys) -> NDArray[np.bool_]:
        """Whether rows of these objects in these versions (n,) count."""
        if not len(self.ids):
            return np.zeros(len(ids), dtype=np.bool_)
        at = np.minimum(np.searchsorted(self.ids, ids), len(self.ids) - 1)
        are_live: NDArray[np.bool_] = (self.ids[at] == ids) & (self.versions[at] == versions)
        return are_live

    def live_of(self, rows: Rows, versions: Keys) -> Rows:
        """The rows that count."""
        are_live = self.are_live(rows.ids, versions)
        return rows if are_live.all() else rows.picked(np.flatnonzero(are_live))


NOTHING = LiveView(-1, -1, NO_KEYS, NO_KEYS, NO_KEYS, NO_KEYS)


class Views:
    """The view that a connection knows; renewed when the coordinator has a newer one."""

    def __init__(self, connection: ServerConnection, row_shift: int) -> None:
        self._connection = connection
        self._shift = row_shift
        self.known = NOTHING
        # what `known` is of: the oid of a table, and the connection
        self._identity = -1
        self._driver: object = None

    def is_known(self, answer: list[bytes | None]) -> bool:
        """Whether `NEWEST` or `HOLDING` has answered with what is known.

        Behind a new connection the same revision may be another one: the coordinator may have been
        put back from a copy, and written to since.
        """
        found = tuple(wire.read_int8(value or b"") for value in answer[:3])
        expected = self.known.revision, self.known.epoch, self._identity
        return found == expected and self._connection.driver is self._driver

    def hold(self) -> LiveView:
        """View of the snapshot that has begun; its rows are not swept while it lasts."""
        if not self.is_known(self._connection.fetch(HOLDING)):
            self.load()
        return self.known

    def renewed(self) -> LiveView:
        """View of the newest commit, loaded unless it is known."""
        if not self.is_known(self._connection.fetch(NEWEST)):
            self.load()
        return self.known

    def load(self) -> LiveView:
        """Read the newest view. Of the versions only those that changed since are read."""
        if self._connection.driver is not self._driver:
            self.known = NOTHING
        before, driver = self.known, self._connection.driver
        answer = self._connection.fetch(LOAD, wire.int8(before.revision))
        revision, epoch, identity = (wire.read_int8(value or b"") for value in answer[:3])
        is_same = identity == self._identity and self._connection.driver is driver
        if before is not NOTHING and (not is_same or revision < before.revision):
            self.known = NOTHING  # the coordinator was put back from a copy
            return self.load()
        self._identity, self._driver = identity, self._connection.driver
        firsts, writes, ids, versions = map(wire.read_int8s, answer[3:])
        live = changed_versions(before.ids, before.versions, ids, versions)
        self.known = LiveView(revision, epoch, firsts >> self._shift, writes, *live)
        return self.known


def changed_versions(ids: Keys, versions: Keys, new_ids: Keys, new: Keys) -> tuple[Keys, Keys]:
    """Versions by id after some have changed; a version of -1 means that the object is gone.

    ids, new_ids : ascending. The given arrays stay as they are.
    """
    at = np.searchsorted(ids, new_ids)
    is_known = at < len(ids)
    is_known[is_known] = ids[at[is_known]] == new_ids[is_known]
    versions = versions.copy()
    versions[at[is_known]] = new[is_known]
    if not is_known.all():
        places = at[~is_known]
        ids = np.insert(ids, places, new_ids[~is_known])
        versions = np.insert(versions, places, new[~is_known])
    if (new < 0).any():
        is_live = versions >= 0
        ids, versions = ids[is_live], versions[is_live]
    return ids, versions
