"""No tool passes through a sheet of one voxel's thickness, whatever the hand does."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from hapticdb import Grid, PointShell
from hapticdb.kernels.hand import coupling as kernels
from hapticdb.kernels.hand.anchors import LOOSE
from hapticdb.kernels.surfaces.voxelize import voxelize
from hapticdb.poses import rotation_of
from realtime.coupled import BITS, SIDE, SIZE, Tool, World, box, numbers_in, punch
from realtime.worlds import block

Floats = NDArray[np.float64]
REACH = 0.05
"""Metres that hands go sideways at most; upwards twice that. Sheets end at the grid's border."""
TOOLS = {
    "ball": PointShell.sphere(0.012, 100),
    "marble": PointShell.sphere(0.002, 30),
    "box": box((0.03, 0.02, 0.01), 150),
    "plate": box((0.04, 0.04, 0.001), 150),
    "needle": box((0.002, 0.002, 0.08), 60),
}


def sheet(normal: Floats, distance: float) -> NDArray[np.int64]:
    """Voxels (n, 3) that a plane meets; `distance` from the grid's middle is in voxels."""
    aside = np.cross(normal, np.eye(3)[int(np.argmin(np.abs(normal)))])
    aside /= np.linalg.norm(aside)
    up = np.cross(normal, aside)
    middle = SIDE / 2 + normal * distance
    corners = [middle + 2 * SIDE * (a * aside + b * up) for a, b in ((1, 1), (1, -1), (-1, -1))]
    corners.append(middle + 2 * SIDE * (up - aside))
    triangles = np.array([corners[:3], [corners[0], *corners[2:]]])
    bricks, occupancy = voxelize(triangles, BITS)
    row, bit = np.nonzero(np.unpackbits(occupancy, axis=1, bitorder="little"))
    return Grid(SIZE, (0.0, 0.0, 0.0), BITS).decode((bricks[row] << 9) | bit)


def is_on_the_entry_side(tool: Tool, normal: Floats, distance: float) -> bool:
    """Whether every point in a free voxel is on the side that the normal points to."""
    voxels = tool.voxels
    inside = ((voxels >= 0) & (voxels < SIDE)).all(axis=1)
    within = voxels[inside]
    is_free = ~tool.world.occupied[tuple(within.T)]
    heights = (within[is_free] + 0.5 - SIDE / 2) @ normal - distance
    return bool((heights > 0.0).all())


def directions() -> st.SearchStrategy[Floats]:
    """Unit vectors: the axes, and any other direction."""
    axes = st.sampled_from([s * a for a in np.eye(3) for s in (-1.0, 1.0)])
    angles = st.tuples(st.floats(-1.0, 1.0), st.floats(0.0, 2.0 * math.pi))
    return axes | angles.map(
        lambda za: np.array(
            [
                math.sqrt(1.0 - za[0] ** 2) * math.cos(za[1]),
                math.sqrt(1.0 - za[0] ** 2) * math.sin(za[1]),
                za[0],
            ]
        )
    )


