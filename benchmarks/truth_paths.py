"""Truth of machines and of planned paths: among boxes and cylinders, coal's own solids."""

import json
import subprocess
import tempfile
import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from itertools import chain, combinations, product
from pathlib import Path
from typing import Any, NamedTuple

import coal
import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

import hapticdb
from hapticdb import Environment, PointShell
from hapticdb.exact.swept import Swept
from hapticdb.kernels.triangles.path_distance import MEETING
from test_mesh_proofs import MM
from truth_shapes import PLACES, ROUNDED, Case, boxed, opened, said_of

Floats = NDArray[np.float64]
Solid = tuple[Any, Any]
"""coal's solid and its pose, mm."""
ROUND = 2e-5
"""Metres by which the triangles around a cylinder are farther out than it."""
PLANNER = """
import json, sys, time, coal, numpy as np
from ompl import base as ob, geometric as og, util

util.setLogLevel(util.LogLevel.LOG_NONE)
asked = json.load(sys.stdin)
began, told = time.monotonic(), []

def solids(boxes):
    return [(coal.Box(*size), coal.Transform3s(np.eye(3), np.array(at))) for size, at in boxes]

for seed, scene in enumerate(asked["scenes"]):
    if time.monotonic() - began > asked["seconds"]:
        break
    util.RNG.setSeed(seed + 1)
    thing, tool, space = solids(scene["thing"]), solids(scene["tool"]), ob.SE3StateSpace()
    bounds = ob.RealVectorBounds(3)
    bounds.setLow(-45.0)
    bounds.setHigh(45.0)
    space.setBounds(bounds)

    def is_valid(state):
        q = state.rotation()
        turn = coal.Quaternion(q.w, q.x, q.y, q.z).toRotationMatrix()
        pose = coal.Transform3s(turn, np.array([state.getX(), state.getY(), state.getZ()]))
        for one, at in thing:
            for other, own in tool:
                asked, found = coal.CollisionRequest(), coal.CollisionResult()
                if coal.collide(one, at, other, pose * own, asked, found):
                    return False
        return True

    setup, ends = og.SimpleSetup(space), []
    setup.setStateValidityChecker(is_valid)
    for height in (30.0, -30.0):
        ends.append(space.allocState())
        ends[-1].setXYZ(0.0, 0.0, height)
        ends[-1].rotation().setIdentity()
    setup.setStartAndGoalStates(*ends)
    setup.setPlanner(og.RRTConnect(setup.getSpaceInformation()))
    if setup.solve(2.0) and setup.haveExactSolutionPath():
        setup.simplifySolution(0.5)
        path, states = setup.getSolutionPath(), []
        for n in range(path.getStateCount()):
            one, q = path.getState(n), path.getState(n).rotation()
            states.append([one.getX(), one.getY(), one.getZ(), q.x, q.y, q.z, q.w])
        told.append([seed, states])
json.dump(told, sys.stdout)
"""


def at(pose: Floats) -> Any:  # noqa: ANN401 - coal has no types
    """coal's pose, mm, of one in metres."""
    return coal.Transform3s(pose[:3, :3].copy(), MM * pose[:3, 3])


def least_of(pairs: Iterable[tuple[Solid, Solid]]) -> float:
    """Least signed distance of placed solids, metres."""
    request, found = coal.DistanceRequest(), coal.DistanceResult()
    return min(float(coal.distance(*a, *b, request, found)) for a, b in pairs) / MM


def scene_of(boxes: Sequence[tuple[Floats, Floats]], folder: str) -> Environment:
    """Environment of boxes: edges (3,) and poses (4, 4), metres."""
    scene = trimesh.Scene()
    for n, (size, pose) in enumerate(boxes):
        made = trimesh.creation.box(size, transform=pose)
        scene.add_geometry(made, node_name=f"box{n}", geom_name=f"box{n}")
    file = Path(folder, "s.glb")
    file.write_bytes(scene.export(file_type="glb"))
    return opened(folder, file)


