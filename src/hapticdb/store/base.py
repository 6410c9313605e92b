"""Protocol `Store` of the engines, and its arguments and results: rows, objects, changes."""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, Protocol, get_args, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from hapticdb.grid import BRICK_BITS, Grid
from hapticdb.store.pairs import Ids, MaybeMark, Outlines, PairRow, Rule, StoredPairs
from hapticdb.units import length_text, notebook_html, place_text

Layout = Literal["voxel", "brick"]
Columns = Literal["voxel", "brick", "distances"]
"""Columns of a read: rows of a layout, or bricks with their distances."""
LAYOUTS: tuple[Layout, ...] = get_args(Layout)
BRICK_SHIFT = 3 * BRICK_BITS
"""Bits of a voxel's key below its brick's."""
CELL_SHIFT = 15
"""Bits of a voxel's key below its cell's."""
BRICK_BYTES = 64
"""Bytes of a brick's occupancy: a bit for each of its 512 voxels."""
LONGEST_BAND = 2048
"""Upper bound of a row's packed distances, bytes; `kernels.field.packing` makes fewer."""

Keys = NDArray[np.int64]
Progress = Callable[[int, int], object]
"""Called with the amount of work done and the total. Its error ends the work."""


class Band(NamedTuple):
    """Packed distances to surfaces, of R rows (`hapticdb.kernels.field`).

    data : (n,) uint8, row after row.
    ends : (R,) int64, end of each row's bytes in `data`.
    """

    data: NDArray[np.uint8]
    ends: NDArray[np.int64]

    @property
    def lengths(self) -> NDArray[np.int64]:
        """Bytes of each row (R,)."""
        return np.diff(self.ends, prepend=0)

    def picked(self, which: NDArray[np.int64]) -> "Band":
        """Copies of the rows of given indices, in their order."""
        lengths, bytes_of = self.lengths[which], self.data.tobytes()
        pairs = zip(self.ends[which].tolist(), lengths.tolist(), strict=True)
        joined = b"".join([bytes_of[end - length : end] for end, length in pairs])
        return Band(np.frombuffer(joined, np.uint8), np.cumsum(lengths))

    def part(self, low: int, high: int) -> "Band":
        """Rows low .. high; their bytes are a view."""
        start = int(self.ends[low - 1]) if low else 0
        ends = self.ends[low:high]
        stop = int(ends[-1]) if len(ends) else start
        return Band(self.data[start:stop], ends - start)


class Rows(NamedTuple):
    """A batch of rows of the index table.

    keys : (R,) int64, ascending: voxel keys, or brick keys.
    ids : (R,) int64, object ids.
    occupancy : (64 R,) uint8, 64 bytes a row; empty on the voxel layout.
    distances : to surfaces, for each brick near one, also without a voxel; None if the object has
        none, or unread.
    """

    keys: Keys
    ids: NDArray[np.int64]
    occupancy: NDArray[np.uint8]
    distances: Band | None = None

    def __len__(self) -> int:
        """Number of rows, not of this tuple's four fields."""
        return len(self.keys)

    def part(self, low: int, high: int) -> "Rows":
        """Rows low .. high, as views."""
        distances = None if self.distances is None else self.distances.part(low, high)
        bits = self.occupancy[BRICK_BYTES * low : BRICK_BYTES * high]
        return Rows(self.keys[low:high], self.ids[low:high], bits, distances)

    def having(self, distances: Band | None) -> "Rows":
        """These rows with other distances. `_replace` fails: `len` is not the number of fields."""
        return Rows(self.keys, self.ids, self.occupancy, distances)

    def picked(self, which: NDArray[np.int64]) -> "Rows":
        """Copies of the rows of given indices, in their order."""
        bits = NO_OCCUPANCY
        if self.occupancy.size:
            some = self.occupancy.reshape(-1, BRICK_BYTES)[which]
            bits = np.frombuffer(some.tobytes(), np.uint8)
        distances = None if self.distances is None else self.distances.picked(which)
        return Rows(self.keys[which], self.ids[which], bits, distances)

    def occupied(self) -> "Rows":
        """Rows of bricks with a voxel, without distances."""
        rows = self.having(None)
        if self.distances is None:
            return rows
        return rows.picked(np.flatnonzero(self.occupancy.reshape(-1, BRICK_BYTES).any(axis=1)))

    def measured(self) -> "Rows":
        """Rows with distances, from a result of `Store.rows_after`."""
        if self.distances is None:
            return NO_DISTANCES
        return self.picked(np.flatnonzero(self.distances.lengths))