@pytest.mark.long
@given(
    normal=directions(),
    distance=st.floats(-3.0, 3.0),
    name=st.sampled_from(sorted(TOOLS)),
    contact=st.sampled_from([0.0, 100.0, 1000.0, 30000.0]),
    seed=st.integers(0, 2**32),
)
@settings(max_examples=25, deadline=None)
def test_no_hand_brings_a_tool_through_a_sheet(
    normal: Floats, distance: float, name: str, contact: float, seed: int
) -> None:
    """Hands at up to 5 m/s and 20 rad/s, periods of 0.1 to 4 ms, turns and jumps up to 1 m deep."""
    rng = np.random.default_rng(seed)
    shell = TOOLS[name]
    quaternion = rng.normal(size=4)
    quaternion /= np.linalg.norm(quaternion)
    reach = float(np.linalg.norm(shell.points, axis=1).max())
    start = normal * (distance * SIZE + reach + 3 * SIZE)
    world = World(sheet(normal, distance))
    tool = Tool(world, shell, start, quaternion=quaternion, contact=contact)
    position, n_hit = start.copy(), 0
    for part in range(6):
        velocity = rng.normal(size=3)
        velocity -= normal * 2.0 * max(float(velocity @ normal), 0.0)
        velocity *= rng.uniform(0.1, 5.0) / np.linalg.norm(velocity)
        if part == 4:  # straight out, away from the sheet
            velocity = 5.0 * normal
        turning = rng.normal(size=3) * rng.uniform(0.0, 20.0)
        dt = 10.0 ** rng.uniform(-4.0, -2.4)
        for _ in range(min(round(0.05 / dt), 150)):
            position += velocity * dt
            beside = position - normal * (position @ normal)
            far = float(np.linalg.norm(beside))
            if far > REACH:
                position -= beside * (1.0 - REACH / far)
            position -= normal * max(float(position @ normal) - 2.0 * REACH, 0.0)
            if part == 5 and rng.random() < 0.1:
                position = normal * rng.uniform(-1.0, 0.1)
            if rng.random() < 0.05:
                turned = rng.normal(size=4)
                tool.hand.quaternion[:] = turned / np.linalg.norm(turned)
            tool.hand.position[:] = position
            tool.hand.velocity[:3], tool.hand.velocity[3:] = velocity, turning
            tool.advance(dt)
            n_hit += tool.n_hits > 0
            if not ((tool.voxels > 0) & (tool.voxels < SIDE - 1)).all():
                return  # a jump took the tool to the grid's border, where the sheet ends
            assert is_on_the_entry_side(tool, normal, distance)
            assert np.isfinite(numbers_in(tool.servo["tool"])).all()
            assert (tool.met[2] != LOOSE).all()
    assert n_hit > 0


@pytest.mark.parametrize("name", sorted(TOOLS))
@pytest.mark.parametrize("rate", [1000.0, 5000.0, 10000.0])
@pytest.mark.parametrize("contact", [0.0, 1000.0, 10000.0])
def test_a_hand_through_a_sheet_at_2_metres_a_second_leaves_the_tool_behind(
    name: str, rate: float, contact: float
) -> None:
    middle = SIDE // 2
    world = World(block((0, 0, middle), (SIDE - 1, SIDE - 1, middle)))
    shell = TOOLS[name]
    tool = Tool(world, shell, (0.001, 0.002, 0.08), contact=contact)
    for n in range(round(0.2 * rate)):
        tool.hand.position[2], tool.hand.velocity[2] = 0.08 - 2.0 * n / rate, -2.0
        tool.advance(1.0 / rate)
        assert tool.voxels[:, 2].min() >= middle
    assert tool.n_hits > 0


@pytest.mark.parametrize("rate", [1000.0, 10000.0])
@pytest.mark.parametrize("name", ["ball", "box", "needle"])
def test_a_tool_that_starts_in_something_is_held_by_what_is_farther_away(
    name: str, rate: float
) -> None:
    """The tool starts in a floor's first layer and slides over it against an upright sheet."""
    middle, last = SIDE // 2, SIDE - 1
    at = middle + 20
    shell = TOOLS[name]
    floor = block((0, 0, middle - 1), (last, last, middle - 1))
    world = World(np.concatenate([floor, block((at, 0, middle), (at, last, last))]))
    height = -shell.points[:, 2].min() - 0.3 * SIZE
    tool = Tool(world, shell, (-0.08, 0.002, height), contact=0.0)
    was_loose = False
    for n in range(round(0.2 * rate)):
        tool.hand.position[0], tool.hand.velocity[0] = -0.08 + 2.0 * n / rate, 2.0
        tool.advance(1.0 / rate)
        assert is_on_the_entry_side(tool, np.array([-1.0, 0.0, 0.0]), SIDE / 2 - at - 0.5)
        assert tool.n_hits > 0
        was_loose |= bool((tool.met[2] == LOOSE).any())
    assert was_loose
    assert tool.voxels[:, 0].max() >= at
    tool.hand.position[:] = -0.08, 0.002, 0.1
    tool.hand.velocity[0] = 0.0
    tool.settle(0.5, rate)
    assert tool.state.position == pytest.approx(tool.hand.position, abs=1e-3)
    assert (tool.met[2] != LOOSE).all()