def compared(found: Swept, least: float, more: float = 0.0) -> Case:
    """A verdict beside coal's least distance; more : that a hit may be apart, metres."""
    said = said_of(found)
    if said == "clear":
        off = least - found.gap.at_least
        return Case(said, off < -ROUNDED, off)
    return Case(said, said == "hit" and least > MEETING + more + ROUNDED)


class Arm(NamedTuple):
    """Links in a row, cylinders or boxes, about their middles; a joint above each but the first."""

    sizes: Floats
    is_round: NDArray[np.bool_]
    axes: NDArray[np.int64]
    is_slide: NDArray[np.bool_]

    def urdf(self) -> str:
        """The machine as a file's text."""
        text = "<robot name='arm'>"
        for n, ((x, y, z), is_round) in enumerate(zip(self.sizes, self.is_round, strict=True)):
            shape = f"cylinder radius='{0.5 * x}' length='{z}'" if is_round else ""
            shape = shape or f"box size='{x} {y} {z}'"
            text += (
                f"<link name='l{n}'><collision><origin xyz='0 0 {0.5 * z}'/><geometry><{shape}/>"
            )
            text += "</geometry></collision></link>"
            if n:
                axis = " ".join("01"[int(k == self.axes[n])] for k in range(3))
                kind = "prismatic" if self.is_slide[n] else "revolute"
                text += f"<joint name='j{n}' type='{kind}'><parent link='l{n - 1}'/>"
                text += f"<child link='l{n}'/><origin xyz='0 0 {self.sizes[n - 1, 2] + 0.03}'/>"
                text += f"<axis xyz='{axis}'/><limit lower='-3' upper='3' effort='1' velocity='1'/>"
                text += "</joint>"
        return text + "</robot>"

    def placed(self, q: Floats) -> list[Solid]:
        """coal's solids at joint values (J,)."""
        pose, out = np.eye(4), []
        for n, (x, y, z) in enumerate(self.sizes):
            if n:
                step = np.eye(4)
                step[2, 3] = self.sizes[n - 1, 2] + 0.03
                by = q[n - 1] * np.eye(3)[self.axes[n]]
                if self.is_slide[n]:
                    step[:3, 3] += by
                else:
                    step[:3, :3] = Rotation.from_rotvec(by).as_matrix()
                pose = pose @ step
            solid = (
                coal.Cylinder(0.5 * MM * x, MM * z)
                if self.is_round[n]
                else coal.Box(MM * x, MM * y, MM * z)
            )
            middle = np.eye(4)
            middle[2, 3] = 0.5 * z
            out.append((solid, at(pose @ middle)))
        return out


def machines(until: float) -> Iterator[Case]:
    """Arms of four to six joints among boxes, and beside themselves, along random joint paths."""
    rng = np.random.default_rng(0)
    while time.monotonic() < until:
        n = int(rng.integers(5, 8))
        arm = Arm(
            rng.uniform((0.01, 0.01, 0.03), (0.02, 0.02, 0.08), (n, 3)), rng.random(n) < 0.4,
            rng.integers(3, size=n), rng.random(n) < 0.2,
        )  # fmt: skip
        boxes = []
        for _ in range(12):
            pose = np.eye(4)
            pose[:3, :3] = Rotation.random(rng=rng).as_matrix()
            pose[:3, 3] = rng.uniform((-0.2, -0.2, 0.0), (0.2, 0.2, 0.5))
            boxes.append((rng.uniform(0.005, 0.1, 3), pose))
        with tempfile.TemporaryDirectory() as folder, scene_of(boxes, folder) as env:
            file = Path(folder, "arm.urdf")
            file.write_text(arm.urdf())
            solids = [(coal.Box(*(MM * size)), at(pose)) for size, pose in boxes]
            for _ in range(10):
                rows = rng.uniform(-0.7, 0.7, (3, n - 1)) * np.where(arm.is_slide[1:], 0.02, 1.0)
                if time.monotonic() < until and nearest(arm, rows[0], solids) > 1e-3:
                    yield moved(env, arm, file, rows, solids)


def nearest(arm: Arm, q: Floats, solids: list[Solid]) -> float:
    """Least signed distance, metres, of an arm from the boxes and from itself."""
    links = arm.placed(q)
    return least_of(chain(product(links, solids), combinations(links, 2)))


