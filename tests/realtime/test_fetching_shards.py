"""The fetching process and sessions while a shard is away and comes back, by itself."""

import functools
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np
import pytest
from numpy.typing import NDArray

from hapticdb import Environment, PointShell
from hapticdb.devices.scripted import Player
from hapticdb.realtime.fetching import Fetcher, FetchRequest
from hapticdb.realtime.resident_cells import ResidentCells
from hapticdb.realtime.session import Session
from hapticdb.resident.outages import ShardOutage, outages_of
from hapticdb.resident.table import AWAY, HEARTBEAT, LEAST_BUDGET, CellTable
from hapticdb.testing import write_voxels
from realtime import sessions
from realtime.halved import SHARD, Halved, halved
from realtime.hands import at
from realtime.sessions import NEVER_STALE, RATE, recorded
from realtime.test_fetching import Side, until
from realtime.worlds import block, expected, ids_by_voxel, make, move

LEFT, RIGHT = at(-0.064, 0.0, 0.0), at(0.064, 0.0, 0.0)
"""Poses in the middles of the halves: the right one is on the shard that may be away."""
PLATE = block((0, 56, 58), (127, 72, 63))
"""Voxels of an object in both halves; its top is at a height of 0."""


class Scene(NamedTuple):
    """A fetcher in this process, with a session in each half; `away` takes the right one away."""

    env: Environment
    fetcher: Fetcher
    left: Side
    right: Side
    away: Path
    shell: PointShell

    @property
    def store(self) -> Halved:
        return cast("Halved", self.fetcher.store)

    def until(self, claim: Callable[[], bool]) -> bool:
        return until(claim, self.fetcher.round)

    def feels(self, side: Side, what: "Felt") -> bool:
        """Whether a session's frame has these hits and no unknown point."""
        hits, _, unknown = side.be_at(what.pose)
        return hits == what.hits and not unknown

    def warm(self) -> "tuple[Felt, Felt]":
        """Bring in the cells of both sessions; what they feel then."""
        felt = felt_at(self.env, self.shell, LEFT), felt_at(self.env, self.shell, RIGHT)
        for side, what in zip((self.left, self.right), felt, strict=True):
            assert self.until(lambda s=side, w=what: self.feels(s, w))  # type: ignore[misc]
        return felt


class Felt(NamedTuple):
    """A pose, and the points that hit there."""

    pose: NDArray[np.float64]
    hits: list[int]


def felt_at(env: Environment, shell: PointShell, pose: NDArray[np.float64]) -> Felt:
    """What a session feels at a pose, by what the database holds there."""
    hits = expected(ids_by_voxel(env), env.grid, shell, pose).hits
    assert hits
    return Felt(pose, hits)


@pytest.fixture
def env(tmp_path: Path) -> Environment:
    made = make(tmp_path)
    write_voxels(made.store, PLATE, "plate")
    return made


@pytest.fixture
def scene(env: Environment, sphere: PointShell, tmp_path: Path) -> Iterator[Scene]:
    away = tmp_path / "away"
    with CellTable.create(LEAST_BUDGET) as table:
        left, right = (Side(table, env.grid, sphere) for _ in range(2))
        request = FetchRequest(
            env.url, table.descriptor, table.n_slots, env.grid,
            wrap=functools.partial(halved, away=str(away)),
        )  # fmt: skip
        fetcher = Fetcher(request)
        fetcher.warm_up()
        yield Scene(env, fetcher, left, right, away, sphere)
        fetcher.close()


def test_a_tool_over_a_shard_that_is_away_feels_nothing_and_others_all(
    scene: Scene,
) -> None:
    scene.away.touch()
    table = scene.fetcher.table
    left, right = felt_at(scene.env, scene.shell, LEFT), felt_at(scene.env, scene.shell, RIGHT)
    assert scene.until(lambda: scene.feels(scene.left, left))
    _, wrench, unknown = scene.right.be_at(RIGHT)
    assert unknown > 0
    assert not np.frombuffer(wrench).any()
    beaten = int(table.cells.control[HEARTBEAT])
    assert scene.until(lambda: int(table.cells.control[HEARTBEAT]) > beaten)
    assert not table.cells.control[AWAY]
    assert scene.until(lambda: scene.right.is_served)  # nobody waits for a shard that is away
    for _ in range(30):
        scene.fetcher.round()
        assert scene.feels(scene.left, left)
        assert scene.right.be_at(RIGHT)[2] == unknown
    scene.away.unlink()
    assert scene.until(lambda: scene.feels(scene.right, right))
    assert table.desk.figures["losses"] == 0


