"""Truth by coal's convex solids, mm: contacts, machines, planned paths; a verdict is an error only
where neither rounding nor a tolerance explains it."""

import json
import os
import subprocess
import tempfile
import time
import warnings
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from itertools import chain, combinations, product, takewhile
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

import coal
import numpy as np
import trimesh
from numpy.typing import ArrayLike
from scipy.spatial.transform import RigidTransform, Rotation, Slerp
from trimesh.transformations import random_rotation_matrix, rotation_matrix, translation_matrix

import hapticdb
from batch_peers import MM, Floats, tree_of_boxes
from hapticdb import PointShell
from hapticdb.exact.separation import CONTACT
from hapticdb.exact.swept import Swept
from hapticdb.kernels.triangles.path_distance import MEETING

T = TypeVar("T")
Solid = tuple[Any, Any]
"""coal's solid and its pose, mm."""
Link = tuple[float, Any, float, Floats, bool]
"""Metres from the link before to its joint; coal's solid; its middle; axis; is it a slide?"""
HERE = coal.Transform3s()
DATA = Path(os.environ.get("HAPTICDB_TEST_DATA", "data"))
OPTIONS = hapticdb.ImportOptions(grid=hapticdb.GridOptions(bits=5), distances=False)
SAID = {"hits": "hit", "clear": "clear", "slides": "clear", "overlaps": "clear"}
"""Verdicts in the words of the table; others are undecided."""
PLACES = 400
"""Places of a path at which coal measures. More: thinner collisions are found."""
ROUNDED, ROUND, FREED = 1e-6, 2e-5, CONTACT + 2.0 * MEETING
"""Metres: of rounding; of triangles around a cylinder; depth of a contact of the start, at most."""
RISE = 0.03
"""Metres from the end of a link to the next joint."""
PLANNER = """
import json, sys, time, coal, numpy as np
from ompl import base as ob, geometric as og, util
util.setLogLevel(util.LogLevel.LOG_NONE)
asked, began, told = json.load(sys.stdin), time.monotonic(), []
def solids(boxes):
    return [(coal.Box(*size), coal.Transform3s(np.eye(3), np.array(at))) for size, at in boxes]
def is_valid(state):
    q, at = state.rotation(), np.array([state.getX(), state.getY(), state.getZ()])
    pose = coal.Transform3s(coal.Quaternion(q.w, q.x, q.y, q.z).toRotationMatrix(), at)
    return not any(
        coal.collide(*one, other, pose * own, coal.CollisionRequest(), coal.CollisionResult())
        for one in thing for other, own in tool)
tool, bounds = solids(asked["tool"]), ob.RealVectorBounds(3)
bounds.setLow(-45.0)
bounds.setHigh(45.0)
for seed, scene in enumerate(asked["scenes"]):
    if time.monotonic() - began > asked["seconds"]:
        break
    util.RNG.setSeed(seed + 1)
    thing, space, ends = solids(scene), ob.SE3StateSpace(), []
    space.setBounds(bounds)
    setup = og.SimpleSetup(space)
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


class Case(NamedTuple):
    """One answer beside an oracle's; deviation : of a proved gap below the oracle's, metres;
    group : has a row of its own."""

    said: str
    is_wrong: bool
    deviation: float = 0.0
    group: str = ""


def before(until: float, given: Iterable[T]) -> Iterator[T]:
    """Pass on what is given, until the time is over."""
    return takewhile(lambda _: time.monotonic() < until, given)


@contextmanager
def opened(source: Path | Sequence[trimesh.Trimesh], chord: float | None = None) -> Iterator[Any]:
    """Environment of a file's parts, or of meshes as part0, part1 and so on."""
    with tempfile.TemporaryDirectory() as folder:
        file, url = Path(folder, "s.glb"), Path(folder, "e.db")
        if isinstance(source, Path):
            file = source
        else:
            scene = trimesh.Scene({f"part{n}": mesh for n, mesh in enumerate(source)})
            file.write_bytes(scene.export(file_type="glb"))
        hapticdb.import_files(url, [file], replace(OPTIONS, chord=chord))
        with hapticdb.open(url) as env:
            yield env


