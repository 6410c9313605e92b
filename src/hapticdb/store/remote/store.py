"""An environment behind a hapticdb server, opened to read."""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping
from typing import NoReturn

import numpy as np

from hapticdb.errors import DatabaseError, ProtocolError, ReadOnlyError, UsageError
from hapticdb.protocol import cells as bodies
from hapticdb.protocol.fields import FieldsRead
from hapticdb.protocol.header import Kind, MessageHeader
from hapticdb.store import believed
from hapticdb.store.base import (
    Change,
    Checker,
    Covering,
    Freshness,
    Histogram,
    Keys,
    Object,
    Rows,
    Size,
)
from hapticdb.store.batches import joined, no_rows
from hapticdb.store.messages import (
    change_of_body,
    grid_of_welcome,
    object_of_body,
    rows_of_body,
)
from hapticdb.store.refusals import no_object
from hapticdb.store.remote.connection import RemoteConnection
from hapticdb.store.remote.news import RemoteNews
from hapticdb.store.urls import parse_address

BEATS = 4.0
"""The server is alive if something came within so many of its beats. Larger: a late beat costs no
question; smaller: a server that hangs is asked sooner."""
SILENT_SECONDS = 30.0
"""Seconds without a message to the server after which one that watches says that it is there.
Larger: fewer messages; above a server's limit (120 s) it ends the connection."""
ANY_REVISION = -1
"""Revision that a snapshot asks for if any will do."""


class RemoteChecker:
    """Refuses to check: a client sees neither pages nor indexes."""

    def __init__(self, url: str) -> None:
        self._url = url

    @staticmethod
    def has_page_checksums() -> bool:
        """Return false: none are sent."""
        return False

    def findings(self) -> Iterator[str]:
        """Refuse."""
        raise UsageError(
            f"{self._url} is behind a server: run 'hapticdb check' where its files are"
        )

    def rows_after(
        self,
        key: int,  # noqa: ARG002 - refused
        object_id: int,  # noqa: ARG002
        limit: int,  # noqa: ARG002
        *,
        distances: bool = False,  # noqa: ARG002
    ) -> Rows:
        """Refuse."""
        raise UsageError(
            f"{self._url} is behind a server: run 'hapticdb check' where its files are"
        )


