"""Cells are fetched before the hand arrives, though the database is slow, fails or changes."""

import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import ArrayLike, NDArray

import children
import hapticdb
from hapticdb import Environment, Grid, PointShell
from hapticdb.devices.scripted import RandomHand
from hapticdb.errors import DatabaseError, HapticDBError
from hapticdb.kernels.period.telling import name_voxels
from hapticdb.kernels.records.cells import PREFETCH_REQUEST
from hapticdb.kernels.resident.cells import cell_key
from hapticdb.resident.table import CellTable
from hapticdb.session.prefetch.fetching import CONFIRM_EVERY, Fetcher, FetchRequest
from hapticdb.session.prefetch.resident_cells import ResidentCells
from hapticdb.session.prefetch.tracking import PrefetchRequest
from naive_frame import touch_of_shell
from session.troubled import refuse, refuse_strangely, troubled
from session.worlds import Reader, block, ids_by_voxel, make, move, scatter
from voxels import write_voxels

RADIUS_M = 0.012
"""Radius of the tool in metres, as a session reports it."""
Pose = NDArray[np.float64]


def until(claim: Callable[[], object], do: Callable[[], object] = lambda: None) -> None:
    """Wait until a claim holds while an action is repeated."""
    children.until(lambda: (do(), claim())[1], 1e-3)


class Side:
    """A session as the prefetch process meets it: it writes its state, and runs frames."""

    def __init__(self, table: CellTable, grid: Grid, shell: PointShell) -> None:
        self.reader = Reader(table, grid, shell)
        self.grid = grid
        self.row = self.reader.row
        self.session = table.queue.requests[self.row, ...]

    def be_at(
        self, pose: Pose, velocity: NDArray[np.float64] | None = None
    ) -> tuple[list[int], bytes, int]:
        """Run a frame, write the state; return the frame's hits, wrench and unknown points."""
        found = self.reader.evaluate(pose)
        told, missed = self.session["prefetch"], self.reader.missed
        told["is_active"], told["radius"] = True, RADIUS_M
        told["tool"] = told["handle"] = pose[:3, 3]
        told["velocity"] = 0.0 if velocity is None else velocity[:3]
        self.session["missed"] = missed
        self.session["sequence"] += 2
        return found

    def name(self, pose: Pose, n_hits: int) -> None:
        """Ask for the objects at the last frame's hits."""
        name_voxels(
            self.session[()], self.reader.clusters, pose, self.reader.place, self.grid.bits,
            self.grid.curve_code, self.reader.hits, n_hits,
        )  # fmt: skip

    @property
    def is_served(self) -> bool:
        row = self.session
        return bool(row["heard"] >= row["sequence"] and row["n_missing"] == 0)

    @property
    def ids(self) -> list[int]:
        return sorted(self.session["objects"][: int(self.session["n_objects"])].tolist())


class LockStep:
    """A hand, its frames and the prefetch process on one clock, which only `wait` moves.

    During a slow round trip to the database the hand moves on and its frames run.
    """

    def __init__(
        self,
        env: Environment,
        shell: PointShell,
        budget: int = 8 << 20,
        **trouble: Any,  # noqa: ANN401 - see `Troubled`
    ) -> None:
        self.now = 0.0
        self.table = CellTable.create(budget)
        wrap = functools.partial(troubled, wait=self.wait, **trouble)
        self.unknown = self.frames = self.hit_frames = 0
        self.hand: RandomHand | None = None
        self.is_served = False
        self.pose = np.eye(4)
        self.pose[:3, 3] = np.array(env.grid.origin) + env.grid.edge / 2
        self.side = Side(self.table, env.grid, shell)
        self.fetcher = Fetcher(
            FetchRequest(env.url, self.table, env.grid, wrap=wrap), clock=lambda: self.now
        )

    def wait(self, seconds: float) -> None:
        """Let so many seconds pass, with a frame each millisecond."""
        end = self.now + seconds
        while self.now < end:
            self.now = min(self.now + 1e-3, end)
            self.frame()

    def frame(self) -> None:
        velocity = None
        if self.hand is not None:
            reading = self.hand.read()
            self.pose, velocity = reading.pose.copy(), reading.velocity
        hits, _, unknown = self.side.be_at(self.pose, velocity)
        if self.hand is not None:
            self.frames += 1
            self.unknown += unknown > 0
            self.hit_frames += bool(hits)
            if self.frames % 10 == 0:
                self.side.name(self.pose, len(hits))

    def round(self) -> None:
        self.fetcher.round()
        self.is_served = self.side.is_served  # read before the next frame writes its state
        self.wait(1e-3)

    def warm_start(self) -> None:
        self.frame()
        for _ in range(1000):
            self.round()
            if self.is_served:
                return
        raise AssertionError("never warm")

    def run(self, seconds: float) -> None:
        end = self.now + seconds
        while self.now < end:
            self.round()