def answer(python: str, script: str, asked: object) -> Any:  # noqa: ANN401 - of JSON
    """Answer of a script in another Python."""
    line, pipe, text = [python, "-c", script], subprocess.PIPE, json.dumps(asked)
    done = subprocess.run(line, input=text, stdout=pipe, text=True, check=True, timeout=300)
    return json.loads(done.stdout.splitlines()[-1])


def at(pose: Floats) -> Any:  # noqa: ANN401 - coal has no types
    """coal's pose, mm, of one in metres."""
    return coal.Transform3s(pose[:3, :3].copy(), MM * pose[:3, 3])


def solid(mesh: trimesh.Trimesh) -> Any:  # noqa: ANN401
    """coal's solid of a convex mesh, mm."""
    tree = tree_of_boxes(MM * mesh.vertices, mesh.faces)
    tree.buildConvexRepresentation(False)  # noqa: FBT003 - arguments without names
    return tree.convex


def least_of(pairs: Iterable[tuple[Solid, Solid]]) -> float:
    """Least signed distance of placed solids, metres: below zero, a depth."""
    request = coal.DistanceRequest()  # a depth in a result would end the next query
    return min(float(coal.distance(*a, *b, request, coal.DistanceResult())) for a, b in pairs) / MM


def boxed(size: ArrayLike, middle: ArrayLike) -> trimesh.Trimesh:
    """Box of edges and middle in millimetres."""
    return trimesh.creation.box(np.divide(size, MM), translation_matrix(np.divide(middle, MM)))


def contacts(rng: np.random.Generator) -> Iterator[tuple[Any, list[Any], Any, Floats]]:
    """Thin, touching, buried, coplanar, nested pairs, and labels on open sheets: one of each.

    A thing and the solids for which it stands, a tool and its shift: metres.
    """
    over, wide = rng.choice([0.0, 0.01, 0.03, -0.02, -0.04]), rng.uniform(2.0, 15.0)
    thin, aside = rng.choice([0.05, 0.08, 0.1, 0.5, 0.9]), rng.uniform(-5.0, 5.0, (4, 2))
    block, step = boxed((40, 40, 40), (0, 0, -20)), boxed((10, 40, 20), (15, 0, 10))
    hollow = boxed((20, 20, 20), (0, 0, 0)) + boxed((16, 16, 16), (0, 0, 0)).invert()
    walls = [boxed(20 - 18 * axis, 9 * s * axis) for axis in np.eye(3) for s in (-1, 1)]
    corners = [(-0.02, -0.02, 0), (0.02, -0.02, 0), (0.02, 0.02, 0), (-0.02, 0.02, 0)]
    sheet = trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)]).subdivide().subdivide()
    flush = boxed((wide, 6, 20), (10 - 0.5 * wide, 0, 10 + over))  # with the step's face, too
    rods = [
        trimesh.creation.cylinder(0.5 * w / MM, segment=np.divide(ends, MM), sections=n)
        for w, ends, n in (
            (thin, [(*aside[2], over), (*aside[2], 20 + over)], 12),
            (wide, [(*aside[3], over), (*aside[3], 5 + over)], 24),
        )
    ]
    for thing, solids, tool in (
        (block, [block], boxed((wide, thin, 20), (*aside[0], 10 + over))),
        (block, [block], boxed((wide, 6, thin), (*aside[1], 0.5 * thin + over))),
        (block, [block], rods[0]),
        (block, [block], rods[1]),
        (block, [block], boxed((wide, 5, 5), (0, 0, -rng.uniform(2.52, 36)))),
        (block, [block], boxed((wide, 6, 5), (0, 0, 2.5 - rng.uniform(0.1, 4.9)))),
        (block + step, [block, step], flush),
        (hollow, walls, boxed((8, 5, thin), (0, 0, 0.5 * thin - 8 + over))),
        (sheet, [block], boxed((8, 6, thin), (0, 0, 0.5 * thin + abs(over)))),
    ):
        by = rng.normal(size=3) * rng.choice([0.0, 1.0], 3)
        length = rng.uniform(0.1, 15.0) / MM / (3.0 if thing is sheet else 1.0)
        yield thing, solids, tool, length * by / max(float(np.linalg.norm(by)), 1e-9)