def test_what_is_in_memory_is_felt_while_its_shard_is_away(
    scene: Scene,
) -> None:
    left, right = scene.warm()
    scene.away.touch()
    for _ in range(30):
        scene.fetcher.round()
        assert scene.feels(scene.left, left)
        assert scene.feels(scene.right, right)


def test_an_edit_meanwhile_is_felt_elsewhere_and_makes_touched_cells_unknown(
    scene: Scene,
) -> None:
    left, right = scene.warm()
    scene.away.touch()
    move(scene.env.store, 1, PLATE - np.array([0, 0, 3]))
    revision = scene.env.store.revision()
    assert scene.until(lambda: scene.fetcher.table.revision == revision)
    after = felt_at(scene.env, scene.shell, LEFT), felt_at(scene.env, scene.shell, RIGHT)
    assert after[0].hits != left.hits
    assert after[1].hits != right.hits
    assert scene.feels(scene.left, after[0])
    assert scene.right.be_at(RIGHT)[2] > 0
    scene.away.unlink()
    assert scene.until(lambda: scene.feels(scene.right, after[1]))


def test_a_resting_tool_gets_the_cells_behind_those_that_are_away(
    scene: Scene, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The most urgent cells are away, and fill whole statements, which publish nothing."""
    monkeypatch.setattr("hapticdb.realtime.fetching.BATCH", 1)
    scene.away.touch()
    scene.right.be_at(at(0.03, 0.0, 0.0))  # on the right; it may soon be on the left
    scene.right.session["n_missed"] = 0
    assert scene.until(lambda: scene.right.is_served)
    cells = scene.fetcher.tracker.urgent_cells()
    is_left = cells >> 32 < scene.env.grid.side >> 6
    assert 0 < np.count_nonzero(is_left) < len(cells)
    assert not is_left[0]
    slots_of = scene.fetcher.residency.slots_of
    assert ((slots_of(cells) >= 0) == is_left).all()
    scene.away.unlink()
    assert scene.until(lambda: bool((slots_of(cells) >= 0).all()))


def test_an_unreachable_shard_is_not_asked_in_each_round(scene: Scene) -> None:
    scene.away.touch()
    scene.right.be_at(RIGHT)
    assert scene.until(lambda: scene.right.is_served)
    n_rounds, before = 0, scene.store.n_refused
    scene.fetcher.residency._away._again_at = np.inf  # no time passes in this test
    while n_rounds < 100:
        scene.fetcher.round()
        scene.right.be_at(RIGHT)
        n_rounds += 1
    assert scene.store.n_refused == before


def test_the_desk_tells_which_shard_was_away(scene: Scene) -> None:
    table = scene.fetcher.table
    assert outages_of(table) == ()
    scene.away.touch()
    assert scene.until(lambda: outages_of(table) != () and outages_of(table)[0].seconds > 0.0)
    (told,) = outages_of(table)
    assert told == ShardOutage(SHARD, told.seconds, 1, is_away=True)
    scene.fetcher.count_loss()
    assert not outages_of(table)[0].is_away
    scene.fetcher.reopen()
    assert scene.until(lambda: outages_of(table)[0].is_away)
    scene.away.unlink()
    assert scene.until(lambda: not outages_of(table)[0].is_away)
    assert outages_of(table)[0].times == 2


def test_names_come_for_other_sessions_and_for_this_one_when_its_shard_is_back(
    scene: Scene,
) -> None:
    scene.warm()
    scene.away.touch()
    for side, pose in ((scene.right, RIGHT), (scene.left, LEFT)):
        side.name(pose, len(side.be_at(pose)[0]))
    assert scene.until(lambda: scene.left.ids == [1])
    assert scene.right.ids == []
    assert not scene.fetcher.table.cells.control[AWAY]
    scene.away.unlink()
    assert scene.until(lambda: scene.right.ids == [1])


def test_a_fetching_process_can_begin_while_a_shard_is_away(
    env: Environment, sphere: PointShell, tmp_path: Path
) -> None:
    away = tmp_path / "away"
    away.touch()
    wrap = functools.partial(halved, away=str(away))
    with ResidentCells(env.url, budget_bytes=LEAST_BUDGET, wrap=wrap) as cells:
        side = Side(cells.table, cells.grid, sphere)
        left, right = felt_at(env, sphere, LEFT), felt_at(env, sphere, RIGHT)
        assert until(lambda: side.be_at(LEFT)[0] == left.hits)
        assert until(lambda: cells.shards_away == (SHARD,))
        away.unlink()
        assert until(lambda: side.be_at(RIGHT)[0] == right.hits)
        assert until(lambda: cells.shards_away == ())
        assert cells.restarts == 0


def over(x: float) -> Player:
    """A hand that goes down 10 mm above the plate's middle and back, again and again."""
    heights = [0.02, 0.010, 0.010, 0.02]
    return Player([0.0, 0.1, 0.2, 0.3], [at(x, 0.0, z) for z in heights], loops=True)


def test_sessions_go_on_while_a_shard_is_away(
    env: Environment, sphere: PointShell, tmp_path: Path
) -> None:
    """One session in each half: the left one has no unknown frame; the right one is felt again."""
    away, path = tmp_path / "away", tmp_path / "right.hdbrec"
    wrap = functools.partial(halved, away=str(away))
    options: dict[str, Any] = {"rate": RATE, "staleness": NEVER_STALE, "has_baseline": False}
    with (
        ResidentCells(env.url, budget_bytes=LEAST_BUDGET, wrap=wrap) as cells,
        Session(cells, sphere, over(-0.064), **options) as left,
    ):
        away.touch()
        assert until(lambda: cells.shards_away == (SHARD,))
        with Session(cells, sphere, over(0.064), record=path, **options) as right:
            for is_away in (True, False, True, False):
                away.touch() if is_away else away.unlink()
                assert until(lambda s=is_away: bool(cells.shards_away) == s)  # type: ignore[misc]
                if is_away:
                    move(env.store, 1, PLATE)  # so that nothing of it stays known
                met = "unknown" if is_away else "contacts"
                sessions.until(lambda m=met: meets(right, m), right)  # type: ignore[misc]
                n_frames = right.n_frames
                sessions.until(lambda n=n_frames: right.n_frames > n + 200, right)  # type: ignore[misc]
                assert left.wait(0.02) is None
            reports = left.stop(), right.stop()
    assert [report.unknown_frames > 0 for report in reports] == [False, True]
    assert [report.contact_frames > 0 for report in reports] == [True, True]
    for report in reports:
        assert (report.stale_frames, report.cache.losses, report.cache.restarts) == (0, 0, 0)
        (shard,) = report.cache.shards
        assert shard == ShardOutage(SHARD, shard.seconds, 2, is_away=False)
        assert shard.seconds > 0.3
        cache: Any = report.figures()["cache"]
        assert cache["shards"] == [shard._asdict()]
    check_right(recorded(path))


def meets(session: Session, what: str) -> bool:
    """Whether the last frame has met unknown cells, or contacts."""
    last = session.last()
    return last is not None and bool(last[what][0])


def check_right(frames: NDArray[np.void]) -> None:
    """Forces in known cells, and none after a moment in unknown ones."""
    times, is_unknown = frames["time"], frames["unknown"] > 0
    known_at = np.maximum.accumulate(np.where(is_unknown, -np.inf, times))
    is_over = is_unknown & (times - known_at > 0.1)
    is_pushing = frames["applied"].any(axis=1)
    assert is_over.any()
    assert not np.any(is_pushing & is_over)
    assert (is_pushing & ~is_unknown).any()
