"""Swept envelopes against dense samples and closed forms; millimetres unless metres are said."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

import hapticdb
from contact_scenes import (
    MM,
    Floats,
    box,
    hollow,
    imported,
    joined,
    pulls,
    rod,
    sheet,
    shell_of,
    turns,
)
from hapticdb import find_clashes, sweep_envelope
from hapticdb.errors import GeometryChangedError, UsageError
from hapticdb.machines import envelope
from hapticdb.mesh import Part
from machines.test_sweep_machine import box as solid
from machines.test_sweep_machine import joint, link, machine_of


def cells_of(part: Part) -> tuple[NDArray[np.bool_], float, Floats]:
    """Voxels inside a part, by the parity of its faces across z; their edge and origin, metres."""
    triangles = part.vertices[part.faces]
    size = float(np.ptp(triangles[0], axis=0).max())
    corners = np.rint(triangles / size).astype(int)
    across = corners[np.ptp(corners[..., 2], axis=1) == 0].min(axis=1)
    walls = np.zeros(corners.max(axis=(0, 1)) + 1, dtype=int)
    np.add.at(walls, tuple(across.T), 1)
    assert set(np.unique(walls)) == {0, 2}
    inside = np.cumsum(walls // 2, axis=2) % 2 == 1
    return inside, size, part.world_from_part[:3, 3]


def n_outside(part: Part, points: Floats) -> int:
    inside, size, origin = cells_of(part)
    at = np.floor((points.reshape(-1, 3) - origin) / size).astype(int)
    is_near = ((at >= 0) & (at < inside.shape)).all(axis=1)
    return int((~is_near).sum() + (~inside[tuple(at[is_near].T)]).sum())


def volume(part: Part) -> float:
    """Of a closed mesh with its faces outward, mm^3."""
    a, b, c = np.moveaxis(part.vertices[part.faces], 1, 0) / MM
    return float((a * np.cross(b, c)).sum() / 6.0)


def points_on(triangles: Floats, n: int, draw: np.random.Generator) -> Floats:
    some = triangles[draw.integers(len(triangles), size=n)]
    weights = draw.dirichlet((0.5, 0.5, 0.5), size=n)
    return np.concatenate([(weights[:, :, None] * some).sum(axis=1), triangles.reshape(-1, 3)])


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    "tool",
    [
        box((120.0, 80.0, 0.1)), sheet(100.0), rod(3.0, 150.0, 8), hollow(80.0, 60.0),
        box((80.0, 80.0, 80.0))[:-2], joined(box((20.0,) * 3), box((20.0,) * 3, (200.0, 0.0, 0.0))),
    ],
)  # fmt: skip
def test_sweep_envelope_contains_the_motion(tool: Floats, seed: int) -> None:
    draw = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (4, 1, 1))
    turns = Rotation.identity(4)
    for n in range(1, 4):
        step = Rotation.from_rotvec(draw.normal(size=3) * draw.choice([0.0, 0.2, 0.8]))
        turns[n] = step * turns[n - 1]
    poses[:, :3, :3] = turns.as_matrix()
    poses[:, :3, 3] = np.cumsum(draw.normal(size=(4, 3)) * 0.05, axis=0)
    part = sweep_envelope(shell_of(tool), poses, "swept", voxel=0.005)
    middle = 0.5 * MM * (tool.min(axis=(0, 1)) + tool.max(axis=(0, 1)))
    centers = poses[:, :3, :3] @ middle + poses[:, :3, 3]
    shares = np.sort(np.append(np.arange(4.0), draw.uniform(0.0, 3.0, 1000)))
    rotations = Slerp(np.arange(4), turns)(shares).as_matrix()
    at = np.stack([np.interp(shares, np.arange(4), one) for one in centers.T], axis=1)
    points = points_on(MM * tool, 200, draw) - middle
    assert n_outside(part, points @ np.swapaxes(rotations, 1, 2) + at[:, None]) == 0


def test_sweep_envelope_of_a_machine_contains_its_links(tmp_path: Path) -> None:
    machine = machine_of(
        tmp_path, link("base", solid("0.2 0.2 0.1")), link("a", solid("0.5 0.05 0.1"), "0.25 0 0"),
        link("b", '<cylinder radius="0.03" length="0.4"/>', "0 0 0.2"),
        joint("j", "base a", "continuous", "0 0 1"),
        joint("k", "a b", "continuous", "1 2 0", "0.5 0 0"),
    )  # fmt: skip
    q, base = np.array([[0.0, 0.0], [4.0, -2.0], [3.0, 3.0]]), np.eye(4)
    base[:3, 3] = 1.0, 2.0, 3.0
    part = sweep_envelope(machine, q, "swept", voxel=0.02, at=base)
    shares = np.linspace(0.0, 2.0, 2000)
    values = machine.values(np.stack([np.interp(shares, range(3), one) for one in q.T], axis=1))
    for number, surface in machine.surfaces.items():
        poses = base @ machine.placed(values, number)
        points = points_on(surface.tree.corners, 100, np.random.default_rng(1))
        placed = points @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
        assert n_outside(part, placed) == 0


@pytest.mark.parametrize("tool", [box((100.0, 60.0, 40.0)), box((100.0, 60.0, 40.0))[:-2]])
def test_sweep_envelope_translation_two_voxels_larger(tool: Floats) -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 0.2
    part = sweep_envelope(shell_of(tool), poses, "swept", voxel=2 * MM)
    assert 300.0 * 60.0 * 40.0 <= volume(part) <= 308.0 * 68.0 * 48.0
    at_rest = sweep_envelope(shell_of(tool), poses[:1], "swept", voxel=2 * MM)
    solid, walls = 108.0 * 68.0 * 48.0, 92.0 * 52.0 * 32.0
    # an open surface at rest encloses nothing
    least = 100.0 * 60.0 * 40.0 if len(tool) == 12 else 0.0
    assert least < volume(at_rest) <= (solid if least else solid - walls)


def test_sweep_envelope_of_a_turn_is_a_sector() -> None:
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, :3, :3] = Rotation.from_euler("z", 90, degrees=True).as_matrix()
    bar = box((100.0, 1.0, 20.0), (50.0, 0.0, 0.0))
    part = sweep_envelope(shell_of(bar), poses, "swept", voxel=MM, about=(0.0, 0.0, 0.0))
    assert (
        n_outside(part, MM * Rotation.from_euler("z", 45, degrees=True).apply(bar.reshape(-1, 3)))
        == 0
    )
    sector = 0.25 * np.pi * 100.0**2 + 100.0
    assert 20.0 * sector <= volume(part) <= 24.0 * (0.25 * np.pi * 102.0**2 + 4.0 * 204.0)


def test_sweep_envelope_voxels_too_small(monkeypatch: pytest.MonkeyPatch) -> None:
    cube, poses = shell_of(box((100.0,) * 3)), np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = 1.0
    for voxel in (0.0, np.nan):
        with pytest.raises(UsageError, match="above 0"):
            sweep_envelope(cube, poses, "swept", voxel=voxel)
    monkeypatch.setattr(envelope, "MOST_CELLS", 1 << 15)
    with pytest.raises(UsageError, match=r"voxels of 0\.1 mm: .* would do$") as found:
        sweep_envelope(cube, poses, "swept", voxel=0.1 * MM)
    would_do = float(str(found.value).split()[-4]) * MM
    assert sweep_envelope(cube, poses, "swept", voxel=would_do)
    with pytest.raises(UsageError, match="would do"):
        sweep_envelope(cube, poses, "swept", voxel=0.95 * would_do)
    turning = turns("z", *range(90, 90 * 300, 90))
    monkeypatch.setattr(envelope, "MOST_VISITS", 5e5)
    with pytest.raises(UsageError, match="would do"):
        sweep_envelope(shell_of(sheet(10.0)), turning, "swept", voxel=MM)
    monkeypatch.undo()
    blunt = replace(cube, chord=MM)
    with pytest.raises(UsageError, match=r"; 4\.048 mm would do"):
        sweep_envelope(blunt, poses[:1], "swept", voxel=2 * MM)


def test_find_clashes_measures_an_envelope_once(tmp_path: Path) -> None:
    scene = {
        "hit": box((20.0,) * 3, (100.0, 35.0, 0.0)), "inside": box((4.0,) * 3, (150.0, 0.0, 0.0)),
        "free": box((20.0,) * 3, (100.0, 100.0, 0.0)), "far": box((9.0,) * 3, (-300.0,) * 3),
        "corner": box((9.0,) * 3, (300.0,) * 3),
    }  # fmt: skip
    shell, path = shell_of(box((60.0, 60.0, 40.0))), pulls((200.0, 0.0, 0.0))
    path[:, :3, 3] *= MM
    imported(tmp_path / "scene.db", scene).close()
    with hapticdb.open(tmp_path / "scene.db") as env:
        env.add(sweep_envelope(shell, path, "swept", voxel=2 * MM))
        found = find_clashes(env)
        assert {(one.a_name, one.kind) for one in found.pairs} == {
            ("hit", "overlapping"), ("inside", "inside"),
        }  # fmt: skip
        env.shift([env.find("free")[0].id], (0.0, -0.06, 0.0))
        again = find_clashes(env)
        assert again.measured <= 2
        assert {one.a_name for one in again.pairs} == {"hit", "inside", "free"}
        other = sweep_envelope(shell, path[:1], "swept", voxel=2 * MM)
        with pytest.raises(GeometryChangedError):
            env.add(other)
        assert env.add(other, replace=True).replaced == 1
        assert len(env.objects()) == len(scene) + 1
