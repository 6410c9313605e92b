"""Sweep: computes a whole path as a batch, and decides whether a part comes out.

The sweep is exact for the shell's points at the samples, because it waits for every cell that they
need. A bound covers the space between samples and between points (`result.Proof`). The result is
"comes out" if that bound proves it, and otherwise "not decided".
"""

import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.environment import Environment
from hapticdb.errors import ConnectionLostError, UsageError
from hapticdb.kernels.resident import sweep as kernels
from hapticdb.pointshell.coverage import Interior
from hapticdb.pointshell.shell import PointShell
from hapticdb.proportions import Proportions, compare_proportions
from hapticdb.resident.frames import FeltFrames, ResidentFrames
from hapticdb.resident.residency import Residency
from hapticdb.resident.table import DEFAULT_BUDGET, CellTable
from hapticdb.store.base import NO_KEYS, Keys, Object
from hapticdb.store.filtering import Filter
from hapticdb.store.finding import Words
from hapticdb.sweeps.clearance import ClearanceSearch
from hapticdb.sweeps.deciding import Decider
from hapticdb.sweeps.depths import with_depths
from hapticdb.sweeps.inside import enclosed_ids
from hapticdb.sweeps.objects import Met, Runs, find_hits, pairs_in_voxels, pairs_of_hits, tally
from hapticdb.sweeps.path import SweepPath
from hapticdb.sweeps.result import (
    Clearance,
    Decision,
    Deepest,
    MetObject,
    Moment,
    Profile,
    Proof,
    Swept,
)

DEFAULT_LIMIT = 32
"""Default limit of the clearance, voxels. Larger: more cells are fetched around the tool."""
WINDOWS = 256
"""Greatest number of sections of a path's profile. Larger: a finer profile, more time."""
LOOKED = 1.5
"""Least search distance, as a multiple of the distance that proves a tool clear. Larger: more cells
are fetched."""
BLOCK = 1024
"""Greatest number of samples in a block. Larger: more memory, fewer calls of `progress`."""
BLOCK_POINTS = 1 << 21
"""Greatest number of points looked up in a block, but at least one sample. Larger: more memory."""

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
SampleCallback = Callable[[int, int], None]
"""Called with how much is done and the total: of samples, or of straight pulls."""


def sweep(
    env: Environment,
    shell: PointShell,
    poses: ArrayLike,
    *,
    where: Words = (),
    exclude: Words = (),
    budget_bytes: int = DEFAULT_BUDGET,
    clearance_limit: float | None = None,
    profile: bool = False,
    proportions: Proportions | None = None,
    progress: SampleCallback | None = None,
    leave_start: bool = False,
    tolerance: float | None = None,
    refine: bool = False,
) -> Swept:
    """Move a tool along a path and report what it hits, in an environment of any size.

    Parameters
    ----------
    env : Environment
        An environment whose order is not lexicographic. The sweep reads one revision of it.
    shell : PointShell
        The tool. "Comes out" needs a covering radius of about a voxel or less, as of a shell made
        with `spacing=0.5 * env.grid.voxel_size`. It is computed here if necessary.
    poses : (M, 4, 4) array
        `world_from_tool`, rigid, metres; at least one. Motion between two: as for `SweepPath`.
    where, exclude : iterable of int or str
        Felt are the objects that `where` chooses, all if it is empty, without those of `exclude`: a
        part that is taken out must not hit itself. Words as for `Environment.find`.
    budget_bytes : int
        Memory for resident cells; never exceeded.
    clearance_limit : float or None
        Greatest clearance that is searched, metres; 32 voxels unless given; 0: no search.
    profile : bool
        Compute the clearance along the path, too.
    proportions : Proportions or None
        Of the same tool, path and scene, with their units; compared here in metres unless given.
    progress : callable or None
        As `SampleCallback`.
    leave_start, refine : bool
        Leave out the objects that the tool hits at the first pose, and bound how deep it goes into
        them; draw a finer shell where the verdict is open.
    tolerance : float or None
        Metres, a voxel's diagonal at most and if None. "Hits" is said only if surfaces come near;
        where hits prove less, it is "not decided". What is left out may be entered so much deeper.

    Raises
    ------
    UsageError
        If a pose is not rigid, or the budget is too small for the tool.
    ObjectNotFoundError
        If a word of `where` or `exclude` chooses no object.
    """
    shell = shell.with_cover()
    path = SweepPath.of(poses, shell, env.grid.voxel_size)
    limit = DEFAULT_LIMIT * env.grid.voxel_size if clearance_limit is None else clearance_limit
    asked = _Asked(limit, profile, proportions, progress, leave_start, tolerance, refine)
    run = _Run(env, shell, path, asked)
    return with_depths(run.swept_once(Filter(where, exclude), budget_bytes), shell, tolerance)