@pytest.mark.parametrize("name", ["ball", "box", "plate", "needle"])
@pytest.mark.parametrize("way", [-1.0, 1.0])
def test_a_tool_that_starts_across_a_sheet_may_leave_by_either_side(name: str, way: float) -> None:
    middle = SIDE // 2
    world = World(block((0, 0, middle), (SIDE - 1, SIDE - 1, middle)))
    shell = TOOLS[name]
    quaternion = np.array([0.9, 0.3, 0.2, 0.1])
    tool = Tool(world, shell, (0.0, 0.0, 0.0), quaternion=quaternion / np.linalg.norm(quaternion))
    tool.advance()
    assert tool.n_hits > 0
    for n in range(300):
        tool.hand.position[2] = way * min(n / 200.0, 1.0) * 0.09
        tool.advance()
    tool.settle(0.3)
    assert tool.state.position[2] == pytest.approx(way * 0.09, abs=1e-3)
    tool.hand.position[2] = -way * 0.09
    tool.settle(0.3)
    assert is_on_the_entry_side(tool, np.array([0.0, 0.0, way]), way * 0.5)


def test_a_blocked_ball_slides_along_the_sheet() -> None:
    """There is no contact force: only shortened steps keep the ball on its side."""
    normal = np.array([0.3, 0.1, 0.9]) / np.linalg.norm([0.3, 0.1, 0.9])
    along = np.cross(normal, [0.0, 1.0, 0.0])
    along /= np.linalg.norm(along)
    world = World(sheet(normal, 0.0))
    tool = Tool(world, TOOLS["ball"], 0.05 * normal, contact=0.0)
    n_cut = 0
    for n in range(600):
        way = min(n / 200.0, 1.0) * (0.05 - 0.005)
        slid = max(n - 200, 0) / 400.0 * 0.08
        tool.hand.position[:] = (0.05 - way) * normal + (slid - 0.02) * along
        tool.advance()
        n_cut += bool(tool.flags & kernels.IS_CUT)
        assert is_on_the_entry_side(tool, normal, 0.0)
    assert n_cut > 10
    assert tool.state.position @ along > 0.04


def test_a_sheet_holds_when_the_cell_of_the_anchors_goes_and_comes_back() -> None:
    """The sheet is the last layer of its cell; the anchors lie in the cell above."""
    side = np.arange(SIDE)
    flat = np.stack(np.meshgrid(side, side, [SIDE // 2 - 1], indexing="ij"), axis=-1)
    world = World(flat.reshape(-1, 3))
    tool = Tool(world, punch(10), (0.0, 0.0, 0.02), contact=20.0)
    tool.settle(0.05)
    tool.hand.position[2] = -0.02
    tool.settle(0.2)
    keys = world.table.cells.keys
    known = keys.copy()
    for is_above_known in (False, True, True):
        keys[:] = known
        if not is_above_known:  # keys of no cell: lookups of others still work
            keys[(known >= 0) & (known & 0xFFFF == 1)] |= 0xFFFE
        tool.state.version[()] = -1  # makes the next frame see another version
        tool.settle(0.2)
        assert tool.n_hits == len(tool.shell)
        assert not tool.sent.unknown
        assert (tool.met[2] != LOOSE).all()
        assert tool.state.position[2] > -SIZE


def test_a_hole_lets_the_tool_through() -> None:
    middle = SIDE // 2
    ijk = block((0, 0, middle), (SIDE - 1, SIDE - 1, middle))
    away = np.abs(ijk[:, :2] + 0.5 - middle).max(axis=1)
    tool = Tool(World(ijk[away > 4.0]), TOOLS["ball"], (0.0, 0.0, 0.05))
    tool.hand.position[2] = -0.05
    tool.settle(0.3)
    assert tool.state.position[2] == pytest.approx(-0.05, abs=1e-3)
    assert rotation_of(tool.state.quaternion)[0] == pytest.approx(np.eye(3), abs=1e-6)
