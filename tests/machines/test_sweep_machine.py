"""Sweeps of machines against closed forms and dense samples."""

import tracemalloc
from collections.abc import Iterator
from itertools import count
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

import hapticdb
from hapticdb import Environment, Machine, read_machine, sweep_machine
from hapticdb.errors import UsageError
from hapticdb.exact.swept import Swept
from hapticdb.machines.joint_path import checked_values, joint_path, mover_of
from hapticdb.machines.machine import motion_bounds
from hapticdb.verdicts import PathVerdict

Floats = NDArray[np.float64]

PARTS = {
    "wall": ((0.1, 4.0, 4.0), (2.05, 0.0, 0.0)),
    "post": ((0.02, 0.02, 0.5), (-0.8, 0.0, 0.0)),
    "tank": ((8.0, 8.0, 8.0), (0.0, 20.0, 0.0)),
}
"""Boxes: edges and middles, metres. The wall's side is at x 2."""


@pytest.fixture(scope="module")
def env(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Environment]:
    folder, scene = tmp_path_factory.mktemp("machines"), trimesh.Scene()
    for name, (edges, middle) in PARTS.items():
        made = trimesh.creation.box(edges)
        made.apply_translation(middle)
        scene.add_geometry(made, node_name=name, geom_name=name)
    (folder / "parts.glb").write_bytes(scene.export(file_type="glb"))
    options = hapticdb.ImportOptions(grid=hapticdb.GridOptions(bits=5), distances=False)
    hapticdb.import_files(folder / "parts.db", [folder / "parts.glb"], options)
    with hapticdb.open(folder / "parts.db") as made_env:
        yield made_env


def link(name: str, geometry: str = "", at: str = "0 0 0") -> str:
    solid = f'<collision><origin xyz="{at}"/><geometry>{geometry}</geometry></collision>'
    return f'<link name="{name}">{solid if geometry else ""}</link>'


def joint(name: str, ends: str, kind: str, axis: str, at: str = "0 0 0", more: str = "") -> str:
    parent, child = ends.split()
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{at}"/><axis xyz="{axis}"/>{more}</joint>'
    )


def box(size: str) -> str:
    return f'<box size="{size}"/>'


def machine_of(folder: Path, *texts: str) -> Machine:
    file = folder / "machine.urdf"
    file.write_text(f'<robot name="m">{"".join(texts)}</robot>')
    return read_machine(file)


EXCAVATOR = (
    link("base"), link("boom"), link("stick", '<sphere radius="0.05"/>', "0.7 0 0"),
    joint("shoulder", "base boom", "continuous", "0 -1 0"),
    joint("elbow", "boom stick", "continuous", "0 -1 0", "1 0 0"),
)  # fmt: skip
ARM = (
    link("base"), link("arm", box("1 0.002 0.002"), "0.5 0 0"),
    joint("turn", "base arm", "continuous", "0 0 1"),
)  # fmt: skip


def test_sweep_machine_excavator_closed_form(env: Environment, tmp_path: Path) -> None:
    machine = machine_of(tmp_path, *EXCAVATOR)
    q = np.array([[1.5, 1.0], [-0.2, -1.1], [0.4, 0.9]])
    found = sweep_machine(env, machine, q, where=["wall"])
    shares = np.linspace(0.0, 2.0, 200_001)
    a, b = (np.interp(shares, np.arange(3), column) for column in q.T)
    gap = 2.0 - 0.05 - (np.cos(a) + 0.7 * np.cos(a + b)).max()
    assert found.verdict is PathVerdict.CLEAR
    assert found.gap.at_least <= gap <= found.gap.at_most
    assert found.gap.at_most - found.gap.at_least < 0.01 * gap + 1e-4
    place = found.gap.place
    assert place is not None
    assert (place.body, place.object.name) == ("stick", "wall")
    assert place.on_object[0] == pytest.approx(2.0)
    nearest = found.path.at([place.fraction * found.path.length])[0]
    reach = np.cos(nearest[0]) + 0.7 * np.cos(nearest.sum())
    assert reach == pytest.approx(1.95 - gap, abs=0.01 * gap + 1e-4)


