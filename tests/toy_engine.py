"""The smallest engine: environments in this process's memory, opened by ``memory://name``.

docs/extending.md refers to this file. Every commit makes a new, immutable `State`; a snapshot is a
reference to one. The engine has what each engine must have, and no capability that only some
engines have.
"""

# ruff: noqa: ARG002 - a store takes what the protocol gives, needed or not

import contextlib
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import replace
from functools import cached_property
from threading import Lock
from typing import Literal, cast

import numpy as np

from hapticdb.errors import (
    DatabaseError,
    EnvironmentExistsError,
    EnvironmentNotFoundError,
    ReadOnlyError,
)
from hapticdb.grid import Grid
from hapticdb.store.base import (
    NO_ROWS,
    Change,
    Covering,
    Freshness,
    Histogram,
    Keys,
    Layout,
    Object,
    Replacements,
    Rows,
    Size,
    Store,
    joined,
)
from hapticdb.store.pairs import MARK, KeptPairs, Mark, Outlines, PairRow
from hapticdb.store.parsing import distances_crc, rows_crc
from hapticdb.store.refusals import (
    check_distances,
    check_unwritten,
    no_object,
    present_already,
)
from hapticdb.store.tables import touched_ranges
from hapticdb.store.threads import check_thread, this_thread


class State:
    """Content of an environment at one revision; immutable."""

    def __init__(
        self,
        objects: Mapping[int, tuple[Object, Rows]],
        changes: tuple[Change, ...] = (),
        removed: frozenset[tuple[str, str]] = frozenset(),
        surfaces: Mapping[str, bytes] | None = None,
        pairs: Mapping[tuple[int, int], PairRow] | None = None,
    ) -> None:
        self.objects = objects
        self.changes = changes
        self.removed = removed
        self.pairs = pairs or {}
        held = {obj.digest for obj, _ in objects.values()}
        self.surfaces = {name: one for name, one in (surfaces or {}).items() if name in held}

    @property
    def revision(self) -> int:
        return len(self.changes)

    @cached_property
    def rows(self) -> Rows:
        """Rows of the index table, in order of key and id."""
        return in_order([rows.occupied() for _, rows in self.objects.values()])

    @cached_property
    def distances(self) -> Rows:
        """Rows of the objects that have distances, in order of key and id."""
        held = [rows for obj, rows in self.objects.values() if obj.has_distances]
        return in_order(held, distances=True)


def in_order(parts: list[Rows], *, distances: bool = False) -> Rows:
    """Rows of several objects, in order of key and id."""
    rows = joined(parts, distances=distances)
    return rows.picked(np.lexsort((rows.ids, rows.keys)))


class Contents:
    """One environment: its grid, its newest state, its histograms and costs."""

    def __init__(self, name: str, grid: Grid, layout: Layout, *, distances: bool) -> None:
        self.name = name
        self.grid = grid
        self.layout = layout
        self.wants_distances = distances
        self.state = State({})
        self.n_ids = 0
        self.histograms: dict[int, tuple[int, Histogram]] = {}
        self.costs: dict[str, Mapping[str, float]] = {}
        self.write_lock = Lock()


