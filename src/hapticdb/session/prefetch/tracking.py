"""Tracks sessions for the prefetch process: poses of tools, cells to fetch, objects in contact."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.array_types import Floats
from hapticdb.grid import CELL_BITS, Grid
from hapticdb.kernels.field.distance_law import ONSET
from hapticdb.kernels.records.cells import MOST_OBJECT_REQUESTS
from hapticdb.kernels.resident.cell_table import cells_ahead
from hapticdb.kernels.resident.cells import EMPTY_SLOT, UNKNOWN
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import CellTable
from hapticdb.store.base import NO_KEYS, Keys, Store
from hapticdb.store.objects_at import ids_near_voxels, ids_of_voxels

REACH_VOXELS = 500.0
"""Speed of a hand from rest, voxels/s: 1 m/s in voxels of 2 mm. Larger: more cells around a resting
hand are fetched."""
SLACK_VOXELS = 1.0
"""Least motion (voxels) of a request before its cells are computed again. Larger: fewer
computations and a wider margin."""
MOST_CELLS_WANTED = 1 << 15
"""Greatest number of cells of one request: the box around a faster or larger tool is cut at its far
ends. A larger value serves larger tools and takes more time."""
CELL = float(1 << CELL_BITS)
"""Voxels on a cell's edge."""
SPEED_HALF_LIFE = 0.7
"""Half-life (s) of a hand's greatest observed speed. Larger: more cells are fetched around a slowed
hand."""
SHARE_OF_TABLE = 0.75
"""Share of the table for the requests of all sessions. The rest has recently used cells. Larger:
larger tools are served, and more is evicted."""
READ_ATTEMPTS = 100
"""Attempts to read an unfinished row. Writing takes microseconds, so its loop is dead."""
MET = -1.0
"""Urgency of unknown cells in a frame; all other cells have 0 or more, and come later."""
NEAR = ONSET + 0.87
"""Greatest distance (voxels) of a named object, in cells with distances: the onset of the distance
law, and half a voxel's diagonal, since the distance counts at the centre of the point's voxel.
Larger: objects without a force are named, too."""

Ranked = tuple[Keys, NDArray[np.float64]]
"""Cells (n,) int64 and their urgency (n,), smallest first."""