def test_sweep_machine_gaps_bound_the_closed_form_of_objects_and_links(
    env: Environment, tmp_path: Path
) -> None:
    joints = (*EXCAVATOR[3:], joint("fix", "base foot", "fixed", "1 0 0", "1 -0.5 0"))
    links = (*EXCAVATOR[:3], link("foot", box("0.2 0.2 0.2")))
    machine = machine_of(tmp_path, *links, *joints)
    q = np.array([[1.5, 1.0], [1.5, 1.0], [-0.2, -1.1], [0.4, 0.9]])
    found = sweep_machine(env, machine, q, where=["wall"], within=1.0)
    assert found.gaps is not None
    shares = np.linspace(0.0, 3.0, 200_001)
    a, b = (np.interp(shares, np.arange(4), column) for column in q.T)
    x, z = np.cos(a) + 0.7 * np.cos(a + b), np.sin(a) + 0.7 * np.sin(a + b)
    beside = np.maximum(np.abs([x - 1.0, np.full_like(x, 0.5), z]) - 0.1, 0.0)
    gaps = {
        frozenset({"stick", "wall"}): 1.95 - x,
        frozenset({"stick", "foot"}): np.linalg.norm(beside, axis=0) - 0.05,
        frozenset({"foot", "wall"}): np.full_like(x, 0.9),
    }
    assert {frozenset({one.body, one.object.name}) for one in found.gaps.intervals} == gaps.keys()
    for one in found.gaps.intervals:
        least = gaps[frozenset({one.body, one.object.name})][
            (one.begin <= shares) & (shares <= one.end)
        ].min(initial=9.0)
        # the ball is triangles around it, and the samples are apart
        assert one.at_least <= least + 1e-5
        assert least <= one.at_most + 1e-3
        assert one.at_most - one.at_least <= max(1.1e-4, 0.011 * one.at_most)


def test_sweep_machine_gantry_closed_form(env: Environment, tmp_path: Path) -> None:
    cube = box("0.2 0.2 0.2")
    machine = machine_of(
        tmp_path, link("base"), link("bridge"), link("hook", cube),
        joint("x", "base bridge", "prismatic", "1 0 0"),
        joint("z", "bridge hook", "prismatic", "0 0 1"),
    )  # fmt: skip
    free = sweep_machine(env, machine, [[0.0, 1.0], [1.6, 0.0], [1.0, 0.0]], where=["wall"])
    assert free.gap.at_least <= 0.3 <= free.gap.at_most
    hit = sweep_machine(env, machine, [[1.0, 0.0], [3.0, 0.0]], where=["wall"])
    assert hit.verdict is PathVerdict.HITS
    assert hit.hits[0].fraction == pytest.approx(0.45, abs=1e-4)


@pytest.mark.parametrize("degrees", [350.0, 10.0 * 360.0 + 90.0])
def test_sweep_machine_thin_arm_beyond_half_turn(
    env: Environment, tmp_path: Path, degrees: float
) -> None:
    machine = machine_of(tmp_path, *ARM)
    begin = np.radians(200.0)
    found = sweep_machine(env, machine, [[begin], [begin + np.radians(degrees)]], where=["post"])
    assert [place.object.name for place in found.hits] == ["post"]
    met = 2.0 * np.pi - np.arcsin(0.011 / 0.79) + np.pi - begin
    assert found.hits[0].fraction == pytest.approx(met / np.radians(degrees), abs=1e-4)


@pytest.mark.parametrize("end", [0.0, 0.635])
def test_sweep_machine_hit_before_samples_in_wall(
    env: Environment, tmp_path: Path, end: float
) -> None:
    """The arm ends deep in the wall, or the last sample is the only one in it."""
    base = np.eye(4)
    base[0, 3] = 1.2
    found = sweep_machine(
        env, machine_of(tmp_path, *ARM), [[np.pi], [end]], at=base, where=["wall"]
    )
    met = 1e-3 + np.arccos(0.8 / np.hypot(1.0, 1e-3))  # a corner at (1, -1 mm) of the arm
    assert found.hits[0].fraction == pytest.approx((np.pi - met) / (np.pi - end), abs=1e-5)


def test_sweep_machine_mimic_gripper_self_collision(env: Environment, tmp_path: Path) -> None:
    finger = box("0.02 0.02 0.1")
    machine = machine_of(
        tmp_path, link("palm"), link("left", finger), link("right", finger),
        joint("close", "palm left", "prismatic", "0 1 0", "0 -0.1 0"),
        joint("other", "palm right", "prismatic", "0 -1 0", "0 0.1 0",
              '<mimic joint="close" multiplier="0.5"/>'),
    )  # fmt: skip
    assert machine.driven == ("close",)
    free = sweep_machine(env, machine, [[0.0], [0.1], [0.0]], where=["wall"])
    assert free.gap.at_least <= 0.2 - 0.02 - 0.15 <= free.gap.at_most
    hit = sweep_machine(env, machine, [[0.0], [0.15]])
    assert [(place.body, place.object.name) for place in hit.hits] == [("right", "left")]
    assert hit.hits[0].fraction == pytest.approx(0.12 / 0.15, abs=1e-4)
    assert hit.hits[0].on_tool[1] == pytest.approx(-0.1 + 0.12 + 0.01, abs=1e-4)