class RemoteStore:
    """An environment behind a server, to read. Its answers are those of the server's own store.

    What the server pushes after `watch` is used in the snapshot that follows: the revision, the
    writes and the rows of cells that this store has read before cost no round trip then.
    """

    is_read_only = True

    def __init__(self, url: str) -> None:
        self._news: RemoteNews | None = None
        self._used: RemoteNews | None = None
        self._is_pinned = False
        self._is_watching = False
        self._has_changed = False
        self._pushed_revision = ANY_REVISION
        self._seen = ANY_REVISION
        address = parse_address(url)
        self.url = address.shown
        self._connection = RemoteConnection(address, self._hear)
        try:
            welcome = self._connection.welcome
            self.grid, self.layout = grid_of_welcome(self.url, welcome)
        except BaseException:
            self._connection.close()
            raise
        self.name = welcome.name
        self.engine = f"{welcome.engine} behind a server"
        self.wants_distances = welcome.wants_distances
        self.identity = welcome.identity
        self.give_to = self._connection.give_to
        self.close = self._connection.close

    @property
    def is_closed(self) -> bool:
        """Whether `close` was called; a lost connection comes back by itself."""
        return self._connection.is_closed

    def discard(self) -> None:
        """Close the connection; nothing is deleted on the server."""
        self.close()

    # -- messages ----------------------------------------------------------------------------

    def _hear(self, header: MessageHeader, body: FieldsRead) -> None:
        """Take in a push."""
        if header.kind != Kind.NEWS:
            return  # a beat, or what a later version pushes: its arrival alone counts
        news = RemoteNews(self.url, self.layout, header.revision, bodies.news_of(body))
        self._news = news.joined_to(self._news)
        self._pushed_revision = header.revision
        self._has_changed = True

    def _ask(self, kind: Kind, body: bytes = b"", *, answer: Kind) -> FieldsRead:
        """Ask the server; inside a snapshot, ask for the snapshot's revision."""
        connection = self._connection
        if connection.is_in_snapshot and not self._is_pinned:
            wanted = ANY_REVISION if self._used is None else self._used.revision
            connection.check_thread()
            connection.hear()
            connection.tell(Kind.BEGIN, bodies.pack_numbers(wanted))
            self._is_pinned = True
        header, found = connection.ask(kind, body, answer=answer)
        self._seen = header.revision
        return found

    # -- snapshots and commits of others -------------------------------------------------------

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[None]:
        """All reads inside see one committed revision. May be nested.

        The server holds it for a few seconds. Reads later than that raise OutdatedError.
        """
        connection = self._connection
        if connection.enter() and self._news is not None:
            # after an answer that is newer than the news, they would lead back in time
            self._used = self._news if self._news.revision >= self._seen else None
            self._news = None
        try:
            yield
        finally:
            if connection.leave():
                self._used = None
                if self._is_pinned:
                    self._is_pinned = False
                    with contextlib.suppress(DatabaseError):
                        connection.tell(Kind.END)

    def version(self) -> int:
        """The revision that the last read has seen."""
        return self._seen

    def revision(self) -> int:
        """Number of the last committed write; 0 for an empty environment."""
        if self._used is not None:
            self._connection.check_thread()
            self._seen = self._used.revision
            return self._seen
        bodies.numbers_of(self._ask(Kind.REVISION, answer=Kind.NUMBERS), 0)
        return self._seen

    def watch(self) -> None:
        """Begin to notice commits from now on."""
        self._connection.check_outside()
        self._connection.hear()
        self._is_watching = True
        self._begin_watch()
        self._news, self._has_changed = None, False

    def _begin_watch(self) -> None:
        self._ask(Kind.WATCH, answer=Kind.NUMBERS)
        self._watched_on = self._connection.n_connected

    def has_changed(self) -> bool:
        """Whether something was committed since `watch` or the last call; costs no round trip.

        After a lost connection it returns true, because commits may have been missed.
        """
        connection = self._connection
        connection.check_outside()
        connection.hear()
        if not self._is_watching or self._watched_on != connection.n_connected:
            self.watch()
            return True
        changed, self._has_changed = self._has_changed, False
        if changed or time.monotonic() - connection.sent_at > SILENT_SECONDS:
            connection.tell(Kind.NOTED, revision=self._pushed_revision)
        return changed

    def is_beating(self) -> bool:
        """Whether the server has said of itself lately that its database answers."""
        silence = time.monotonic() - self._connection.heard_at
        return self._is_watching and silence < BEATS * self._connection.welcome.beat

    # -- rows --------------------------------------------------------------------------------

    def lookup(self, keys: Keys, *, distances: bool = False) -> Rows:
        """Rows of distinct ascending keys (U,), in the form that the server answers fastest."""
        return self._looked_up(Kind.LOOKUP, keys, distances=distances)

    def lookup_each(self, keys: Keys, *, distances: bool = False) -> Rows:
        """Rows of distinct ascending keys (U,); the server runs one statement a key."""
        return self._looked_up(Kind.LOOKUP_EACH, keys, distances=distances)

    def _looked_up(self, kind: Kind, keys: Keys, *, distances: bool) -> Rows:
        def ask(keys: Keys, _: Keys) -> FieldsRead:
            body = bodies.pack_keys(keys, distances=distances)
            return self._ask(kind, body, answer=Kind.ROWS)

        return self._all_rows(ask, keys, keys, distances=distances)

    def scan(self, lows: Keys, highs: Keys, *, distances: bool = False) -> Rows:
        """Rows with a key in any of the closed ranges, ascending and disjoint."""

        def ask(lows: Keys, highs: Keys) -> FieldsRead:
            body = bodies.pack_ranges(lows, highs, distances=distances)
            return self._ask(Kind.SCAN, body, answer=Kind.ROWS)

        return self._all_rows(ask, lows, highs, distances=distances)

    def rows_of(self, object_id: int, lows: Keys, highs: Keys, *, distances: bool = False) -> Rows:
        """Rows of one object with a key in any of the closed ranges, ascending and disjoint."""

        def ask(lows: Keys, highs: Keys) -> FieldsRead:
            body = bodies.pack_rows_of(object_id, lows, highs, distances=distances)
            return self._ask(Kind.ROWS_OF, body, answer=Kind.ROWS)

        return self._all_rows(ask, lows, highs, distances=distances)

    def pushed_rows(self, cells: Keys, *, distances: bool) -> Rows | None:
        """Rows of cells (n,), ascending on the curve, as the server has pushed them; else None.

        Inside a snapshot alone, of its revision.
        """
        if self._used is None:
            return None
        return self._used.rows_of_cells(cells, distances=distances)

    def _all_rows(
        self,
        ask: Callable[[Keys, Keys], FieldsRead],
        lows: Keys,
        highs: Keys,
        *,
        distances: bool,
    ) -> Rows:
        """Rows of keys or ranges by as many answers as necessary, all of one revision."""
        self._connection.check_thread()
        if not lows.size:
            return no_rows(distances=distances)
        if len(lows) <= bodies.MOST_KEYS:
            body = bodies.rows_of(ask(lows, highs))
            if body.resume == bodies.COMPLETE:
                return rows_of_body(self.url, body, self.layout, distances=distances)
        parts: list[Rows] = []
        with self.snapshot():
            while len(lows):
                some = slice(bodies.MOST_KEYS)
                body = bodies.rows_of(ask(lows[some], highs[some]))
                parts.append(rows_of_body(self.url, body, self.layout, distances=distances))
                done = int(highs[some][-1]) + 1
                if body.resume != bodies.COMPLETE:
                    last = int(body.keys[-1]) if len(body.keys) else -1
                    if body.resume <= max(int(lows[0]), last):
                        raise ProtocolError(f"{self.url}: the server's answer leads nowhere")
                    done = body.resume
                first = int(np.searchsorted(highs, done))
                is_key = lows is highs
                highs = highs[first:]
                lows = highs if is_key else np.maximum(lows[first:], done)
        return joined([part for part in parts if len(part)], distances=distances)

    def count(self, lows: Keys, highs: Keys) -> int:
        """How many rows `scan` would return, counted by the server."""
        self._connection.check_thread()
        total = 0
        with self.snapshot() if len(lows) > bodies.MOST_KEYS else contextlib.nullcontext():
            for at in range(0, len(lows), bodies.MOST_KEYS):
                some = slice(at, at + bodies.MOST_KEYS)
                body = bodies.pack_ranges(lows[some], highs[some], distances=False)
                found = self._ask(Kind.COUNT, body, answer=Kind.NUMBERS)
                total += bodies.numbers_of(found, 1)[0]
        return total

    # -- objects -----------------------------------------------------------------------------

    def objects(self) -> list[Object]:
        """All objects, ordered by id. Their links are names of files, without folders."""
        found: list[Object] = []
        with self.snapshot():
            has_all = False
            while not has_all:
                after = found[-1].id if found else 0
                asked = bodies.pack_numbers(after)
                body = self._ask(Kind.OBJECTS, asked, answer=Kind.OBJECTS_ARE)
                has_all = bool(body.u4())
                part = bodies.objects_of(body)
                body.end()
                if not has_all and (not part or part[-1].object_id <= after):
                    raise DatabaseError(f"{self.url}: the server's answer leads nowhere")
                found += [object_of_body(self.url, one) for one in part]
        return found

    def object(self, object_id: int) -> Object:
        """One object; raises ObjectNotFoundError when there is none of that id."""
        if self._used is not None and object_id in self._used.objects:
            return self._used.objects[object_id]
        asked = bodies.pack_numbers(object_id)
        body = self._ask(Kind.OBJECT, asked, answer=Kind.OBJECTS_ARE)
        body.u4()
        found = bodies.objects_of(body)
        body.end()
        if not found:
            raise no_object(object_id, self.url)
        return object_of_body(self.url, found[0])

    def removed(self, link: str) -> set[str]:  # noqa: ARG002 - refused
        """Refuse: only an import asks, and the server does not tell where its files are."""
        self._refuse()

    def changes(self, since: int = 0) -> Iterator[Change]:
        """Committed writes after that revision, oldest first."""
        known = self._used.changes_after(since) if self._used is not None else None
        if known is not None:
            yield from known
            return
        has_all = False
        while not has_all:
            asked = bodies.pack_numbers(since)
            body = self._ask(Kind.CHANGES, asked, answer=Kind.CHANGES_ARE)
            has_all = bool(body.u4())
            part = bodies.changes_of(body)
            body.end()
            if not has_all and (not part or part[-1].revision <= since):
                raise DatabaseError(f"{self.url}: the server's answer leads nowhere")
            for one in part:
                since = one.revision
                yield change_of_body(self.url, one)

    # -- statistics --------------------------------------------------------------------------

    def size(self) -> Size:
        """Rows, bytes and leaf blocks of the server's database."""
        return Size(*bodies.numbers_of(self._ask(Kind.SIZE, answer=Kind.NUMBERS), 5))

    def quantiles(self, resolution: int) -> Histogram:
        """Equi-count histogram of all row keys, of R buckets."""
        asked = bodies.pack_numbers(resolution)
        body = self._ask(Kind.QUANTILES, asked, answer=Kind.HISTOGRAM)
        source, n_rows = body.text(), body.i8()
        bounds = body.i8s(body.u4())
        body.end()
        return believed.histogram_of(self.url, bounds.tolist(), n_rows)._replace(source=source)

    def freshness(self, resolution: int) -> Freshness:
        """How old the statistics are that `quantiles` uses at that resolution."""
        asked = bodies.pack_numbers(resolution)
        body = self._ask(Kind.FRESHNESS, asked, answer=Kind.NUMBERS)
        revision, changes, rows = bodies.numbers_of(body, 3)
        return Freshness(None if revision < 0 else revision, changes, rows)

    def costs(self, machine: str) -> Mapping[str, float]:  # noqa: ARG002 - the server's counts
        """Figures of the server's machine, whichever is asked for: the statements run there."""
        body = self._ask(Kind.COSTS, answer=Kind.FIGURES)
        text = body.text()
        body.end()
        return believed.figures_of(self.url, text)

    # -- what a client cannot do -----------------------------------------------------------------

    def _refuse(self) -> NoReturn:
        self._connection.check_thread()
        raise ReadOnlyError(
            f"{self.url} is behind a server, which lets clients read: open the environment where "
            "it is to change it"
        )

    def loading(self) -> contextlib.AbstractContextManager[None]:
        """Refuse: the environment is opened to read."""
        self._refuse()

    def add(self, record: Object, rows: Rows) -> int:  # noqa: ARG002 - refused
        """Refuse: the environment is opened to read."""
        self._refuse()

    def replace(self, record: Object, rows: Rows, covering: Covering) -> None:  # noqa: ARG002
        """Refuse: the environment is opened to read."""
        self._refuse()

    def add_distances(self, record: Object, rows: Rows) -> None:  # noqa: ARG002 - refused
        """Refuse: the environment is opened to read."""
        self._refuse()

    def remove(self, object_id: int, covering: Covering) -> None:  # noqa: ARG002 - refused
        """Refuse: the environment is opened to read."""
        self._refuse()

    def want_distances(self) -> None:
        """Refuse: the environment is opened to read."""
        self._refuse()

    def analyze(self, resolution: int, *, anew: bool = False) -> None:  # noqa: ARG002 - refused
        """Refuse: the environment is opened to read."""
        self._refuse()

    def save_costs(self, machine: str, figures: Mapping[str, float]) -> None:  # noqa: ARG002
        """Refuse: the environment is opened to read."""
        self._refuse()

    def checker(self) -> Checker:
        """Return a checker that refuses: pages and indexes are checked where they are."""
        return RemoteChecker(self.url)
