"""The virtual coupling against closed forms, and which forces a hand must feel or not feel."""

import math

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticdb import PointShell, UsageError
from hapticdb.kernels.hand import coupling as kernels
from hapticdb.kernels.law import TangentPlaneLaw
from hapticdb.kernels.resident.cells import (
    BUFFERS,
    REVISION,
    VERSION,
    WRENCH,
    Cells,
    end_frame,
)
from hapticdb.kernels.resident.feeling import feel_kernel
from hapticdb.realtime.coupling import Coupling
from hapticdb.testing import write_voxels
from realtime.coupled import SIDE, SIZE, Tool, World, box, punch
from realtime.worlds import block, cells_of

MIDDLE = SIDE // 2
FLOOR = block((MIDDLE - 12, MIDDLE - 12, MIDDLE - 4), (MIDDLE + 11, MIDDLE + 11, MIDDLE - 1))
CORNER = np.unique(
    np.concatenate(
        [
            FLOOR,
            block((MIDDLE - 12, MIDDLE - 12, MIDDLE - 4), (MIDDLE - 1, MIDDLE + 11, MIDDLE + 11)),
            block((MIDDLE - 12, MIDDLE - 12, MIDDLE - 4), (MIDDLE + 11, MIDDLE - 1, MIDDLE + 11)),
        ]
    ),
    axis=0,
)
HOLE = 4
"""Width in voxels of a square hole along the z axis; the peg is made to fit the hole."""


def plate_with_hole() -> NDArray[np.int64]:
    plate = block((MIDDLE - 8, MIDDLE - 8, MIDDLE - 4), (MIDDLE + 7, MIDDLE + 7, MIDDLE + 3))
    half = HOLE // 2
    away = plate[:, :2] - MIDDLE
    return plate[((away < -half) | (away >= half)).any(axis=1)]


PEG = box((HOLE * SIZE + 0.6 * SIZE, HOLE * SIZE + 0.6 * SIZE, 0.03), points=600)


def critically_damped(time: float, step: float) -> float:
    """Tool's way after the handle jumps by d0: m x'' = k (d0 - x) - b x', b = 2 sqrt(k m)."""
    rate = math.sqrt(Coupling().stiffness / Coupling().mass)
    return step * (1.0 - (1.0 + rate * time) * math.exp(-rate * time))


# --- free motion ----------------------------------------------------------------------------------


def test_nothing_is_felt_while_every_point_is_free() -> None:
    tool = Tool(World(FLOOR), PointShell.sphere(0.012), (0.0, 0.0, 0.05))
    rng = np.random.default_rng(0)
    for _ in range(300):
        tool.hand.position[:] = rng.uniform((-0.03, -0.03, 0.05), (0.03, 0.03, 0.11))
        tool.hand.quaternion[:] = rng.normal(size=4)
        tool.hand.quaternion[:] /= np.linalg.norm(tool.hand.quaternion)
        tool.hand.velocity[:] = rng.normal(size=6)
        tool.advance()
        assert tool.n_hits == 0
        assert tool.sent.wrench.tolist() == [0.0] * 6
        assert tool.frame[:6].tolist() == [0.0] * 6


@pytest.mark.parametrize("step", [0.4 * SIZE, 0.05])
def test_free_motion_follows_the_damped_oscillator(step: float) -> None:
    """The error halves with the period: the integration is of first order, no clamp acts."""
    world = World()
    worst = []
    for dt in (1e-4, 5e-5):
        tool = Tool(world, PointShell.sphere(0.012), (0.0, 0.0, 0.0))
        tool.hand.position[0] = step
        errors = []
        for n in range(1, round(0.02 / dt)):
            tool.advance(dt)
            errors.append(abs(tool.state.position[0] - critically_damped(n * dt, step)))
        assert np.allclose(tool.state.position[1:3], 0.0, atol=1e-15)
        worst.append(max(errors) / step)
    assert worst[0] < 0.02
    assert 1.7 < worst[0] / worst[1] < 2.3


