"""Decides what the samples of a sweep leave open: a proof that is refined where it is tight.

The tool's surface is covered with pieces, and the path with parts. At first the pieces are the
shell's points with their covering radius, and the parts are the steps between samples. Each piece
is proved clear of all surfaces on each part, or is tight there (`kernels.resident.proving`). Only
what is tight is looked at again: by stored distances, then in halves of the parts and, on request,
in halves of the pieces, until all is proved, a surface is proved to be near, or a limit is reached.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import UsageError
from hapticdb.kernels.resident import clearance, proving
from hapticdb.kernels.resident.cells import UNKNOWN, Cells
from hapticdb.pointshell.coverage import halves
from hapticdb.pointshell.orientation import Surface
from hapticdb.pointshell.shell import PointShell
from hapticdb.resident.residency import Residency
from hapticdb.sweeps.path import SweepPath
from hapticdb.sweeps.pieces import cut, radii_of
from hapticdb.sweeps.result import STRETCH, Decision, Moment

Floats = NDArray[np.float64]

WANTED = 0.5
"""Gap, voxels, below which a piece is looked at again by stored distances, which bound it more
closely than voxels. Larger: greater proved clearances, more time."""
FARTHEST = 4.0
"""Greatest gap, voxels, that is proved. Larger: more cells are fetched."""
ROUNDS = 9
"""Greatest number of times that tight parts and pieces are halved."""
SHORTEST = 1.0 / 64.0
"""Steps: a shorter part of the path is not halved. Larger: less is decided where it is tight."""
MOST_PIECES = 100_000
"""Greatest number of pieces of a refined shell. Larger: more is decided, with more memory."""
MOST_PAIRS = 3e7
"""Greatest number of pairs of a piece and a part in one round. Larger: more is decided, later."""
BLOCK = 1024
"""Poses looked at in one call of the kernel. Larger: more memory."""


class _Work(NamedTuple):
    """Pieces and parts of one round.

    points (P, 3): metres; radii (P,): metres; triangles (P, 3, 3) of the pieces, or None if they
    are the shell's points; places, spans (S,): middles and half lengths of parts, in samples.
    """

    points: Floats
    radii: Floats
    triangles: Floats | None
    places: Floats
    spans: Floats

    def kept(self, pieces: NDArray[np.bool_], parts: NDArray[np.bool_]) -> "_Work":
        """Keep some of the pieces (P,) and of the parts (S,)."""
        triangles = None if self.triangles is None else self.triangles[pieces]
        return _Work(
            self.points[pieces], self.radii[pieces], triangles, self.places[parts],
            self.spans[parts],
        )  # fmt: skip


class Decider:
    """Proves a tool clear on a path, first by voxels and then by distances.

    Parameters
    ----------
    shell : PointShell
        The tool; its covering radius is known.
    path : SweepPath
        Its path.
    voxel_size : float
        Metres.
    tolerance : float or None
        Metres. The search ends when a surface is proved to come so near; None: it goes on.
    refines : bool
        Whether pieces are halved, too, if the tool's triangles are known.
    """

    def __init__(
        self,
        shell: PointShell,
        path: SweepPath,
        voxel_size: float,
        tolerance: float | None,
        *,
        refines: bool,
    ) -> None:
        self.shell, self.path, self.size = shell, path, voxel_size
        self.tolerance, self.refines = tolerance, refines
        self.cover = shell.cover or 0.0
        self.within = np.inf
        self.near: tuple[float, int] | None = None
        """Place on the path, in samples, and nearest packed voxel, or -1, where `within` is."""
        self.least = FARTHEST
        self.looked = 0
        self.by = "voxels"
        count = len(path)
        self.work = _Work(
            np.array(shell.points), np.full(len(shell), self.cover), None,
            np.arange(count, dtype=float), np.full(count, 0.5 if count > 1 else 0.0),
        )  # fmt: skip
        self.clear_sample: int | None = None

    def look_by_voxels(self, residency: Residency, *, has_distances: bool) -> None:
        """Look at the whole path; what is tight remains. It is more if distances can be asked."""
        places = self.work.places
        work = self._look(residency, self.work, WANTED if has_distances else 0.0)
        tight = np.isin(places, work.places)
        if not tight.all():  # the last one: the tool is farthest out there, where it comes out
            self.clear_sample = int(np.flatnonzero(~tight)[-1])
        self.work = work

    def look_closer(self, residency: Residency) -> None:
        """Look again at what is tight, in halves, until it is decided or a limit is reached."""
        if residency.table.has_distances:
            self.by = "distances"
            self.work = self._look(residency, self.work, 0.0)
        for _ in range(ROUNDS):
            if self.is_decided:
                return
            work = self._halved()
            if work is None or float(len(work.points)) * len(work.places) > MOST_PAIRS:
                return
            self.work = self._look(residency, work, 0.0)

    @property
    def is_decided(self) -> bool:
        """Whether nothing is tight, or a surface is within the tolerance."""
        if not len(self.work.places):
            return True
        return self.tolerance is not None and self.within * self.size <= self.tolerance

    def decision(self, near: Moment | None) -> Decision:
        """Sum up; near : the moment of `near`, or None."""
        is_clear = not len(self.work.places)
        return Decision(
            is_clear=is_clear,
            at_least=self.least * self.size if is_clear else 0.0,
            within=float(self.within * self.size),
            near=near,
            tolerance=self.tolerance,
            by=self.by,
        )

    def _look(self, residency: Residency, work: _Work, wanted: float) -> _Work:
        """Bound all pieces on all parts; returns the tight ones."""
        pieces = proving.Pieces(
            np.ascontiguousarray(work.points),
            (1.0 + STRETCH) * work.radii / self.size,
            np.full(len(work.points), -np.inf),
            np.full(len(work.points), -1, dtype=np.int64),
            np.zeros(len(work.points), dtype=np.uint8),
            np.array([-np.inf, max(self.least, wanted), self.within]),
            np.zeros(4, dtype=np.int64),
        )
        is_tight = np.zeros(len(work.places), dtype=np.uint8)
        for first in range(0, len(work.places), BLOCK):
            self._look_at(residency, pieces, work, slice(first, first + BLOCK), wanted, is_tight)
        self.least = float(pieces.state[proving.LEAST])
        self.looked += int(pieces.where[proving.LOOKED])
        return work.kept(pieces.is_tight > 0, is_tight > 0)

    def _look_at(
        self,
        residency: Residency,
        pieces: proving.Pieces,
        work: _Work,
        block: slice,
        wanted: float,
        is_tight: NDArray[np.uint8],
    ) -> None:
        """Look at the parts of a block (b,), and note which are tight in is_tight (S,)."""
        table = residency.table
        cells: Cells = table.cells
        places = work.places[block]
        poses = self.path.at(places)
        spent, offs = self.path.reaches(places, work.spans[block])
        offs *= 1.0 + STRETCH
        done = 0
        while True:
            with table.reading() as row:
                done = proving.prove(
                    cells, row, pieces, poses, spent, offs, residency.place, 2.0 * self.path.slack,
                    wanted, done, is_tight[block],
                )  # fmt: skip
            if pieces.state[proving.WITHIN] < self.within:
                self.within = float(pieces.state[proving.WITHIN])
                pose, point = pieces.where[[proving.POSE, proving.POINT]].tolist()
                self.near = float(places[pose]), int(pieces.nearest[point])
            if done == len(poses):
                return
            reach = float(pieces.radii.max() + offs[done] + pieces.state[proving.LEAST])
            _fetch(residency, pieces, poses[done:], reach + clearance.MARGIN)

    def _halved(self) -> _Work | None:
        """Halve the parts and pieces that are tight; None if they are as small as they may be."""
        work = self.work
        places, spans = work.places, work.spans
        is_long = spans > SHORTEST
        if is_long.any():
            places, spans = _halved_parts(places, spans, float(self.path.starts[-1]))
        pieces: tuple[Floats, Floats, Floats | None] | None = work.points, work.radii, None
        surface = self.shell.surface
        if self.refines and isinstance(surface, Surface):
            pieces = self._halved_pieces(surface)
        if pieces is None or not (is_long.any() or self.refines):
            return None
        if pieces[2] is None and not is_long.any():
            return None
        return _Work(*pieces, places, spans)

    def _halved_pieces(self, surface: Surface) -> tuple[Floats, Floats, Floats] | None:
        """Pieces of half the radius near the tight ones; None if they are too many."""
        from scipy.spatial import cKDTree  # noqa: PLC0415 - a third of a second

        work = self.work
        if work.triangles is not None:
            return _cut(work.triangles, 0.5 * float(work.radii.max()))
        tree = cKDTree(work.points)
        triangles, goal = surface.triangles, 0.5 * self.cover
        done = []
        while len(triangles):
            middles = triangles.mean(axis=1)
            radii = radii_of(triangles, middles)
            near = np.asarray(tree.query(middles)[0]) <= (1.0 + STRETCH) * (radii + self.cover)
            triangles, radii = triangles[near], radii[near]
            done.append(triangles[radii <= goal])
            triangles = halves(triangles[radii > goal])
            if len(triangles) + sum(map(len, done)) > MOST_PIECES:
                return None
        return _cut(np.concatenate(done) if done else np.empty((0, 3, 3)), goal)


def _cut(triangles: Floats, goal: float) -> tuple[Floats, Floats, Floats] | None:
    """Middles, radii and triangles of pieces with a radius of at most `goal`; None: too many."""
    found = cut(triangles, goal, MOST_PIECES)
    return None if found is None else (found.middles, found.radii, found.triangles)


def _halved_parts(places: Floats, spans: Floats, last: float) -> tuple[Floats, Floats]:
    """Halves of the parts of a path of `last` steps, in their order."""
    shorter = np.repeat(0.5 * spans, 2)
    middles = np.repeat(places, 2) + np.tile([-1.0, 1.0], len(places)) * shorter
    inside = (middles >= 0.0) & (middles <= last)
    return middles[inside], shorter[inside]


def _fetch(residency: Residency, pieces: proving.Pieces, poses: Floats, reach: float) -> None:
    """Fetch the cells within `reach`, voxels, of the point at which the search stopped."""
    most = (residency.table.n_slots - 1) // 2
    if (int(2.0 * reach / 32) + 2) ** 3 > most:
        raise UsageError(
            f"the proof needs more cells around a point than fit into "
            f"{residency.table.size_bytes} bytes: give a larger budget"
        )
    found = np.full(1 << (2 * most).bit_length(), UNKNOWN, dtype=np.int64)
    clearance.cells_near(
        pieces.points, poses, residency.place, int(pieces.where[proving.STOPPED]), 4,
        (reach + 2.0) * residency.grid.voxel_size, found, most,
    )  # fmt: skip
    residency.make_resident(np.sort(found[found >= 0]))