def moved(env: Environment, arm: Arm, file: Path, rows: Floats, solids: list[Solid]) -> Case:
    """One joint path."""
    found = hapticdb.sweep_machine(env, file, rows)
    assert not any("not tested" in note for note in found.notes), found.notes
    shares = np.linspace(0.0, len(rows) - 1, PLACES // 4)
    values = np.stack([np.interp(shares, range(len(rows)), one) for one in rows.T], axis=1)
    if found.gap.place is not None:
        there = found.path.at([found.gap.place.fraction * found.path.length])
        values = np.concatenate([values, there])
    return compared(found, min(nearest(arm, q, solids) for q in values), ROUND)


def planned(python: str, until: float) -> Iterator[Case]:
    """OMPL's paths for an L through a window in a thin wall, past thin plates.

    Its motions are validated at places 1 % of the space's extent apart, its default.
    """
    rng, scenes = np.random.default_rng(0), []
    wall = [([30, 90, 0.5], [-30, 0, 0]), ([30, 90, 0.5], [30, 0, 0])]
    wall += [([30, 30, 0.5], [0, 30, 0]), ([30, 30, 0.5], [0, -30, 0])]
    tool = [([24.0, 4.0, 4.0], [0.0, 0.0, 0.0]), ([4.0, 4.0, 16.0], [10.0, 0.0, 6.0])]
    for _ in range(100):
        sizes = rng.uniform(5.0, 30.0, (4, 3))
        sizes[range(4), rng.integers(3, size=4)] = 0.5
        ats = rng.uniform((-40, -40, 8), (40, 40, 20), (4, 3)) * rng.choice([-1, 1], (4, 1))
        scenes.append(
            {"thing": [*wall, *zip(sizes.tolist(), ats.tolist(), strict=True)], "tool": tool}
        )
    asked = {"scenes": scenes, "seconds": 0.6 * (until - time.monotonic())}
    done = subprocess.run(
        [python, "-c", PLANNER], input=json.dumps(asked), capture_output=True, text=True,
        check=True, timeout=300,
    )  # fmt: skip
    shape = trimesh.util.concatenate([boxed(*one) for one in tool])
    shell = PointShell.from_mesh(shape.vertices, shape.faces)
    for n, states in json.loads(done.stdout):
        yield followed(scenes[n], shell, np.array(states))


def followed(scene: dict[str, Any], shell: PointShell, states: Floats) -> Case:
    """One path: straight, with even turns about the tool's origin."""
    shares = np.linspace(0.0, len(states) - 1, PLACES * (len(states) - 1) // 4)
    given = range(len(states))
    turns = Slerp(given, Rotation.from_quat(states[:, 3:]))
    poses, dense = np.tile(np.eye(4), (len(states), 1, 1)), np.tile(np.eye(4), (len(shares), 1, 1))
    for path, when in ((poses, given), (dense, shares)):
        path[:, :3, :3] = turns(when).as_matrix()
        path[:, :3, 3] = np.stack([np.interp(when, given, x) for x in states[:, :3].T], 1) / MM
    boxes = []
    for size, middle in scene["thing"]:
        boxes.append((np.array(size) / MM, np.eye(4)))
        boxes[-1][1][:3, 3] = np.array(middle) / MM
    with (
        tempfile.TemporaryDirectory() as folder,
        scene_of(boxes, folder) as env,
        warnings.catch_warnings(action="ignore"),  # of turns of almost 180 degrees
    ):
        found = hapticdb.sweep(env, shell, poses, about=(0.0, 0.0, 0.0))
    if found.gap.place is not None:
        dense = np.concatenate([dense, found.gap.place.pose[None]])
    solids, tool = [(coal.Box(*(MM * size)), at(pose)) for size, pose in boxes], []
    for size, middle in scene["tool"]:
        own = np.eye(4)
        own[:3, 3] = np.array(middle) / MM
        tool.append((coal.Box(*map(float, size)), own))
    moving = [(part, at(pose @ own)) for pose in dense for part, own in tool]
    return compared(found, least_of(product(moving, solids)))