def test_a_free_turn_follows_the_damped_oscillator() -> None:
    tool = Tool(World(), PointShell.sphere(0.012), (0.0, 0.0, 0.0))
    tool.hand.quaternion[:] = math.cos(0.4), 0.0, math.sin(0.4), 0.0
    errors = []
    for n in range(1, 200):
        tool.advance(1e-4)
        turned = 2.0 * math.atan2(tool.state.quaternion[2], tool.state.quaternion[0])
        errors.append(abs(turned - critically_damped(n * 1e-4, 0.8)))
    assert max(errors) < 0.02 * 0.8


def test_the_tool_turns_about_its_centre() -> None:
    shell = PointShell.sphere(0.012)
    away = np.array([0.1, 0.0, 0.0])
    shifted = PointShell(shell.points + away, shell.normals, away)
    tool = Tool(World(), shifted, (0.0, 0.0, 0.0))
    half = math.sqrt(0.5)
    tool.hand.position[:] = 0.1, -0.1, 0.0
    tool.hand.quaternion[:] = half, 0.0, 0.0, half  # a quarter turn about the centre
    for _ in range(50):
        tool.advance()
        assert np.allclose(tool.pose[:3, :3] @ shifted.center + tool.pose[:3, 3], (0.1, 0, 0))
    assert np.allclose(tool.state.position, tool.hand.position, atol=1e-4)
    assert np.allclose(tool.state.quaternion, tool.hand.quaternion, atol=1e-4)


def test_a_fast_hand_is_followed_in_free_motion() -> None:
    tool = Tool(World(), PointShell.sphere(0.012), (-0.1, 0.0, 0.0))
    for n in range(200):
        tool.hand.position[0], tool.hand.velocity[0] = -0.1 + 2.0 * n * 1e-3, 2.0
        tool.advance()
    assert abs(tool.state.position[0] - tool.hand.position[0]) < SIZE


def test_quaternions_stay_normal_over_a_million_steps() -> None:
    tool = Tool(World(), PointShell.sphere(0.02, 20), (0.0, 0.0, 0.0))
    n_steps = 0
    rng = np.random.default_rng(0)
    worst = 0.0
    while n_steps < 1_000_000:
        q = rng.normal(size=4)
        tool.hand.quaternion[:] = q / np.linalg.norm(q)
        tool.advance(0.5)
        n_steps += int(tool.sent.n_steps)
        worst = max(worst, abs(float(np.linalg.norm(tool.state.quaternion)) - 1.0))
    assert worst < 1e-12


# --- contact --------------------------------------------------------------------------------------


@pytest.mark.parametrize("rate", [1000.0, 5000.0, 10000.0])
@pytest.mark.parametrize("contact", [1000.0, 10000.0])
@pytest.mark.parametrize(
    ("voxels", "shell", "start", "goal"),
    [
        (FLOOR, PointShell.sphere(0.012), (0.001, 0.002, 0.03), (0.001, 0.002, 0.004)),
        (FLOOR, box((0.02, 0.02, 0.02)), (0.0, 0.001, 0.03), (0.0, 0.001, -0.05)),
        (CORNER, PointShell.sphere(0.012), (0.03, 0.03, 0.03), (0.0, 0.0, 0.0)),
        (CORNER, box((0.02, 0.02, 0.02)), (0.03, 0.03, 0.03), (0.0, 0.0, 0.0)),
        (plate_with_hole(), PEG, (0.0, 0.0, 0.045), (0.0, 0.0, 0.0)),
    ],
    ids=["ball-floor", "box-floor", "ball-corner", "box-corner", "peg-hole"],
)
def test_a_hand_at_rest_brings_the_tool_to_rest(
    voxels: NDArray[np.int64],
    shell: PointShell,
    start: tuple[float, float, float],
    goal: tuple[float, float, float],
    contact: float,
    rate: float,
) -> None:
    tool = Tool(World(voxels), shell, start, contact=contact)
    n_periods = round(0.2 * rate)
    way = (np.array(goal) - start) / n_periods
    for _ in range(n_periods):
        tool.hand.position[:] += way
        tool.hand.velocity[:3] = way * rate
        tool.advance(1.0 / rate)
    tool.hand.velocity[:3] = 0.0
    tool.settle(0.3, rate)
    assert tool.n_hits > 0
    assert tool.is_at_rest
    assert np.linalg.norm(tool.sent.wrench[:3]) <= Coupling().stiffness * SIZE / 2 + 1e-3