class _Asked(NamedTuple):
    """What is asked, as for `sweep`; limit : metres."""

    limit: float
    profile: bool
    proportions: Proportions | None
    progress: SampleCallback | None
    leave_start: bool
    tolerance: float | None
    refine: bool


class _Run:
    """State of one sweep."""

    def __init__(self, env: Environment, shell: PointShell, path: SweepPath, asked: _Asked) -> None:
        limit = asked.limit
        if not (np.isfinite(limit) and limit >= 0.0):
            raise UsageError(f"clearance up to {limit} m: give a finite length, 0 or more")
        if asked.tolerance is not None and not 0.0 < asked.tolerance < np.inf:
            raise UsageError(f"tolerance {asked.tolerance} m: give a finite length above 0")
        self.asked = asked
        self.store = env.store
        self.grid = env.grid
        self.shell = shell
        self.path = path
        self.is_asked = limit > 0.0  # clearance is requested; the proof needs some in any case
        if shell.cover is not None:
            limit = max(limit, LOOKED * (shell.cover + path.off))
        self.limit = limit
        self.is_profiled = asked.profile and self.is_asked
        self.n_windows = min(len(path), WINDOWS)
        self.begins = -(-np.arange(self.n_windows) * len(path) // self.n_windows)

    def swept_once(self, felt: Filter, budget_bytes: int) -> Swept:
        """Sweep; all of it is repeated once if a snapshot is lost."""
        with suppress(ConnectionLostError):
            return self.swept(felt, budget_bytes)
        return self.swept(felt, budget_bytes)

    def swept(self, felt: Filter, budget_bytes: int) -> Swept:
        """Sweep from the start, in one snapshot."""
        with self.store.snapshot():
            started = time.perf_counter()
            left: Ints = NO_KEYS
            if self.asked.leave_start:
                left = self._hit_at_start(felt, budget_bytes)
                felt = Filter(felt.where, (*felt.exclude, *left.tolist()))
            found, decider = self._by_voxels(felt, budget_bytes)
            self.search = self.along = None  # their table is another's place
            if decider is not None:
                cells = 0
                if not decider.is_decided:
                    cells = self._closer(decider, felt, budget_bytes)
                found = replace(
                    found, decision=self._decision(decider), cells=found.cells + cells,
                    looked=found.looked + decider.looked,
                )  # fmt: skip
            return replace(
                found, left_at_start=tuple(self.known[i] for i in left.tolist()),
                elapsed=time.perf_counter() - started,
            )  # fmt: skip

    def _hit_at_start(self, felt: Filter, budget_bytes: int) -> Ints:
        """Ids of the objects in whose voxels the tool has a point at the first pose, ascending."""
        with self._frames(felt, budget_bytes, may_measure=False) as frames:
            first = self.path.poses[:1]
            found = find_hits(frames, first, frames.feel(first).hits)
            exclude = frames.residency.exclude
            return np.unique(pairs_of_hits(found.places, found.voxels, self.store, exclude).ids)

    def _by_voxels(self, felt: Filter, budget_bytes: int) -> tuple[Swept, Decider | None]:
        """Sweep by voxels; the decider has what they leave open, if it is to be looked at."""
        with self._frames(felt, budget_bytes, may_measure=True) as frames:
            residency = frames.residency
            started = time.perf_counter()
            residency.refresh()
            self._begin(frames, felt)
            self.exclude = residency.exclude
            self.enclosed = enclosed_ids(residency, self.shell, self.path.poses[0])
            self._sweep(frames)
            found = self._result(frames, time.perf_counter() - started)
            if not self._is_open(found):
                return found, None
            decider = Decider(
                self.shell, self.path, self.grid.voxel_size, self._tolerance,
                refines=self.asked.refine,
            )  # fmt: skip
            decider.look_by_voxels(residency, has_distances=self._have_distances)
            return self._enclosed_later(found, decider, residency), decider

    @contextmanager
    def _frames(
        self, felt: Filter, budget_bytes: int, *, may_measure: bool
    ) -> Iterator[ResidentFrames]:
        with CellTable.create(budget_bytes) as table:
            residency = Residency(
                self.store, table, felt.exclude, where=felt.where, may_measure=may_measure
            )
            with closing(ResidentFrames(residency, self.shell)) as frames:
                yield frames

    def _is_open(self, found: Swept) -> bool:
        """Whether a closer look is to decide; a hit is looked at on request only."""
        if found.enclosed or self.shell.cover is None or found.proof.is_clear:
            return False
        is_asked = self.asked.tolerance is not None or self.asked.refine
        return is_asked or not found.hits

    @property
    def _tolerance(self) -> float | None:
        asked = self.asked.tolerance
        return None if asked is None else min(asked, np.sqrt(3.0) * self.grid.voxel_size)

    @property
    def _have_distances(self) -> bool:
        """Whether all objects that are felt have distances to their surfaces."""
        left_out = set(self.exclude.tolist())
        return all(obj.has_distances for i, obj in self.known.items() if i not in left_out)

    def _enclosed_later(self, found: Swept, decider: Decider, residency: Residency) -> Swept:
        """Look again what lies in a closed tool: at a pose with no voxel near its surface.

        Where no surfaces meet, an object that is inside once is inside always. At other poses a
        voxel across the tool's surface does not tell on which side its object lies.
        """
        known = Interior(self.shell.surface) if self.shell.surface is not None else None
        if not (self.shell.is_closed if known is None else known):
            return found
        ids = None
        if decider.clear_sample is not None:
            sample = decider.clear_sample
            pose = self.path.sample(sample, sample + 1)[0]
            ids = enclosed_ids(residency, self.shell, pose)
        proof = found.proof._replace(is_inside_known=ids is not None)
        inside = () if ids is None else tuple(self.known[i] for i in ids.tolist())
        return replace(found, proof=proof, enclosed=found.enclosed + inside)

    def _closer(self, decider: Decider, felt: Filter, budget_bytes: int) -> int:
        """Look at what is tight by distances, if there are any; returns the cells fetched."""
        with CellTable.create(budget_bytes, distances=self._have_distances) as table:
            residency = Residency(
                self.store, table, felt.exclude, where=felt.where, may_measure=False
            )
            with suppress(UsageError):  # the budget is too small for more: it stays undecided
                decider.look_closer(residency)
            return residency.n_loaded

    def _decision(self, decider: Decider) -> Decision:
        """Sum up, with the place where a surface is proved to be near."""
        if decider.near is None:
            return decider.decision(None)
        place, voxel = decider.near
        ids: Ints = NO_KEYS
        if voxel >= 0:
            ids = np.unique(pairs_in_voxels(self.store, _unpacked(voxel), self.exclude).ids)
        near = Moment(
            round(place),
            float(self.path.fractions(place)),
            int(self.path.segments(place)),
            self.path.at(np.array([place]))[0],
            tuple(self.known[i] for i in ids.tolist()),
        )
        return decider.decision(near)

    def _begin(self, frames: ResidentFrames, felt: Filter) -> None:
        self.known = {obj.id: obj for obj in self.store.objects()}
        for error in felt.left_out([*self.known.values()], self.store.url).missing:
            raise error
        voxels = self.limit / self.grid.voxel_size
        self.search = ClearanceSearch(frames, voxels) if voxels > 0.0 else None
        self.along = ClearanceSearch(frames, voxels, self.n_windows) if self.is_profiled else None
        self.met: dict[int, Met] = {}
        self.hit_runs, self.contact_runs = Runs(), Runs()
        self.looked = 0
        self.hits_in = np.zeros(self.n_windows, dtype=np.int64)
        self.depth_in = np.zeros(self.n_windows)
        self.first_hit: Moment | None = None
        self.first_contact: Moment | None = None
        self.deepest: Deepest | None = None

    def _sweep(self, frames: ResidentFrames) -> None:
        total = len(self.path)
        block = max(1, min(BLOCK, BLOCK_POINTS // len(self.shell)))
        for first in range(0, total, block):
            last = min(first + block, total)
            poses = self.path.sample(first, last)
            windows = np.arange(first, last) * self.n_windows // total
            is_hit = np.zeros(last - first, dtype=np.bool_)
            begin = self._first_to_feel(first, poses)
            if begin < last:
                felt = frames.feel(poses[begin - first :])
                self.looked += last - begin
                np.maximum.at(self.hits_in, windows[begin - first :], felt.hits)
                np.maximum.at(self.depth_in, windows[begin - first :], felt.deepest)
                is_hit[begin - first :] = felt.hits > 0
                if is_hit.any():
                    self._note_hits(frames, begin, poses[begin - first :], felt)
            self._note_profile(first, poses, is_hit)
            if self.asked.progress is not None:
                self.asked.progress(last, total)

    def _first_to_feel(self, first: int, poses: Floats) -> int:
        """Search the clearance in a block; returns the first sample that may hit anything.

        Before the first hit, bounds that are kept from pose to pose show which samples hit nothing,
        so these are not felt: the farther away everything is, the fewer poses are looked at.
        """
        if self.search is None or self.first_hit is not None:
            return first
        travels = self.path.travels(first, first + len(poses))
        before = self.search.looked
        self.search.look(first, poses, travels, np.zeros(len(poses), dtype=np.int64))
        self.looked += self.search.looked - before
        is_free = self.search.distance > 0.0
        return first + len(poses) if is_free else max(self.search.nearest[0], first)

    def _note_profile(self, first: int, poses: Floats, is_hit: NDArray[np.bool_]) -> None:
        """Measure the clearance at a block's sections; it is 0 for samples with a hit (B,)."""
        if self.along is None:
            return
        last = first + len(poses)
        travels = self.path.travels(first, last)
        windows = np.flatnonzero((self.begins >= first) & (self.begins < last))
        at = self.begins[windows] - first
        self.along.least[windows[is_hit[at]]] = 0.0
        at, windows = at[~is_hit[at]], windows[~is_hit[at]]
        self.along.look(first, poses[at], travels[at], windows)

    def _note_hits(
        self, frames: ResidentFrames, first: int, poses: Floats, felt: FeltFrames
    ) -> None:
        """Find the objects of a block's hits, and add them to the counts."""
        self.hit_runs.add(first + np.flatnonzero(felt.hits))
        self.contact_runs.add(first + np.flatnonzero(felt.contacts))
        found = find_hits(frames, poses, felt.hits)
        exclude = frames.residency.exclude
        pairs = pairs_of_hits(found.places, found.voxels, self.store, exclude)
        samples = found.samples + first
        tally(self.met, pairs, samples, found.depths)

        def moment(hits: NDArray[np.bool_], sample: int) -> Moment:
            ids = np.unique(pairs.ids[hits[pairs.hits]])
            return self._moment(sample, ids)

        if self.first_hit is None:
            self.first_hit = moment(samples == samples[0], int(samples[0]))
        is_contact = found.depths > 0.0
        if self.first_contact is None and is_contact.any():
            sample = int(samples[np.argmax(is_contact)])
            self.first_contact = moment(is_contact & (samples == sample), sample)
        deepest = int(np.argmax(found.depths))
        depth = float(found.depths[deepest])
        if self.deepest is None or depth > self.deepest.depth:
            at = moment(np.arange(len(samples)) == deepest, int(samples[deepest]))
            self.deepest = Deepest(depth, at, self._world(at.pose, int(found.points[deepest])))

    def _moment(self, sample: int, ids: Ints) -> Moment:
        return Moment(
            sample,
            float(self.path.fractions(sample)),
            int(self.path.segments(sample)),
            self.path.sample(sample, sample + 1)[0],
            tuple(self.known[i] for i in ids.tolist()),
        )

    def _world(self, pose: Floats, point: int) -> Floats:
        return np.asarray(pose[:3, :3] @ self.shell.points[point] + pose[:3, 3])

    def _clearance(self, exclude: Keys) -> Clearance | None:
        if self.search is None or not self.is_asked:
            return None
        size = self.grid.voxel_size
        diagonal, off = np.sqrt(3.0) * size, self.path.off + (self.shell.cover or 0.0)
        if self.first_hit is not None:
            return Clearance(0.0, 0.0, diagonal, is_beyond=False, moment=self.first_hit)
        distance = self.search.distance * size
        at_least = max(distance - off, 0.0)
        sample, point, voxel = self.search.nearest
        if sample < 0:
            return Clearance(self.limit, at_least, np.inf, is_beyond=True)
        ijk = _unpacked(voxel)
        moment = self._moment(sample, pairs_in_voxels(self.store, ijk, exclude).ids)
        return Clearance(
            distance, at_least, distance + diagonal, is_beyond=False, moment=moment,
            point=self._world(moment.pose, point), voxel=self.grid.centers(ijk)[0],
        )  # fmt: skip

    def _met(self, obj: Object, met: Met) -> MetObject:
        intervals = self.path.fractions(met.hits.array())
        length = float((intervals[:, 1] - intervals[:, 0]).sum() * self.path.motion.sum())
        contacts = met.contacts.array()
        first_contact = (
            self._moment(int(contacts[0, 0]), np.array([obj.id])) if len(contacts) else None
        )
        return MetObject(
            obj, intervals, met.hits.count, met.contacts.count, first_contact, length, met.points,
            met.deepest,
        )  # fmt: skip

    def _proof(self) -> Proof:
        nearest, is_near = 0.0, False
        if self.search is not None and self.first_hit is None:
            nearest = self.search.distance * self.grid.voxel_size
            is_near = self.search.nearest[0] >= 0
        is_inside_known = self.enclosed is not None
        return Proof(self.shell.cover, self.path.off, nearest, is_near, is_inside_known)

    def _result(self, frames: ResidentFrames, elapsed: float) -> Swept:
        path = self.path
        met = [self._met(self.known[i], one) for i, one in self.met.items()]
        met.sort(key=lambda one: (one.first, one.object.id))
        enclosed = [] if self.enclosed is None else self.enclosed.tolist()
        unknown = np.full(self.n_windows, np.nan)
        near = unknown if self.along is None else self.along.least * self.grid.voxel_size
        return Swept(
            path=path,
            voxel_size=self.grid.voxel_size,
            samples=len(path),
            hits=self.hit_runs.count,
            contacts=self.contact_runs.count,
            first_hit=self.first_hit,
            first_contact=self.first_contact,
            deepest=self.deepest,
            objects=met,
            enclosed=tuple(self.known[i] for i in enclosed),
            proof=self._proof(),
            hit_intervals=path.fractions(self.hit_runs.array()),
            contact_intervals=path.fractions(self.contact_runs.array()),
            clearance=self._clearance(frames.residency.exclude),
            profile=Profile(path.fractions(self.begins), self.hits_in, self.depth_in, near),
            revision=frames.residency.revision,
            elapsed=elapsed,
            cells=frames.residency.n_loaded,
            proportions=self._compared(frames.residency.exclude),
            looked=self.looked,
        )

    def _compared(self, exclude: Keys) -> Proportions:
        """Compare tool, path and scene in metres, unless the caller has compared them."""
        if self.asked.proportions is not None:
            return self.asked.proportions
        return compare_proportions(
            self.known.values(), self.grid.voxel_size, self.shell, self.path.poses,
            exclude=exclude.tolist(),
        )  # fmt: skip


def _unpacked(voxel: int) -> Ints:
    """Indices (1, 3) of a packed voxel."""
    return kernels.unpack(np.array([voxel]))