class MemoryStore:
    """One opened environment."""

    engine = "memory 1.0"

    def __init__(self, contents: Contents, url: str, *, read_only: bool) -> None:
        self._contents = contents
        self.url = url
        self.name = contents.name
        self.grid = contents.grid
        self.layout = contents.layout
        self.is_read_only = read_only
        self.identity = contents
        self.is_closed = False
        self._thread = this_thread()
        self._snapshot: State | None = None
        self._depth = 0
        self._seen = -1

    def close(self) -> None:
        self.is_closed = True

    def give_to(self, thread: int) -> None:
        self._thread = thread

    def discard(self) -> None:
        if not self._contents.state.revision:
            ENVIRONMENTS.pop(self.name, None)
        self.close()

    @contextlib.contextmanager
    def snapshot(self) -> Iterator[None]:
        if self._depth == 0:
            self._snapshot = self._state()
        self._depth += 1
        try:
            yield
        finally:
            self._depth -= 1
            if self._depth == 0:
                self._snapshot = None

    def _state(self) -> State:
        """The state that a read uses: the snapshot's, or else the newest."""
        self._check()
        state = self._snapshot or self._contents.state
        self._seen = state.revision
        return state

    def _check(self) -> None:
        check_thread(self._thread, self.url)
        if self.is_closed:
            raise DatabaseError(f"{self.url} has been closed: open it again")

    def version(self) -> int:
        return self._seen

    def revision(self) -> int:
        return self._state().revision

    # -- rows --------------------------------------------------------------------------------

    def _rows(self, *, distances: bool) -> Rows:
        state = self._state()
        return state.distances if distances else state.rows

    def lookup(self, keys: Keys, *, distances: bool = False) -> Rows:
        rows = self._rows(distances=distances)
        return rows.picked(np.flatnonzero(np.isin(rows.keys, keys)))

    def lookup_each(self, keys: Keys, *, distances: bool = False) -> Rows:
        return self.lookup(keys, distances=distances)

    def scan(self, lows: Keys, highs: Keys, *, distances: bool = False) -> Rows:
        rows = self._rows(distances=distances)
        starts = np.searchsorted(rows.keys, lows)
        ends = np.searchsorted(rows.keys, highs, side="right")
        pairs = zip(starts.tolist(), ends.tolist(), strict=True)
        return rows.picked(np.concatenate([[], *(np.arange(*pair) for pair in pairs)]).astype(int))

    def count(self, lows: Keys, highs: Keys) -> int:
        return len(self.scan(lows, highs))

    def rows_of(self, object_id: int, lows: Keys, highs: Keys, *, distances: bool = False) -> Rows:
        rows = self.scan(lows, highs, distances=distances)
        return rows.picked(np.flatnonzero(rows.ids == object_id))

    def rows_after(self, key: int, object_id: int, limit: int, *, distances: bool = False) -> Rows:
        rows = self._rows(distances=distances)
        later = (rows.keys > key) | ((rows.keys == key) & (rows.ids > object_id))
        return rows.picked(np.flatnonzero(later)[:limit])

    # -- objects -----------------------------------------------------------------------------

    def objects(self, ids: Collection[int] | None = None) -> list[Object]:
        objects = self._state().objects
        chosen = objects.keys() if ids is None else objects.keys() & set(ids)
        return [objects[object_id][0] for object_id in sorted(chosen)]

    def outlines(self) -> Outlines:
        objects = self.objects()
        ids = np.array([(obj.id, obj.revision) for obj in objects], dtype=np.int64).reshape(-1, 2)
        return Outlines(
            [obj.name for obj in objects],
            [obj.digest for obj in objects],
            ids[:, 0],
            ids[:, 1],
            np.array([obj.bounds for obj in objects]).reshape(-1, 2, 3),
        )

    def object(self, object_id: int) -> Object:
        objects = self._state().objects
        if object_id not in objects:
            raise no_object(object_id, self.url)
        return objects[object_id][0]

    def removed(self, link: str) -> set[str]:
        return {name for of_link, name in self._state().removed if of_link == link}

    def changes(self, since: int = 0) -> Iterator[Change]:
        yield from self._state().changes[since:]

    def surfaces(self, digests: Sequence[str]) -> dict[str, bytes]:
        held = self._state().surfaces
        return {digest: held[digest] for digest in digests if digest in held}

    def surface_digests(self) -> set[str]:
        return set(self._state().surfaces)

    def loading(self) -> contextlib.AbstractContextManager[None]:
        return contextlib.nullcontext()

    def add(self, record: Object, rows: Rows, surface: bytes | None = None) -> int:
        with self._contents.write_lock:
            state = self._newest()
            part = (record.link, record.name)
            if any((known.link, known.name) == part for known, _ in state.objects.values()):
                raise present_already(record, self.url)
            is_free = record.id > 0 and record.id not in state.objects
            object_id = record.id if is_free else self._contents.n_ids + 1
            self._contents.n_ids = max(self._contents.n_ids, object_id)
            new = replace(record, id=object_id)
            self._commit(self._next(state, "add", object_id, rows.keys, new, rows, surface))
        return object_id

    def replace(
        self, record: Object, rows: Rows, covering: Covering, surface: bytes | None = None
    ) -> None:
        with self._contents.write_lock:
            self._commit(self._exchanged(self._newest(), record, rows, surface))

    def replace_all(self, made: Replacements, covering: Covering) -> None:
        with self._contents.write_lock:
            state = self._newest()
            for record, rows in made():
                state = self._exchanged(state, record, rows)
            self._commit(state)

    def _exchanged(
        self, state: State, record: Object, rows: Rows, surface: bytes | None = None
    ) -> State:
        known, old = self._known(state, record.id)
        check_unwritten(record, known, self.url)
        touched = np.concatenate([old.keys, rows.keys])
        return self._next(state, "move", record.id, touched, record, rows, surface)

    def remove(self, object_id: int, covering: Covering) -> None:
        with self._contents.write_lock:
            state = self._newest()
            _, old = self._known(state, object_id)
            self._commit(self._next(state, "remove", object_id, old.keys, None, NO_ROWS))

    def add_surface(self, digest: str, surface: bytes) -> None:
        with self._contents.write_lock:
            state = self._newest()
            held = {digest: surface} | state.surfaces
            self._contents.state = State(
                state.objects, state.changes, state.removed, held, state.pairs
            )

    def want_distances(self) -> None:
        self._check_writable()
        check_distances(self.layout, distances=True)
        self._contents.wants_distances = True

    @property
    def wants_distances(self) -> bool:
        return self._contents.wants_distances

    def _newest(self) -> State:
        """The state that a write starts from."""
        self._check_writable()
        return self._contents.state

    def _check_writable(self) -> None:
        self._check()
        if self.is_read_only:
            raise ReadOnlyError(f"{self.url} was opened to read: open it without read_only")

    def _known(self, state: State, object_id: int) -> tuple[Object, Rows]:
        if object_id not in state.objects:
            raise no_object(object_id, self.url)
        return state.objects[object_id]

    def _commit(self, state: State) -> None:
        """Replace the newest state. The caller holds the write lock."""
        self._contents.state = state

    def _next(
        self,
        state: State,
        action: Literal["add", "move", "remove"],
        object_id: int,
        touched: Keys,
        record: Object | None,
        rows: Rows,
        surface: bytes | None = None,
    ) -> State:
        """The state after a write of one object."""
        revision = state.revision + 1
        objects, removed = dict(state.objects), set(state.removed)
        surfaces = dict(state.surfaces)
        if record is None:
            gone = objects.pop(object_id)[0]
            removed.add((gone.link, gone.name))
        else:
            written = replace(
                record,
                revision=revision,
                rows_crc=rows_crc(rows.occupied()),
                distances_crc=distances_crc(rows),
            )
            ids = np.full(len(rows), object_id, np.int64)
            objects[object_id] = (written, Rows(rows.keys, ids, rows.occupancy, rows.distances))
            removed.discard((record.link, record.name))
            if surface is not None:
                surfaces.setdefault(record.digest, surface)
        ranges = touched_ranges(self.grid, self.layout, touched)
        change = Change(revision, action, object_id, ranges)
        return State(objects, (*state.changes, change), frozenset(removed), surfaces, state.pairs)

    # -- pairs -------------------------------------------------------------------------------

    def pairs(self) -> KeptPairs:
        rows = sorted(self._state().pairs.values())
        return KeptPairs(rows, lambda row: cast("PairRow", row))

    def put_pairs(
        self,
        rows: Sequence[PairRow],
        gone: Sequence[tuple[int, int]] = (),
        was: Mark | None = None,
        now: Mark | None = None,
    ) -> Mark | None:
        with self._contents.write_lock:
            held = dict(self._newest().pairs)
            found = [(row.setting, row.revision) for row in [held.pop(MARK, None)] if row]
            mark, marked = Mark.after(found, was, now)
            held = {key: row for key, row in held.items() if key not in gone}
            for row in (*rows, marked):
                old = held.get(row[:2], row)
                if row.revision >= old.revision:
                    held[row[:2]] = row._replace(because=old.because, shapes=old.shapes)
            held[MARK] = marked._replace(at_least=len(held) - 1.0)
            self._keep(held)
            return mark

    def accept_pair(self, a: int, b: int, because: str | None, shapes: str | None) -> None:
        with self._contents.write_lock:
            held = dict(self._newest().pairs)
            if (a, b) in held:
                held[a, b] = held[a, b]._replace(because=because, shapes=shapes)
            self._keep(held)

    def _keep(self, pairs: Mapping[tuple[int, int], PairRow]) -> None:
        state = self._contents.state
        self._contents.state = State(
            state.objects, state.changes, state.removed, state.surfaces, pairs
        )

    # -- statistics --------------------------------------------------------------------------

    def size(self) -> Size:
        rows, band = self._state().rows, self._state().distances
        n_bytes, of_band = rows.keys.nbytes + rows.ids.nbytes + rows.occupancy.nbytes, 0
        if band.distances is not None:
            of_band = band.keys.nbytes + band.ids.nbytes + band.distances.data.nbytes
        n_bytes += of_band
        held = self._state().surfaces
        of_surfaces = sum(map(len, held.values()))
        n_bytes += of_surfaces
        blocks = 1 + n_bytes // 8192
        return Size(len(rows), n_bytes, blocks, len(band), of_band, len(held), of_surfaces)

    def quantiles(self, resolution: int) -> Histogram:
        state = self._state()
        kept = self._contents.histograms.get(resolution)
        if kept and kept[0] == state.revision:
            return kept[1]._replace(source="kept")
        keys = state.rows.keys
        if not len(keys):
            return Histogram(np.zeros(2, np.int64), 0, "computed")
        ranks = -(-np.arange(resolution + 1) * len(keys) // resolution)
        return Histogram(keys[np.maximum(ranks, 1) - 1], len(keys), "computed")

    def freshness(self, resolution: int) -> Freshness:
        state = self._state()
        kept = self._contents.histograms.get(resolution)
        since = kept[0] if kept else 0
        return Freshness(since if kept else None, state.revision - since)

    def analyze(self, resolution: int, *, anew: bool = False) -> None:
        self._check_writable()
        with self.snapshot():
            self._contents.histograms[resolution] = (self.revision(), self.quantiles(resolution))

    def costs(self, machine: str) -> Mapping[str, float] | None:
        return self._contents.costs.get(machine)

    def save_costs(self, machine: str, figures: Mapping[str, float]) -> None:
        self._check_writable()
        self._contents.costs[machine] = dict(figures)

    # -- hapticdb check ----------------------------------------------------------------------

    def findings(self) -> Iterator[str]:
        yield from ()


ENVIRONMENTS: dict[str, Contents] = {}
"""All environments of this process, by name."""


class MemoryEngine:
    """The engine of the scheme ``memory``."""

    title = "memory"

    def open(self, url: str, *, read_only: bool) -> Store:
        contents = ENVIRONMENTS.get(url)
        if contents is None:
            raise EnvironmentNotFoundError(f"no environment at {url} in this process")
        return MemoryStore(contents, url, read_only=read_only)

    def create(self, url: str, grid: Grid, layout: Layout, *, distances: bool = False) -> Store:
        contents = Contents(url, grid, layout, distances=distances)
        if ENVIRONMENTS.setdefault(url, contents) is not contents:
            raise EnvironmentExistsError(f"{url} exists already; open it, or give another name")
        return MemoryStore(contents, url, read_only=False)

    def exists(self, url: str) -> bool:
        return url in ENVIRONMENTS

    def beside(self, url: str, ending: str) -> str:
        return f"{url}{ending}"


ENGINE = MemoryEngine()