@pytest.fixture
def world(tmp_path: Path) -> Environment:
    """An environment of 1 m with 2 mm voxels, scattered objects, and a board below the middle."""
    env = make(tmp_path, bits=9)
    scatter(env, n_objects=8, n_voxels=8000)
    write_voxels(env.store, block((180, 180, 246), (330, 330, 248)), "board")
    return env


def told(*numbers: ArrayLike) -> NDArray[np.void]:
    """What a loop tells of its tool: places of tool and handle, the handle's velocity, radius."""
    return np.array((True, *numbers), PREFETCH_REQUEST)


# --- wanted cells -------------------------------------------------------------------------------


@given(st.integers(0, 10_000))
@settings(deadline=None, max_examples=25)
def test_prefetch_request_cells_nearest_first(seed: int) -> None:
    """All cells within the hand's reach are wanted, also at the border of the grid."""
    grid = Grid(0.002, (0.0, 0.0, 0.0), 8)
    rng = np.random.default_rng(seed)
    tool = rng.uniform(-0.02, grid.edge + 0.02, 3)
    handle = tool + rng.normal(0, 0.02, 3)
    velocity = rng.normal(0, 0.5, 3)
    lookahead, radius = float(rng.uniform(0.05, 0.2)), float(rng.uniform(0.0, 0.05))
    request = PrefetchRequest.of_record(grid, told(tool, handle, velocity, radius), lookahead, 1.0)
    assert request is not None
    cells, urgency = request.cells(grid)
    wanted = set(cells.tolist())
    assert len(wanted) == len(cells)
    assert (np.diff(urgency) >= 0).all()
    for _ in range(200):
        t = rng.uniform()
        reach = radius + 1.5 * lookahead * rng.uniform()  # up to 1.5 times the lookahead, in metres
        off = rng.normal(size=3)
        point = (
            tool + t * (handle + velocity * lookahead - tool) + reach * off / np.linalg.norm(off)
        )
        voxel = grid.voxels_of(point[None])
        if grid.contains(voxel)[0]:
            assert int(cell_key(*voxel[0])) in wanted
    at_tool = grid.voxels_of(tool[None])
    if grid.contains(at_tool)[0]:
        assert urgency[cells.tolist().index(int(cell_key(*at_tool[0])))] == 0.0


def test_prefetch_request_truncated_to_nearest() -> None:
    grid = Grid(0.002, (0.0, 0.0, 0.0), 16)
    tool = np.array([grid.edge * 0.9, 0.1, grid.edge / 2])
    request = PrefetchRequest.of_record(
        grid, told(tool, tool, np.array([40.0, 0.0, 0.0]), 0.05), 0.5, 40.0
    )
    assert request is not None
    cells, _ = request.cells(grid)
    assert 0 < len(cells) <= 1 << 15
    assert int(cell_key(*grid.voxels_of(tool[None])[0])) in cells.tolist()


def test_prefetch_request_non_finite_motion() -> None:
    grid = Grid(0.002, (0.0, 0.0, 0.0), 8)
    rest = np.zeros(3)
    for broken in (np.nan, np.inf):
        nowhere = np.array([0.0, broken, 0.0])
        for motion in (told(rest, rest, nowhere, 0.0), told(rest, rest, rest, broken)):
            assert PrefetchRequest.of_record(grid, motion, 0.1, 1.0) is None


# --- in lock step -------------------------------------------------------------------------------


def test_fetcher_hand_at_1_m_s_no_unknown_cell(world: Environment, sphere: PointShell) -> None:
    step = LockStep(world, sphere, latency=0.010, jitter=0.003)
    step.warm_start()
    step.hand = RandomHand(step.pose, 0, speed=1.0, angular_speed=3.0, clock=lambda: step.now)
    step.run(3.0)
    assert step.frames > 2900
    assert step.hit_frames > 0
    assert step.unknown == 0


def test_fetcher_recovers_from_errors(world: Environment, sphere: PointShell) -> None:
    step = LockStep(world, sphere)
    step.warm_start()
    trouble = functools.partial(troubled, wait=step.wait, latency=0.002, errors=0.1, seed=3)
    step.fetcher.request = FetchRequest(world.url, step.table, world.grid, wrap=trouble)
    step.hand = RandomHand(step.pose, 1, speed=0.6, clock=lambda: step.now)
    n_lost, is_lost = 0, True
    while step.now < 4.0:
        try:
            if is_lost:
                step.fetcher.reopen()
            step.round()
            is_lost = False
            assert not step.table.cells.control["is_lost"]
        except DatabaseError:
            is_lost = True
            n_lost += 1
            before = step.table.cells.control["heartbeat"]
            step.wait(0.01)
            assert step.table.cells.control["heartbeat"] == before
    assert n_lost > 3
    step.hand = None
    step.fetcher.request = FetchRequest(world.url, step.table, world.grid)
    step.fetcher.reopen()
    step.warm_start()
    naive = touch_of_shell(ids_by_voxel(world), world.grid, sphere, step.pose)
    assert step.side.reader.evaluate(step.pose)[0] == naive.hits