@pytest.mark.parametrize("n_across", [2, 3, 6])
@pytest.mark.parametrize("dt", [1e-3, 1e-4])
def test_energy_at_rest_never_grows(n_across: int, dt: float) -> None:
    """The energy's maximum per time window does not rise while all points stay in one layer."""
    shell = punch(n_across)
    tool = Tool(World(FLOOR), shell, (0.0, 0.0, -0.6 * SIZE))
    tool.hand.position[:] = 0.0003, 0.0, -0.95 * SIZE
    share = min(1.0, 10.0 / len(shell))
    body = tool.body
    energies = []
    for _ in range(round(0.2 / dt)):
        tool.advance(dt)
        assert tool.n_hits == len(shell)
        placed = shell.points @ tool.pose[:3, :3].T + tool.pose[:3, 3]
        depths = np.maximum(-0.5 * SIZE - placed[:, 2], 0.0)
        spring = np.linalg.norm(tool.hand.position - tool.state.position)
        turned = 2.0 * np.linalg.norm(tool.state.quaternion[1:])
        energies.append(
            0.5 * body.mass * np.square(tool.state.velocity[:3]).sum()
            + 0.5 * body.inertia * np.square(tool.state.velocity[3:]).sum()
            + 0.5 * share * body.stiffness * np.square(depths).sum()
            + 0.5 * body.spring * spring**2
            + 0.5 * body.turn_spring * turned**2
        )
    highest = np.array(energies).reshape(20, -1).max(axis=1)
    assert (np.diff(highest) <= 1e-12).all()
    assert highest[-1] < highest[0]


@pytest.mark.parametrize("voxels", [plate_with_hole()], ids=["hole"])
def test_a_centred_peg_is_pushed_neither_aside_nor_round(voxels: NDArray[np.int64]) -> None:
    """All four sides reach a little into the wall; the forces cancel up to rounding."""
    half = (HOLE / 2 + 0.7) * SIZE
    across = np.array([-0.6, -0.2, 0.2, 0.6]) * SIZE * HOLE / 2
    points, normals = [], []
    for sign in (-1.0, 1.0):
        for a in across:
            for z in (-1.3 * SIZE, 0.4 * SIZE, 1.3 * SIZE):
                points += [[sign * half, a, z], [a, sign * half, z]]
                normals += [[-sign, 0.0, 0.0], [0.0, -sign, 0.0]]
    tool = Tool(
        World(voxels), PointShell(np.array(points), np.array(normals), np.zeros(3)), (0.0, 0.0, 0.0)
    )
    tool.advance()
    assert tool.n_hits == len(points)
    assert tool.sent.deepest == pytest.approx(0.2 * SIZE)
    assert np.abs(tool.frame[:3]).max() < 1e-12
    assert np.abs(tool.frame[3:6]).max() < 1e-14
    assert np.abs(tool.sent.wrench).max() < 1e-12


def test_a_wedge_on_its_axis_is_only_lifted() -> None:
    """Two faces at 45 degrees in a symmetric groove give no sideways force."""
    groove = FLOOR[(FLOOR[:, 0] < MIDDLE - 1) | (FLOOR[:, 0] > MIDDLE)]
    slope = math.sqrt(0.5)
    points, normals = [], []
    for sign in (-1.0, 1.0):
        for y in (-1.5, -0.5, 0.5, 1.5):
            for along in (1.25, 1.5, 1.9):
                points.append([sign * along * SIZE, y * SIZE, (along - 2.2) * SIZE])
                normals.append([-sign * slope, 0.0, slope])
    tool = Tool(
        World(groove), PointShell(np.array(points), np.array(normals), np.zeros(3)), (0.0, 0.0, 0.0)
    )
    tool.advance(1e-9)
    assert tool.n_hits == len(points)
    assert tool.frame[2] > 0.1
    assert abs(tool.frame[0]) < 1e-12
    assert abs(tool.frame[1]) < 1e-12
    assert np.abs(tool.frame[3:6]).max() < 1e-14