@pytest.mark.parametrize("rows", [1, 3])
def test_sweep_machine_at_rest_gap(env: Environment, tmp_path: Path, rows: int) -> None:
    found = sweep_machine(env, machine_of(tmp_path, *ARM), np.zeros((rows, 1)), where=["wall"])
    assert (found.verdict, found.path.length) == (PathVerdict.CLEAR, 0.0)
    assert found.gap.at_least <= 1.0 <= found.gap.at_most


def test_sweep_machine_link_inside_body_is_hit(env: Environment, tmp_path: Path) -> None:
    base = np.eye(4)
    base[:3, 3] = 0.0, 20.0, 0.0
    found = sweep_machine(env, machine_of(tmp_path, *ARM), [[0.0], [3.0]], at=base)
    assert found.verdict is PathVerdict.HITS
    assert [obj.name for obj in found.enclosed] == ["tank"]
    assert found.hits[0].body == "arm"


def test_sweep_machine_link_hits_its_base(env: Environment, tmp_path: Path) -> None:
    machine = machine_of(
        tmp_path, link("foot", box("0.4 0.2 0.2")), link("slider", box("0.1 0.1 0.1")),
        joint("slide", "foot slider", "prismatic", "1 0 0", "1 0 0"),
    )  # fmt: skip
    base = np.eye(4)
    base[1, 3] = 40.0
    free = sweep_machine(env, machine, [[0.0], [0.5], [-0.7], [0.2]], at=base)
    assert free.gap.at_least <= 0.05 <= free.gap.at_most
    hit = sweep_machine(env, machine, [[0.0], [0.5], [-1.0]], at=base)
    assert [(place.body, place.object.name) for place in hit.hits] == [("slider", "foot")]
    assert hit.hits[0].fraction == pytest.approx((0.5 + 1.25) / 2.0, abs=1e-4)


@pytest.mark.parametrize("overlap", [0.0, 1e-3])
def test_sweep_machine_base_on_floor(env: Environment, tmp_path: Path, overlap: float) -> None:
    machine = machine_of(
        tmp_path, link("foot", box("0.4 0.2 0.2")), link("arm", box("0.2 0.02 0.02"), "0.3 0 0"),
        joint("turn", "foot arm", "revolute", "1 0 0"),
    )  # fmt: skip
    base = np.eye(4)
    base[0, 3] = 2.3 - overlap  # its left face on the wall's right one
    found = sweep_machine(env, machine, [[0.0], [1.0]], at=base, where=["wall"])
    wanted = PathVerdict.OVERLAPS if overlap else PathVerdict.CLEAR
    assert (found.verdict, found.touching[0].body) == (wanted, "foot")
    assert found.touching[0].until == 1.0
    assert any("foot and arm" in note for note in found.notes)


def test_sweep_machine_joint_limit_note(env: Environment, tmp_path: Path) -> None:
    limited = ARM[2].replace("continuous", "revolute").replace("<axis", '<limit upper="1"/><axis')
    found = sweep_machine(env, machine_of(tmp_path, *ARM[:2], limited), [[0.0], [1.2]])
    assert found.notes == ("joint turn is at 1.2 rad in row 1, above 1, its limit",)


@pytest.mark.parametrize(
    ("q", "told"),
    [([[np.nan]], "row 0"), ([[1.0, 2.0]], "turn"), (np.zeros((0, 1)), "rows"),
     ([[0.0], [1e300]], "row 1"), ([[1e16], [1e16 + 2.0]], "row 0")],
)  # fmt: skip
def test_sweep_machine_bad_joint_values(
    env: Environment,
    tmp_path: Path,
    q: Any,  # noqa: ANN401
    told: str,
) -> None:
    with pytest.raises(UsageError, match=told):
        sweep_machine(env, machine_of(tmp_path, *ARM), q)


def test_sweep_machine_without_joints(env: Environment, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="no joints"):
        sweep_machine(env, machine_of(tmp_path, ARM[1]), np.zeros((1, 0)))


def test_sweep_machine_time_limit(env: Environment, tmp_path: Path) -> None:
    found = sweep_machine(env, machine_of(tmp_path, *EXCAVATOR), [[0.0] * 2], seconds=1e-9)
    assert (found.verdict, found.gap.at_least) == (PathVerdict.NOT_DECIDED, 0.0)


def long_path(rows: int) -> Floats:
    turns = np.linspace(0.0, 2.0 * np.pi, rows)
    return np.stack([np.sin(turns), 1.0 + np.sin(3.0 * turns)], axis=1)


@pytest.mark.parametrize("readings", [10, 40])
def test_sweep_machine_time_limit_within_pieces(
    env: Environment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, readings: int
) -> None:
    """Each reading of the clock takes a second of it."""
    seconds = count()
    clock = SimpleNamespace(monotonic=lambda: float(next(seconds)))
    monkeypatch.setattr("hapticdb.exact.distance.time", clock)
    monkeypatch.setattr("hapticdb.exact.movers.time", clock)
    monkeypatch.setattr("hapticdb.machines.joint_path.AT_ONCE", 256)
    machine = machine_of(tmp_path, *EXCAVATOR)
    found = sweep_machine(env, machine, long_path(4000), seconds=float(readings))
    assert found.verdict is PathVerdict.NOT_DECIDED
    assert next(seconds) <= readings + 3