NO_KEYS = np.empty(0, dtype=np.int64)
# from bytes, hence read-only: kernels are compiled for this one array type
NO_OCCUPANCY = np.frombuffer(b"", dtype=np.uint8)
NO_ROWS = Rows(NO_KEYS, NO_KEYS, NO_OCCUPANCY)
NO_DISTANCES = NO_ROWS.having(Band(NO_OCCUPANCY, NO_KEYS))


def no_rows(*, distances: bool) -> Rows:
    """Empty result of a read."""
    return NO_DISTANCES if distances else NO_ROWS


def joined(parts: Sequence[Rows], *, distances: bool) -> Rows:
    """Concatenation of batches in their order; all with distances or all without."""
    if not parts:
        return no_rows(distances=distances)
    bits = np.frombuffer(b"".join([part.occupancy.tobytes() for part in parts]), np.uint8)
    bands = [part.distances for part in parts if part.distances is not None]
    band = None
    if distances:
        data = np.frombuffer(b"".join([one.data.tobytes() for one in bands]), np.uint8)
        band = Band(data, np.cumsum(np.concatenate([one.lengths for one in bands])))
    keys, ids = (np.concatenate([part[column] for part in parts]) for column in (0, 1))
    return Rows(keys, ids, bits, band)


def is_ascending(keys: Keys, ids: Keys) -> bool:
    """Whether rows are in ascending order of key and id."""
    later = (keys[1:] > keys[:-1]) | ((keys[1:] == keys[:-1]) & (ids[1:] > ids[:-1]))
    return bool(later.all())


def row_shift(layout: Layout) -> int:
    """Bits of a voxel's key below the key of its row."""
    return BRICK_SHIFT if layout == "brick" else 0


@dataclass(frozen=True)
class Object:
    """An object: a row of the table `object`.

    id : assigned by its first write, never reused; 0 before
    name : path of the part inside its file
    link : absolute path of the file of its surface
    digest : digest of its geometry in its own frame
    transform (4, 4) float64 : world_from_part, metres
    voxels : number of voxels touched by its surface
    bounds (2, 3) float64 : lower and upper corner, metres, world frame
    attributes : JSON: ``unit`` of its file; ``up``, its axis x, y or z; attributes of an IFC file
    revision : revision of the environment made by its last write
    rows_crc, distances_crc : checksums of its rows and distances at the write, or None
    surface : its packed surface, from `Environment.remove` alone, for `restore`
    """

    name: str
    link: str
    digest: str
    transform: NDArray[np.float64]
    voxels: int
    bounds: NDArray[np.float64]
    attributes: Mapping[str, object] = field(default_factory=dict)
    id: int = 0
    revision: int = 0
    rows_crc: int | None = None
    distances_crc: int | None = None
    surface: bytes | None = None

    def __repr__(self) -> str:
        size = length_text(float(np.ptp(self.bounds, axis=0).max()))
        return f"Object({self.id} {self.name!r}, {size} long, {self.voxels:,} voxels)"

    def _repr_html_(self) -> str:
        """Box and file, for notebooks."""
        low, high = (place_text(corner, 1e-4) for corner in self.bounds.tolist())
        rows = ("box, m", f"{low} to {high}"), ("file", self.link or "none")
        return notebook_html(self, rows)

    @property
    def has_distances(self) -> bool:
        """Whether distances to its surface are stored with its voxels."""
        return self.distances_crc is not None


@dataclass(frozen=True)
class Change:
    """One committed write, with the keys for a reader to read again.

    ranges (C, 2) int64 : lowest and highest voxel key of each touched range, ascending.
    """

    revision: int
    action: Literal["add", "move", "remove"]
    id: int
    ranges: NDArray[np.int64]


Replacements = Callable[[], Iterable[tuple[Object, Rows]]]
"""Makes the objects to be replaced, each once, with their new rows."""


class Histogram(NamedTuple):
    """Equi-count histogram of all row keys.

    bounds (R + 1,) int64, ascending; n_rows : rows of the index table; source : ``computed`` by
    this call, ``kept`` in the environment since its last write, or ``server statistics``.
    """

    bounds: Keys
    n_rows: int
    source: str


class Freshness(NamedTuple):
    """Age of the statistics of the keys, which the strategy `cbgroup` uses.

    revision : of the environment at the time of the statistics, None without any; changes : writes
    committed since.
    """

    revision: int | None
    changes: int


class Size(NamedTuple):
    """Size of the tables; bytes : of the whole database with its log; surface_bytes : packed."""

    rows: int
    bytes: int
    leaf_blocks: int
    surfaces: int = 0
    surface_bytes: int = 0