def test_the_spring_is_clamped_while_a_point_hits() -> None:
    tool = Tool(World(FLOOR), box((0.02, 0.02, 0.02)), (0.0, 0.0, 0.02))
    for depth in (0.01, 0.1, 1.0):
        tool.hand.position[2] = 0.01 - depth
        tool.settle(0.3)
        assert tool.n_hits > 0
        push = tool.body.spring * SIZE / 2
        assert np.linalg.norm(tool.sent.wrench[:3]) == pytest.approx(push, rel=0.02)
        assert tool.sent.wrench[2] > 0.9 * push


def test_the_contact_wrench_is_that_of_the_recorded_pose() -> None:
    tool = Tool(World(FLOOR), PointShell.sphere(0.012), (0.001, 0.002, 0.02), contact=3000.0)
    tool.hand.position[:] = 0.02, 0.0, 0.0
    tool.hand.velocity[3] = 1.0
    again = np.zeros((1, len(tool.frame)))
    n_felt = 0
    for _ in range(100):
        tool.advance()
        feel_kernel(
            tool.world.table.cells, tool.row, tool.clusters, tool.pose[None], tool.place,
            TangentPlaneLaw(3000.0), np.empty(len(tool.shell), dtype=np.int64),
            np.zeros(64, dtype=np.int64), again,
        )  # fmt: skip
        assert again[0].tobytes() == tool.frame.tobytes()
        n_felt += bool(again[0, WRENCH : WRENCH + 6].any())
    assert n_felt > 30


# --- unknown cells --------------------------------------------------------------------------------


def half_known() -> World:
    """A wall along a border of cells; the cells beyond the border, k >= 32, are not loaded."""
    world = World(block((20, 20, 30), (43, 43, 30)), is_known=False)
    cells = cells_of(world.grid)
    world.load(cells[(cells & 0xFFFF) == 0])
    return world


def test_the_wrench_is_held_then_fades_while_cells_are_unknown() -> None:
    world = half_known()
    tool = Tool(world, PointShell.sphere(0.004, 100), (0.0, 0.0, -0.03))
    tool.hand.position[2] = 0.0
    tool.settle(0.3)
    pushed = tool.sent.wrench.copy()
    assert pushed[2] < -1.0
    tool.hand.is_stale[()] = 1.0
    resting, shares = tool.placed.copy(), []
    for _ in range(60):
        tool.advance()
        assert tool.placed.tolist() == resting.tolist()
        assert tool.state.velocity.tolist() == [0.0] * 6
        assert tool.flags & kernels.IS_HELD
        shares.append(tool.sent.wrench[2] / pushed[2])
    assert shares[:20] == pytest.approx([1.0] * 20)
    assert shares[29] == pytest.approx(0.5)
    assert shares[40:] == [0.0] * 20
    assert bool(tool.flags & kernels.IS_FADING)
    tool.hand.is_stale[()] = 0.0
    tool.settle(0.1)
    assert np.allclose(tool.sent.wrench, pushed, atol=1e-2)
    assert tool.flags & kernels.IS_HELD == 0


def test_the_tool_waits_at_unknown_cells_and_goes_on_when_they_come() -> None:
    world = half_known()
    tool = Tool(world, PointShell.sphere(0.004, 100), (0.15, 0.0, -0.03))
    tool.hand.position[2] = 0.05
    tool.settle(0.2)
    waiting = tool.placed.copy()
    assert -0.005 - 0.5 * SIZE < waiting[2] <= -0.003
    for _ in range(5):
        tool.advance()
        assert tool.sent.unknown > 0
        assert tool.placed.tolist() == waiting.tolist()
        assert tool.flags & kernels.IS_HELD
        wanted = tool.missed[1 : 1 + tool.missed[0]]
        assert (wanted & 0xFFFF == 1).all()
    world.load(wanted)
    tool.settle(0.3)
    assert tool.sent.unknown == 0
    assert tool.state.position[2] == pytest.approx(0.05, abs=1e-4)


