"""The loop, run in this process on a prefetch process's cells: its counts and refusals."""

import dataclasses
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import numpy as np
import pytest
from numpy.typing import NDArray

from hapticdb import PointShell, TangentPlane
from hapticdb.devices.handle import Handle
from hapticdb.devices.profiles import SCRIPTED
from hapticdb.devices.protocol import Device
from hapticdb.devices.scripted import Player
from hapticdb.errors import DeviceError
from hapticdb.recording.frame import State
from hapticdb.session import device_loop as subject
from hapticdb.session.coupling import Coupling
from hapticdb.session.device_loop import DeviceRequest
from hapticdb.session.prefetch.resident_cells import ResidentCells
from hapticdb.session.report import LoopAnswer, counts_of
from hapticdb.session.shared_table import SharedTable
from hapticdb.session.states import SlotRequest
from hapticdb.session.timing import Timing
from hapticdb.session.worker import WorkerRequest, work
from query.test_second_law import Penalty
from session.hands import Clutched, Heard, Lost, Odd, Slow, Unplugged, at, still, stroking
from session.worlds import make
from voxels import floor_voxels, write_voxels

N_RING = 4096
DIRECT = Coupling().direct(SCRIPTED, 1.0, 0.012)
"""What bounds the forces of the tests' loops."""
Floats = NDArray[np.float64]


class Ran(NamedTuple):
    answer: LoopAnswer
    counts: dict[str, Any]
    frames: NDArray[np.void]


Run = Callable[..., Ran]


@pytest.fixture(scope="module")
def cells(tmp_path_factory: pytest.TempPathFactory) -> Iterator[ResidentCells]:
    with make(tmp_path_factory.mktemp("loop"), bits=6) as env:
        write_voxels(env.store, floor_voxels(env.grid, width=48), "floor")
    with ResidentCells(env.url, budget_bytes=4 << 20) as made:
        yield made


@pytest.fixture
def run(cells: ResidentCells, sphere: PointShell, monkeypatch: pytest.MonkeyPatch) -> Iterator[Run]:
    """A function that runs the loop's work in this process and returns its answer and frames."""
    monkeypatch.setattr(
        subject, "parent_is_gone", lambda _=0.0: False
    )  # standard input may be closed
    with cells.table.reading() as row:

        def ran(device: Device, **options: object) -> Ran:
            shared = SharedTable.create(1, N_RING)
            rate = float(str(options.pop("rate", 500.0)))
            law = options.pop("law", TangentPlane())
            alone = DeviceRequest(
                SlotRequest(0, row, cells.grid, sphere, DIRECT), cells.table, device, Handle(),
                seconds=0.3, staleness=60.0,
            )  # fmt: skip
            alone = dataclasses.replace(alone, **options)  # type: ignore[arg-type]
            heard = Heard()
            work(WorkerRequest(shared, Timing(rate), law, "direct", alone), heard)  # type: ignore[arg-type]
            (_, (word, answer)) = heard.said
            assert word == "done"
            frames = shared.rings[0, : answer.loop.frames].copy()
            counts = counts_of(shared.slots[0])
            shared.close()
            return Ran(answer, counts, frames)

        yield ran


def test_loop_ends_with_device_zero_force(run: Run) -> None:
    applied: list[Floats] = []
    hand = Player([0.0, 0.2], [at(0.0, 0.0, 0.010)] * 2)
    hand.apply = applied.append  # type: ignore[assignment]
    answer, counts, frames = run(hand, seconds=1e9)
    # a frame's time is its deadline; a late frame reads the device later than that, and whether
    # there is one at the very end is a matter of nanoseconds
    period = 1.0 / 500.0
    assert frames["time"][-1] >= 0.2 - period - answer.loop.lateness.worst - 1e-6
    assert counts["peak_force"] > 0.0
    assert not applied[-1].any()


def test_loop_slow_hand_misses_deadlines(run: Run) -> None:
    answer, _, frames = run(Slow(still(0.03), every=10, seconds=0.011), seconds=0.5, rate=250.0)
    loop = answer.loop
    assert loop.missed >= len(frames) // 10
    assert loop.frames + loop.missed >= 125
    due = frames["time"] - frames["lateness"].astype(np.float64)
    nth = due * 250.0
    np.testing.assert_allclose(nth, np.round(nth), atol=1e-4)
    np.testing.assert_allclose(np.diff(frames["time"]), frames["dt"][1:], atol=1e-9)


@pytest.mark.long
def test_loop_users_law(run: Run) -> None:
    frames = run(still(0.010), law=Penalty(), seconds=0.2, has_baseline=False).frames
    assert frames["applied"][-1, 2] > 0.0
    with pytest.raises(ValueError, match="this law is off"):
        run(still(0.010), law=Penalty(is_on=False), seconds=0.1, has_baseline=False)


def test_loop_first_clutch_compiles_nothing(run: Run) -> None:
    hand = Clutched(stroking(0.010, 0.5))
    _, _, frames = run(hand, handle=Handle(clutch=0), seconds=60.0)
    is_open = frames["state"] & State.CLUTCH_OPEN > 0
    assert is_open.any()
    assert not is_open.all()
    np.testing.assert_array_equal(is_open, frames["buttons"] & 1 > 0)
    assert not frames["hand_velocity"][is_open].any()


def test_loop_failed_hand_zero_force(run: Run) -> None:
    applied: list[Floats] = []
    hand = Unplugged(still(0.010), 100)
    hand.apply = applied.append  # type: ignore[assignment]
    with pytest.raises(DeviceError, match="unplugged"):
        run(hand, seconds=60.0)
    assert any(wrench.any() for wrench in applied)
    assert not applied[-1].any()


def test_loop_waits_for_first_valid_pose(run: Run) -> None:
    answer, counts, frames = run(Lost(still(0.010), 20, 0.0))
    assert np.isfinite(frames["tool"]).all()
    assert counts["hit_frames"] == len(frames)
    assert answer.is_warm


def test_loop_no_valid_pose(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subject, "WARM_TIMEOUT", 0.05)
    with pytest.raises(DeviceError, match=r"has not said where it is within 0.05 s.*calibration$"):
        run(Lost(still(0.010), 1 << 30, 0.0))


def test_loop_invalid_readings_force_fades(run: Run) -> None:
    nowhere = np.full(6, np.nan)
    hand = Odd(still(0.010), lambda r: r._replace(velocity=nowhere), first=60, n_reads=50)
    hand.over_after = 250
    answer, counts, frames = run(hand, seconds=60.0)
    assert counts["invalid_frames"] == 50
    assert str(answer.bad_reading).startswith("Odd.read() returned numbers that are not finite")
    assert np.isfinite(frames["tool"]).all()
    forces = np.linalg.norm(frames["applied"][:, :3], axis=1)
    assert forces[-1] > 0.0
    assert (forces == 0.0).any()


def test_loop_cold_start(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(subject, "WARM_TIMEOUT", 0.0)
    assert not run(still(0.03)).answer.is_warm


def test_loop_stale_database_holds(run: Run) -> None:
    _, counts, frames = run(still(0.010), staleness=-60.0)
    assert counts["stale_frames"] == counts["held_frames"] == len(frames)
    assert not frames["applied"][frames["time"] > 0.1].any()