def test_fetcher_heartbeat_needs_answer(
    world: Environment, sphere: PointShell, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Silence about commits does not move the heartbeat; the answer to a revision query does."""
    step = LockStep(world, sphere)
    step.warm_start()
    step.run(0.2)
    control = step.table.cells.control
    asked: list[float] = []
    revision = step.fetcher.store.revision

    def counted() -> int:
        asked.append(step.now)
        return revision()

    monkeypatch.setattr(step.fetcher.store, "revision", counted, raising=False)
    until(lambda: bool(asked), step.round)
    heard = int(control["heartbeat"])
    step.run(0.5 * CONFIRM_EVERY)
    assert (len(asked), int(control["heartbeat"])) == (1, heard)
    step.run(CONFIRM_EVERY)
    assert len(asked) == 2
    assert int(control["heartbeat"]) > heard

    def unanswered() -> int:
        raise hapticdb.errors.ConnectionLostError("gone")

    monkeypatch.setattr(step.fetcher.store, "revision", unanswered, raising=False)
    heard = int(control["heartbeat"])
    with pytest.raises(hapticdb.errors.ConnectionLostError):
        step.run(2 * CONFIRM_EVERY)
    assert int(control["heartbeat"]) == heard


def test_fetcher_idle_round_sends_no_query(
    world: Environment, sphere: PointShell, monkeypatch: pytest.MonkeyPatch
) -> None:
    step = LockStep(world, sphere)
    step.warm_start()
    step.round()

    def forbidden(*_: object) -> None:
        raise AssertionError

    for name in ("scan", "lookup", "revision", "snapshot"):
        monkeypatch.setattr(step.fetcher.store, name, forbidden, raising=False)
    monkeypatch.setattr(step.fetcher.residency, "missing", forbidden)
    for _ in range(20):
        step.round()
    assert step.is_served


def test_fetcher_object_names_after_writes(tmp_path: Path, sphere: PointShell) -> None:
    env = make(tmp_path)
    first = write_voxels(env.store, block((50, 50, 58), (78, 78, 63)), "first")
    step = LockStep(env, sphere)
    step.warm_start()

    def asked() -> list[int]:
        step.side.name(step.pose, len(step.side.be_at(step.pose)[0]))
        for _ in range(12):
            step.round()
        return step.side.ids

    assert asked() == [first]
    second = write_voxels(env.store, block((50, 50, 58), (78, 78, 63)), "second")
    assert asked() == [first, second]
    env.remove(first)
    assert asked() == [second]
    env.remove(second)
    assert asked() == []


# --- with a process of its own ------------------------------------------------------------------


@pytest.fixture
def resident(world: Environment) -> Iterator[ResidentCells]:
    with ResidentCells(world.url, budget_bytes=8 << 20) as cells:
        yield cells


def test_resident_cells_prefetch_and_follow_writes(
    world: Environment, resident: ResidentCells, sphere: PointShell
) -> None:
    side = Side(resident.table, world.grid, sphere)
    pose = np.eye(4)
    side.be_at(pose)
    until(lambda: side.is_served)
    naive = touch_of_shell(ids_by_voxel(world), world.grid, sphere, pose)
    assert side.reader.evaluate(pose)[0] == naive.hits
    with hapticdb.open(world.url) as editor:
        move(editor.store, 1, block((240, 240, 240), (270, 270, 256)))
        naive = touch_of_shell(ids_by_voxel(editor), world.grid, sphere, pose)
    assert len(naive.hits) > 10
    until(lambda: side.reader.evaluate(pose)[0] == naive.hits)
    figures = resident.figures()
    assert figures.resident > 0
    assert figures.restarts == figures.losses == 0


def test_resident_cells_start_errors(
    tmp_path: Path, world: Environment, capfd: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(hapticdb.errors.EnvironmentNotFoundError):
        ResidentCells(str(tmp_path / "nothing.db"))
    with pytest.raises(hapticdb.errors.ObjectNotFoundError, match="no object 99"):
        ResidentCells(world.url, exclude=[99])
    with pytest.raises(hapticdb.errors.UsageError, match="give 1048576 or more"):
        ResidentCells(world.url, budget_bytes=1000)
    with pytest.raises(DatabaseError, match=r"^[^\n]* is not for us: ask another$"):
        ResidentCells(world.url, wrap=refuse)
    assert "Traceback" not in capfd.readouterr().err
    with pytest.raises(HapticDBError, match="the session's process ended: ZeroDivisionError"):
        ResidentCells(world.url, wrap=refuse_strangely)