def test_a_frame_has_the_revision_of_the_version_that_it_read(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Not the revision of a later version that reuses the buffer right after the frame."""
    tool = Tool(World(FLOOR), PointShell.sphere(0.012), (0.0, 0.0, 0.05))
    control = tool.world.table.cells.control
    read = float(control[REVISION + control[VERSION] % BUFFERS])

    def end_frame_and_lose_it(cells: Cells, reader: int) -> None:
        end_frame(cells, reader)
        control[REVISION : REVISION + BUFFERS] += 5

    monkeypatch.setattr(kernels, "end_frame", end_frame_and_lose_it)
    for name in ("advance", "move_body"):
        compiled = getattr(kernels, name)
        monkeypatch.setattr(kernels, name, getattr(compiled, "py_func", compiled))
    tool.hand.is_stale[()] = 1.0  # a stale frame skips most of its work
    tool.advance()
    assert tool.sent.revision == read


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_a_hand_that_is_nowhere_moves_nothing(bad: float) -> None:
    tool = Tool(World(FLOOR), PointShell.sphere(0.012), (0.0, 0.0, 0.05))
    numbers = np.ndarray((13,), np.float64, tool.servo["hand"])
    for at in range(13):
        before = numbers[at]
        numbers[at] = bad
        tool.advance()
        assert tool.flags & kernels.IS_HELD
        assert tool.state.position.tolist() == [0.0, 0.0, 0.05]
        numbers[at] = before


def test_what_appears_about_the_tool_lets_it_go_on_either_side() -> None:
    world = World()
    tool = Tool(world, box((0.02, 0.02, 0.02)), (0.0, 0.0, 0.0))
    tool.advance()
    write_voxels(world.environment.store, block((20, 20, MIDDLE), (43, 43, MIDDLE)), "new")
    world.residency.refresh()
    world.load(cells_of(world.grid))
    tool.hand.position[2] = 0.05
    tool.settle(0.3)
    assert tool.state.position[2] == pytest.approx(0.05, abs=1e-3)
    tool.hand.position[2] = -0.05
    tool.settle(0.3)
    assert tool.state.position[2] > 0.01


# --- the body -------------------------------------------------------------------------------------


@given(
    mass=st.floats(1e-3, 1.0),
    stiffness=st.floats(10.0, 1e4),
    reach=st.floats(1e-3, 0.5),
)
@settings(max_examples=30, deadline=None)
def test_moves_and_turns_are_critically_damped(mass: float, stiffness: float, reach: float) -> None:
    place = World().residency.place
    body = Coupling(mass, stiffness).body(PointShell.sphere(reach, 50), place, 1000.0)
    assert body.damping == pytest.approx(2.0 * math.sqrt(body.spring * body.mass))
    assert body.turn_damping == pytest.approx(2.0 * math.sqrt(body.turn_spring * body.inertia))
    assert body.spring / body.mass == pytest.approx(body.turn_spring / body.inertia)
    assert body.radius >= max(reach * (1 - 1e-9), SIZE)


@pytest.mark.parametrize(
    "wrong",
    [{"mass": 0.0}, {"stiffness": -1.0}, {"hold": math.nan}, {"fade": 0.0}, {"most_substeps": 0}],
)
def test_numbers_out_of_range_are_refused(wrong: dict[str, float]) -> None:
    with pytest.raises(UsageError, match=next(iter(wrong)).split("_")[-1]):
        Coupling(**wrong)  # type: ignore[arg-type]


@pytest.mark.parametrize("contact", [-1.0, math.inf])
def test_a_contact_has_a_stiffness(contact: float) -> None:
    with pytest.raises(UsageError, match="stiffness"):
        Coupling().body(PointShell.sphere(0.01), World().residency.place, contact)


@pytest.mark.skipif(bool(numba.config.DISABLE_JIT), reason="the JIT is off: nothing compiles")
def test_one_signature_does_for_every_period() -> None:
    for voxels in (FLOOR, np.empty((0, 3), dtype=np.int64)):
        tool = Tool(World(voxels), PointShell.sphere(0.012), (0.0, 0.0, 0.02))
        tool.hand.position[2] = 0.0
        tool.settle(0.05)
    assert len(kernels.advance.signatures) == 1  # type: ignore[attr-defined]