def test_sweep_machine_in_pieces_has_the_same_answer(
    env: Environment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    machine, q = machine_of(tmp_path, *EXCAVATOR), long_path(300)
    whole = sweep_machine(env, machine, q)
    monkeypatch.setattr("hapticdb.machines.joint_path.AT_ONCE", 64)
    monkeypatch.setattr("hapticdb.machines.machine_sweep.AT_ONCE", 64)
    pieces = sweep_machine(env, machine, q)
    assert np.allclose(pieces.path.parameters, whole.path.parameters, rtol=1e-12)
    assert pieces.gap[:2] == pytest.approx(whole.gap[:2], rel=1e-9)


def test_mover_of_memory_in_proportion(tmp_path: Path) -> None:
    machine, link = machine_of(tmp_path, *EXCAVATOR), (0, 2)
    path, steps = joint_path(machine, checked_values(machine, long_path(40_000)), [link])
    tracemalloc.start()
    try:
        mover = mover_of(machine, path, *link, steps[link], None, np.eye(4))
        left, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    n_poses = len(mover.path.parameters)
    assert left < 170 * n_poses  # its path has 17 numbers a pose
    assert peak < 1000 * n_poses


def random_machine(folder: Path, rng: np.random.Generator) -> Machine:
    """Two arms on a sliding base, of boxes and joints at random."""
    texts, above = [link("base")], "base"
    kinds = ["prismatic", "revolute", "revolute", "revolute", "prismatic", "revolute"]
    for n, kind in enumerate(kinds):
        axis = " ".join(f"{x:.6f}" for x in rng.normal(size=3))
        at = " ".join(f"{x:.6f}" for x in rng.normal(size=3) * 0.3)
        texts += [link(f"link{n}", box("0.15 0.1 0.05"), at)]
        texts += [joint(f"joint{n}", f"{above} link{n}", kind, axis, at)]
        above = "link0" if n == 3 else f"link{n}"
    return machine_of(folder, *texts)


def least_of(machine: Machine, found: Swept, n: int) -> float:
    """Least distance of the links that are tested, at n samples of the path."""
    values = found.path.at(np.linspace(0.0, found.path.length, n))
    least = np.inf
    told = " ".join(found.notes)
    for a in machine.surfaces:
        for b in machine.surfaces:
            if a < b and f"{machine.names[a]} and {machine.names[b]}" not in told:
                poses = np.linalg.inv(machine.placed(values, a)) @ machine.placed(values, b)
                tree = machine.surfaces[a].tree
                near = machine.surfaces[b].nearest(tree, poses, np.full(n, np.inf))
                least = min(least, float(near.at_most.min()))
    return least


@pytest.mark.parametrize("seed", range(6))
def test_sweep_machine_random_never_clear_in_collision(
    env: Environment, tmp_path: Path, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    machine = random_machine(tmp_path, rng)
    q = rng.normal(size=(3, len(machine.driven))) * 0.4
    found = sweep_machine(env, machine, q, where=["post"], exclude=[])
    least = least_of(machine, found, 2000)
    assert found.gap.at_least <= least + 1e-9
    assert (found.verdict is PathVerdict.HITS) or least > 0.0


def test_motion_bounds_of_random_machines(tmp_path: Path) -> None:
    """Speed and second derivative of the box's corners, by differences, in each other's frame."""
    rng = np.random.default_rng(3)
    for _ in range(10):
        machine = random_machine(tmp_path, rng)
        values = checked_values(machine, rng.normal(size=(2, len(machine.driven))))
        shares = np.linspace(0.0, 1.0, 401)[:, None]
        dense = values[0] + shares * (values[1] - values[0])
        for a, b in [(0, 4), (3, 5), (4, 6), (6, 2)]:
            poses = np.linalg.inv(machine.placed(dense, a)) @ machine.placed(dense, b)
            corners = machine.surfaces[b].corners @ np.swapaxes(poses[:, :3, :3], 1, 2)
            corners += poses[:, None, :3, 3]
            speed = 400.0 * np.linalg.norm(np.diff(corners, axis=0), axis=2).max()
            bend = 400.0**2 * np.linalg.norm(np.diff(corners, n=2, axis=0), axis=2).max()
            bounds = motion_bounds(machine, values, a, b, machine.all_placed(values))
            assert speed <= bounds.speed[0] * (1.0 + 1e-9)
            assert bend <= bounds.bend[0] * (1.0 + 1e-6)