def judged(found: Swept, apart: Floats) -> Case:
    """A verdict beside signed distances along the path.

    A contact of the start may be FREED deep, until it is farther than the tolerance. A hit is
    false if one small shift frees a chord of the solid so shallow.
    """
    said = SAID.get(found.verdict, "undecided")
    left = int(np.argmax(np.append(apart, np.inf) > CONTACT))
    start, later = (float(part.min(initial=np.inf)) for part in (apart[:left], apart[left:]))
    if said == "clear":
        return Case(said, start < -FREED - ROUNDED or later < -ROUNDED)
    is_apart = start > -0.7 * CONTACT and later > MEETING + ROUNDED
    return Case(said, said == "hit" and is_apart)


def in_contact(until: float) -> Iterator[Case]:
    """Public sweeps of tools that touch, in turned frames, by coal's depths."""
    rng = np.random.default_rng(0)
    while time.monotonic() < until:
        made = [one for _ in range(10) for one in contacts(rng)]
        turns = [random_rotation_matrix(rng.random(3)) for _ in made]
        things = [m[0].copy().apply_transform(t) for m, t in zip(made, turns, strict=True)]
        with opened(things) as env:
            for n, (_, solids, tool, by) in before(until, enumerate(made)):
                path = np.array([translation_matrix(x * by) for x in np.linspace(0.0, 1.0, PLACES)])
                shell = PointShell.from_mesh(tool.vertices, tool.faces)
                found = hapticdb.sweep(env, shell, turns[n] @ path[[0, -1]], where=[f"part{n}"])
                still, moving = [(solid(one), HERE) for one in solids], solid(tool)
                apart = [least_of(product(still, [(moving, at(pose))])) for pose in path]
                yield judged(found, np.array(apart))


def compared(found: Swept, least: float, more: float = 0.0) -> Case:
    """A verdict beside coal's least distance; more : that a hit may be apart, metres."""
    said = SAID.get(found.verdict, "undecided")
    if said == "clear":
        off = least - found.gap.at_least
        return Case(said, off < -ROUNDED, off)
    return Case(said, said == "hit" and least > MEETING + more + ROUNDED)


def arm_of(rng: np.random.Generator) -> tuple[str, list[Link]]:
    """URDF and links of a machine: five to seven links in a row."""
    text, links, low = "<robot name='arm'>", list[Link](), 0.0
    for n in range(int(rng.integers(5, 8))):
        x, y, z = rng.uniform((0.01, 0.01, 0.03), (0.02, 0.02, 0.08)).tolist()
        shape, body = f"box size='{x} {y} {z}'", coal.Box(MM * x, MM * y, MM * z)
        if rng.random() < 0.4:
            shape = f"cylinder radius='{0.5 * x}' length='{z}'"
            body = coal.Cylinder(0.5 * MM * x, MM * z)
        axis, is_slide = np.eye(3)[rng.integers(3)], bool(rng.random() < 0.2)
        links.append((low, body, 0.5 * z, axis, is_slide))
        kind = "prismatic" if is_slide else "revolute"
        text += f"""<link name='l{n}'><collision><origin xyz='0 0 {0.5 * z}'/>
            <geometry><{shape}/></geometry></collision></link>"""
        if n:
            text += f"""<joint name='j{n}' type='{kind}'><parent link='l{n - 1}'/>
                <child link='l{n}'/><origin xyz='0 0 {low}'/><axis xyz='{str(axis)[1:-1]}'/>
                <limit lower='-3' upper='3' effort='1' velocity='1'/></joint>"""
        low = z + RISE
    return text + "</robot>", links