class PrefetchRequest(NamedTuple):
    """Present and expected place of a tool, in voxels of the grid.

    start, move (3,): the bounding sphere's centre, and its displacement to the hand's expected
    place; radius: of the sphere; margin: greatest distance of the sphere from this path.
    """

    start: Floats
    move: Floats
    radius: float
    margin: float

    @classmethod
    def of_record(
        cls, grid: Grid, record: NDArray[np.void], lookahead: float, peak_speed: float
    ) -> "PrefetchRequest | None":
        """Request of a session; None unless all numbers of its tool are finite.

        record () : of `PREFETCH_REQUEST`. The bounding sphere moves from the tool to the hand, and
        on with the hand's velocity for `lookahead` seconds. The margin is the greatest distance of
        the hand from this path after this time, at 1.5 times its recent `peak_speed` (m/s), at
        `REACH_VOXELS` at least.
        """
        tool, handle, velocity = record["tool"], record["handle"], record["velocity"]
        radius, size = float(record["radius"]), grid.voxel_size
        if not np.isfinite([*tool, *handle, *velocity, radius]).all():
            return None
        # the lower bound serves a hand at rest: it may start within the look-ahead time
        margin = max(1.5 * peak_speed / size, REACH_VOXELS) * lookahead
        return cls(
            (tool - np.array(grid.origin)) / size,
            (handle - tool + velocity * lookahead) / size,
            radius / size,
            margin,
        )

    def is_near(self, other: "PrefetchRequest") -> bool:
        """Whether the cells of this request can be used for the other request."""
        away = [
            *(self.start - other.start),
            *(self.start + self.move - other.start - other.move),
            self.radius + self.margin - other.radius - other.margin,
        ]
        return bool(max(map(abs, away)) <= SLACK_VOXELS)

    def cells(self, grid: Grid) -> tuple[Keys, Floats]:
        """Cells within reach, most urgent first, and their urgency in voxels.

        The urgency of a cell is the least distance between it and the moving sphere, plus the
        sphere's path until it is nearest.
        """
        n_cells = max(grid.side >> CELL_BITS, 1)
        # the cells also serve each request that `is_near` accepts:
        # both ends may differ by the slack
        reach = self.radius + self.margin + 2.0 * SLACK_VOXELS
        end = self.start + self.move
        low = np.floor((np.minimum(self.start, end) - reach) / CELL)
        high = np.floor((np.maximum(self.start, end) + reach) / CELL)
        # clipped as floats: a far hand would overflow int64
        first = np.clip(low, 0, n_cells).astype(np.int64)
        last = np.clip(high, -1, n_cells - 1).astype(np.int64)
        if (first > last).any():
            return np.empty(0, dtype=np.int64), np.empty(0)
        self._trim(first, last)
        room = int(np.prod(last - first + 1))
        keys, urgency = np.empty(room, dtype=np.int64), np.empty(room)
        margin = self.margin + 2.0 * SLACK_VOXELS
        count = cells_ahead(first, last, self.start, self.move, self.radius, margin, keys, urgency)
        # stable: equal urgency keeps one order, so batches repeat
        order = np.argsort(urgency[:count], kind="stable")
        return keys[:count][order], urgency[:count][order]

    def _trim(self, first: Keys, last: Keys) -> None:
        """Cut a box of too many cells, first .. last, at its far ends; in place."""
        spans = last - first + 1
        while np.prod(spans) > MOST_CELLS_WANTED:
            # the longest axis loses its end farther from the tool: the hand arrives there last
            axis = int(np.argmax(spans))
            middle = self.start[axis] / CELL
            if middle - first[axis] > last[axis] - middle:
                first[axis] += max(spans[axis] // 4, 1)
            else:
                last[axis] -= max(spans[axis] // 4, 1)
            spans = last - first + 1


@dataclass
class _TrackedSession:
    """State of one session.

    sequence : number of the queue's row at its last reading; request : the last one with computed
    cells; cells, urgency (n,) : most urgent first; speed : recent greatest speed of the hand, m/s;
    n_missing : unknown cells of the request at the last check.
    """

    sequence: int = 0
    request: PrefetchRequest | None = None
    cells: Keys = field(default_factory=lambda: NO_KEYS)
    urgency: NDArray[np.float64] = field(default_factory=lambda: np.empty(0))
    speed: float = 0.0
    n_missing: int = 0


class SessionTracker:
    """All sessions of one table, by their rows of its request queue, ascending."""

    def __init__(self, table: CellTable, grid: Grid) -> None:
        self._table = table
        self._grid = grid
        self.sessions: dict[int, _TrackedSession] = {}

    def read_queue(self, elapsed: float, lookahead: float) -> bool:
        """Read the poses of the tools; returns whether any request has other cells.

        elapsed : seconds since the last call; lookahead : look-ahead time, s.
        """
        queue = self._table.queue.requests
        active = set(np.flatnonzero(queue["prefetch"]["is_active"]).tolist())
        has_moved = active != set(self.sessions)
        self.sessions = {row: self.sessions.get(row, _TrackedSession()) for row in sorted(active)}
        for row, session in self.sessions.items():
            record = self._read_report(row, session)
            if record is None:
                continue
            speed = float(np.linalg.norm(record["velocity"]))
            if np.isfinite(speed):
                # peak hold with decay: a hand that reverses is slow for a moment only
                session.speed = max(speed, session.speed * 0.5 ** (elapsed / SPEED_HALF_LIFE))
            request = PrefetchRequest.of_record(self._grid, record, lookahead, session.speed)
            if request is None or (
                session.request is not None and request.is_near(session.request)
            ):
                continue
            session.request = request
            session.cells, session.urgency = request.cells(self._grid)
            has_moved = True
        return has_moved

    def _read_report(self, row: int, session: _TrackedSession) -> NDArray[np.void] | None:
        """Read a row of the queue completely; None if its loop died while it wrote the row."""
        queue = self._table.queue.requests
        for _ in range(READ_ATTEMPTS):
            # seqlock: odd while the loop writes; a copy counts if the number
            # was even and has not changed
            session.sequence = int(queue["sequence"][row])
            record: NDArray[np.void] = queue["prefetch"][row, ...].copy()
            if session.sequence % 2 == 0 and session.sequence == queue["sequence"][row]:
                return record
        return None

    def has_unknown_cells(self) -> bool:
        """Whether any session's last frame had unknown cells."""
        return bool(self._table.queue.requests["missed"]["n_cells"][list(self.sessions)].any())

    def urgent_cells(self) -> Keys:
        """Cells of all sessions, distinct, most urgent first."""
        return ranked([(one.cells, one.urgency) for one in self.sessions.values()])

    def missing_cells(self, residency: Residency) -> Keys:
        """Unknown cells of all requests, most urgent first; protects the resident ones."""
        # first, so that all requests of this round are protected together
        residency.begin_round()
        wanted = [part for row in self.sessions for part in self._wanted(row, residency)]
        return residency.missing(ranked(wanted))

    def _wanted(self, row: int, residency: Residency) -> Iterator[Ranked]:
        """Cells of one session: as many as its share of the table has room for."""
        table, session = self._table, self.sessions[row]
        # equal shares: one fast hand must not take the slots of all others
        share = SHARE_OF_TABLE / len(self.sessions)
        cells = session.cells[: int(share * (table.capacity // 2 - table.n_slots))]
        slots = residency.slots_of(cells)
        # a cell that is known to be empty takes no slot
        n_kept = np.searchsorted(np.cumsum(slots != EMPTY_SLOT), share * table.n_slots, "right")
        cells, slots = cells[:n_kept], slots[:n_kept]
        yield cells, session.urgency[:n_kept]
        unknown = cells[slots == UNKNOWN]
        table.queue.figures["wanted"] += len(cells)
        table.queue.figures["granted"] += len(cells) - len(unknown)
        session.n_missing = len(unknown)
        # unknown cells of the last frame come before all others:
        # there the prediction was wrong
        unknowns = table.queue.requests["missed"][row]
        if n_missed := int(unknowns["n_cells"]):
            missed = np.unique(unknowns["cells"][:n_missed])
            session.n_missing += int(np.count_nonzero(residency.slots_of(missed) == UNKNOWN))
            yield missed, np.full(len(missed), MET)

    def report_missing(self) -> None:
        """Report the number of missing cells to each session, with the number of its request."""
        queue = self._table.queue.requests
        for row, session in self.sessions.items():
            # number before `heard`: who sees its request answered must not read
            # the number of an older one
            queue["n_missing"][row] = session.n_missing
            queue["heard"][row] = session.sequence


def ranked(wanted: Sequence[Ranked]) -> Keys:
    """Distinct cells of several requests, most urgent first."""
    if not wanted:
        return NO_KEYS
    cells = np.concatenate([cells for cells, _ in wanted])
    order = np.argsort(np.concatenate([urgency for _, urgency in wanted]), kind="stable")
    if len(wanted) > 1:
        _, first = np.unique(cells[order], return_index=True)
        # `unique` sorts by key; the first places restore the order of urgency
        order = order[np.sort(first)]
    return cells[order]


class ObjectAnswers:
    """Answers on the request queue: ids of the objects in the requested voxels.

    These are the objects in the voxels; in a table with distances, those near the voxels, too.
    """

    def __init__(self, table: CellTable, residency: Residency) -> None:
        self._queue = table.queue.requests
        self._residency = residency
        self._has_distances = table.has_distances
        self._answered: dict[int, bytes] = {}

    def forget(self) -> None:
        """Forget all answers after a change of the database."""
        self._answered.clear()

    def answer(self, store: Store, rows: Iterable[int]) -> None:
        """Answer new requests of the sessions in `rows`."""
        before, self._answered = self._answered, {}
        for row in rows:
            n_asked = int(self._queue["n_asked"][row])
            if n_asked <= 0:
                self._queue["n_objects"][row] = 0
                continue
            keys = np.unique(self._queue["asked"][row, :n_asked])
            # a hand at rest asks for the same voxels: one query until a commit
            question = keys.tobytes()
            if before.get(row) != question:
                ids = self.ids_of(store, keys)[:MOST_OBJECT_REQUESTS]
                # ids before their number: it never covers an id that is not written yet
                self._queue["objects"][row, : len(ids)] = ids
                self._queue["n_objects"][row] = len(ids)
            self._answered[row] = question

    def ids_of(self, store: Store, keys: Keys) -> Keys:
        """Ids of the objects in voxels (n,), distinct and ascending."""
        exclude = self._residency.exclude
        if self._has_distances:
            return ids_near_voxels(store, keys, exclude, NEAR)
        return ids_of_voxels(store, keys, exclude)