class LocatedShell(NamedTuple):
    """Point shell at a pose, argument of `Store.statement`; arrays in the order of the points.

    placed (N + 1, 6) float64 : points in metres and normals, world frame; last row: the tool's
    centre.
    addresses (N,) int64 : of the points' voxels, -1 outside the grid; from
    `kernels.query.shell_keys`.
    stiffness : N/m.
    exclude (E,) int64 : ids of objects without force.
    """

    placed: NDArray[np.float64]
    addresses: Keys
    stiffness: float
    exclude: Keys


def all_rows(store: "Store", limit: int) -> Iterator[Rows]:
    """All rows in ascending order of key and id, in batches of at most `limit`."""
    key, object_id = -1, 0
    while len(rows := store.rows_after(key, object_id, limit)):
        key, object_id = int(rows.keys[-1]), int(rows.ids[-1])
        yield rows


class Store(Protocol):
    """An opened environment. Methods take and return whole batches.

    Only the thread that opened a store may use it. A read outside `snapshot` sees all commits
    before its start. All reads inside see one revision.
    """

    @property
    def url(self) -> str:
        """URL of the environment for messages, without a password."""

    @property
    def name(self) -> str:
        """Name among the environments of one folder or database."""

    @property
    def engine(self) -> str:
        """Engine and version: ``SQLite 3.51.0``, ``PostgreSQL 18.6``."""

    @property
    def grid(self) -> Grid:
        """Grid of the environment, fixed at its creation."""

    @property
    def layout(self) -> Layout:
        """Layout of its index table, fixed at its creation."""

    @property
    def wants_distances(self) -> bool:
        """Whether an import computes distances to the surfaces of parts; bricks only."""

    @property
    def is_read_only(self) -> bool:
        """Whether writes are refused."""

    @property
    def identity(self) -> object:
        """Device and inode, or a table's oid: different for a later environment of this URL."""

    def close(self) -> None:
        """Close the connection."""

    def discard(self) -> None:
        """Close and delete a new environment without commits; only servers verify that again."""

    def snapshot(self) -> AbstractContextManager[None]:
        """All reads inside see one committed revision. May be nested."""

    # -- rows: arrays of keys and of bounds are ascending, distinct and contiguous -----------------
    #
    # Rows are in ascending order of key and id, by one statement (`lookup_each`: one a key), of
    # bricks with a voxel. With `distances`: all rows with distances, of zero occupancy in a brick
    # without a voxel; objects without distances have no rows then.

    def lookup(self, keys: Keys, *, distances: bool = False) -> Rows:
        """Rows of distinct ascending keys (U,), by this engine's fastest statement."""

    def lookup_each(self, keys: Keys, *, distances: bool = False) -> Rows:
        """Rows as by `lookup`, one statement a key: the paper's point queries."""

    def scan(self, lows: Keys, highs: Keys, *, distances: bool = False) -> Rows:
        """Rows with a key in any closed range, ascending and disjoint."""

    def count(self, lows: Keys, highs: Keys) -> int:
        """Number of rows in the ranges, counted in the engine; bricks without a voxel count."""

    def rows_of(self, object_id: int, lows: Keys, highs: Keys, *, distances: bool = False) -> Rows:
        """Rows of one object with a key in any closed range, ascending and disjoint."""

    def rows_after(self, key: int, object_id: int, limit: int) -> Rows:
        """At most `limit` of all rows after (key, id); (-1, 0) starts at the first.

        Bricks have their distances, of 0 bytes in a row without any.
        """

    def statement(self, frame: LocatedShell) -> NDArray[np.float64]:
        """Wrench (6,) of the frame, N and N m about its centre, by one statement: Figure 3."""

    def statement_hits(self, frame: LocatedShell) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Every hit with every object in its voxel: points' ordinals (P,) and object ids (P,)."""

    # -- objects and committed changes ------------------------------------------------------------

    def revision(self) -> int:
        """Number of the last committed write; 0 for an empty environment."""

    def version(self) -> int:
        """Counter that changes when the last read may have seen another revision."""

    def newest(self) -> int:
        """As `version`, for the newest commit, mostly without a round trip to a server.

        A server's notification of a commit takes a moment. Inside a snapshot, PostgreSQL is
        queried.
        """

    def watch(self, *, is_prompt: bool = False) -> None:
        """Begin to notice commits; may be called again.

        is_prompt : whether reads report a lost or silent server within 0.4 s, without waiting for
        its return. The loss of a file is always reported at once.
        """

    def has_changed(self) -> bool:
        """Whether something was committed since `watch` or the last call. Never waits.

        Cheap enough for hundreds of calls a second. It may be true without a commit, as at the
        first call without a `watch`. After a commit it is false only until a server's notification
        has arrived. Raises UsageError inside a snapshot.
        """

    def objects(self, ids: Collection[int] | None = None) -> list[Object]:
        """All objects, or the existing ones of some ids, ordered by id."""

    def object(self, object_id: int) -> Object:
        """One object; raises ObjectNotFoundError when there is none of that id."""

    def outlines(self) -> Outlines:
        """Summary rows of all objects, ordered by id, a twentieth of the time of `objects`."""

    def removed(self, link: str) -> set[str]:
        """Names of a file's removed parts, except those added again."""

    def changes(self, since: int = 0) -> Iterator[Change]:
        """Committed writes after that revision, oldest first."""

    def surfaces(self, digests: Sequence[str]) -> dict[str, bytes]:
        """Packed surfaces by digest, in one statement; unknown digests are left out."""

    def surface_digests(self) -> set[str]:
        """Digests of all surfaces."""

    # -- writes: an object's rows, its record and its `Change`, in one transaction -----------------
    #
    # A packed surface is stored once, under the record's digest. It is deleted when the last object
    # of its digest is removed or gets another digest. An object has distances if its rows have
    # them. All raise ReadOnlyError on a read-only environment.

    def loading(self) -> AbstractContextManager[None]:
        """Context for the writes of many objects. May be nested.

        Inside, an engine may postpone work for readers, such as an index, to the end; after an
        error, it is done, too. Writes committed inside are safe.
        """

    def add(self, record: Object, rows: Rows, surface: bytes | None = None) -> int:
        """Write an object and its rows, of any ids; returns its id: its own if above 0 and free."""

    def replace(
        self, record: Object, rows: Rows, surface: bytes | None = None, *, everywhere: bool = False
    ) -> None:
        """Exchange an object's rows; `everywhere` deletes old ones outside its bounds, too.

        A record with a revision above 0 is derived from the object of this revision: ConflictError
        if the object has been written since.
        """

    def replace_all(self, made: Replacements) -> None:
        """As `replace` for several objects, in one transaction: after an error, for none of them.

        `made` is called inside the transaction, and again when a lost connection is replaced. It
        may read this store. Rows are written as they come. Each object gets its own revision.
        """

    def remove(self, object_id: int, revision: int | None = None) -> Object:
        """Remove an object and its rows; returns the former object with its surface.

        Raises ConflictError when a revision is given and the object has been written since.
        """

    # -- pairs of objects; they change no revision -------------------------------------------------

    def pairs(self) -> StoredPairs:
        """All rows, and the mark, in one statement."""

    def put_pairs(
        self, rows: Sequence[PairRow], gone: Ids = (), was: MaybeMark = None, now: MaybeMark = None
    ) -> MaybeMark:
        """Delete rows and write others, in one transaction.

        Rows of a later revision than a given one stay, as do the entries of `accept_pair`. If the
        mark is `was`, it becomes `now`, or a new one without `now`, and is returned: nobody has
        written since it was read. Otherwise it becomes a new one, and None is returned.
        """

    def accept_pair(self, a: int, b: int, because: str | None, shapes: str | None) -> None:
        """Store why a pair is accepted, and both shapes; no effect without a row of the pair."""

    def rules(self) -> tuple[Rule, ...]:
        """Rules for pairs, in order; the first one matching a pair applies."""

    def change_rules(self, change: Callable[[tuple[Rule, ...]], Sequence[Rule]]) -> None:
        """Replace all rules by `change` of them, in one transaction."""

    # -- statistics, cost figures, checks ----------------------------------------------------------

    def size(self) -> Size:
        """Rows, bytes and leaf blocks."""

    def quantiles(self, resolution: int) -> Histogram:
        """Equi-count histogram of all row keys, of R buckets."""

    def freshness(self, resolution: int) -> Freshness:
        """Age of the statistics of `quantiles` at this resolution."""

    def analyze(self, resolution: int, *, anew: bool = False) -> None:
        """Renew the statistics of `quantiles`; fresh ones only with `anew`."""

    def costs(self, machine: str) -> Mapping[str, float] | None:
        """Cost figures of this machine, from `save_costs`; None without any."""

    def save_costs(self, machine: str, figures: Mapping[str, float]) -> None:
        """Store the fitted cost figures of a machine."""

    def findings(self) -> Iterator[str]:
        """Faults of pages, indexes and stored statistics, a line each."""


@runtime_checkable
class SupportsCaches(Protocol):
    """An engine whose caches belong to this process, which can empty them."""

    def drop_caches(self) -> None:
        """Empty the connection's cache, and the operating system's cache of the file."""