def nearest(arm: Sequence[Link], q: Floats, solids: list[Solid]) -> float:
    """Least signed distance, metres, of an arm at joint values from the boxes and from itself."""
    pose, links = np.eye(4), []
    for (low, body, middle, axis, is_slide), value in zip(arm, (0.0, *q), strict=True):
        by = translation_matrix(value * axis) if is_slide else rotation_matrix(value, axis)
        pose = pose @ translation_matrix((0.0, 0.0, low)) @ by
        links.append((body, at(pose @ translation_matrix((0.0, 0.0, middle)))))
    return least_of(chain(product(links, solids), combinations(links, 2)))


def machines(until: float) -> Iterator[Case]:
    """Arms of four to six joints among boxes, and beside themselves, along random joint paths."""
    rng, shares = np.random.default_rng(0), np.linspace(0.0, 2.0, PLACES // 4)
    while time.monotonic() < until:
        text, arm = arm_of(rng)
        middles = rng.uniform((-0.2, -0.2, 0.0), (0.2, 0.2, 0.5), (12, 3))
        placed = RigidTransform.from_components(middles, Rotation.random(12, rng=rng)).as_matrix()
        boxes = [trimesh.creation.box(rng.uniform(0.005, 0.1, 3), pose) for pose in placed]
        solids = [(solid(one), HERE) for one in boxes]
        reach = 0.7 * np.where([is_slide for *_, is_slide in arm[1:]], 0.02, 1.0)
        with tempfile.TemporaryDirectory() as folder, opened(boxes) as env:
            file = Path(folder, "arm.urdf")
            file.write_text(text)
            for rows in before(until, reach * rng.uniform(-1.0, 1.0, (10, 3, len(reach)))):
                if nearest(arm, rows[0], solids) <= 1e-3:
                    continue
                found = hapticdb.sweep_machine(env, file, rows)
                assert not any("not tested" in note for note in found.notes), found.notes
                values = np.stack([np.interp(shares, range(3), one) for one in rows.T], axis=1)
                if found.gap.place is not None:
                    there = found.path.at([found.gap.place.fraction * found.path.length])
                    values = np.concatenate([values, there])
                yield compared(found, min(nearest(arm, q, solids) for q in values), ROUND)


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
        middles = rng.uniform((-40, -40, 8), (40, 40, 20), (4, 3)) * rng.choice([-1, 1], (4, 1))
        scenes.append([*wall, *zip(sizes.tolist(), middles.tolist(), strict=True)])
    asked = {"scenes": scenes, "tool": tool, "seconds": 0.6 * (until - time.monotonic())}
    shapes = [boxed(*one) for one in tool]
    for n, states in answer(python, PLANNER, asked):
        yield followed([boxed(*one) for one in scenes[n]], shapes, np.array(states))


def followed(thing: list[trimesh.Trimesh], tool: list[trimesh.Trimesh], states: Floats) -> Case:
    """One path: straight, with even turns about the tool's origin."""
    given = np.arange(float(len(states)))
    turns = Slerp(given, Rotation.from_quat(states[:, 3:]))

    def poses(when: Floats) -> Floats:
        middles = np.stack([np.interp(when, given, x) for x in states[:, :3].T], axis=1) / MM
        return np.asarray(RigidTransform.from_components(middles, turns(when)).as_matrix())

    whole = trimesh.util.concatenate(tool)
    shell = PointShell.from_mesh(whole.vertices, whole.faces)
    # of turns of almost 180 degrees
    with opened(thing) as env, warnings.catch_warnings(action="ignore"):
        found = hapticdb.sweep(env, shell, poses(given), about=(0.0, 0.0, 0.0))
    dense = poses(np.linspace(0.0, given[-1], PLACES * (len(given) - 1) // 4))
    if found.gap.place is not None:
        dense = np.concatenate([dense, found.gap.place.pose[None]])
    moving = product([solid(one) for one in tool], [at(pose) for pose in dense])
    return compared(found, least_of(product([(solid(one), HERE) for one in thing], moving)))
