"""Truth of contacts, insides and assemblies: coal's convex solids, winding numbers, pairs.

A thing is a union of convex solids, so coal's depths are real ones, in millimetres. A verdict is
wrong only where no rounding and no tolerance excuses it.
"""

import os
import subprocess
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import coal
import numpy as np
import trimesh
from numpy.typing import NDArray

import hapticdb
from hapticdb import Environment, PointShell
from hapticdb.clashes.clash_results import Clash
from hapticdb.exact.separation import CONTACT
from hapticdb.exact.swept import Swept
from hapticdb.ingest.geometry import parts_of
from hapticdb.kernels.triangles.path_distance import MEETING
from test_mesh_proofs import ASSEMBLIES, MM, WITHIN, coal_distance, tree_in_mm

Floats = NDArray[np.float64]
DATA = Path(os.environ.get("HAPTICDB_TEST_DATA", "data"))
OPTIONS = hapticdb.ImportOptions(grid=hapticdb.GridOptions(bits=5), distances=False)
PLACES = 400
"""Places of a path at which coal measures. More: thinner collisions are found."""
ROUNDED = 1e-6
"""Metres: what rounding may add."""
FREED = CONTACT + 2.0 * MEETING
"""Greatest depth that a contact from the start may have, metres."""
DIRTY = (
    "assimp_BoxBadNormals.glb", "trimesh_featuretype.STEP", "trimesh_1002_tray_bottom.STL",
    "trimesh_cube_and_sphere_same_name.3mf",
)  # fmt: skip


CHORD = 3e-7
"""Chord error of STEP files, metres: less than 1 % of their gaps."""
NOMINAL = {"r100_mm": 50e-6, "r10_in": 50.8e-6, "r2_mm": 50e-6, "press_in": -25.4e-6, "r1_m": 50e-6}
"""Half the difference of the diameters of each STEP file, metres."""
STEP = """
from build123d import *
def fit(name, shaft, bore, r_out, long, unit=Unit.MM):
    s = Rot(0, 0, 3.7) * Cylinder(shaft / 2, long)
    b = Cylinder(r_out, long * 0.7) - Cylinder(bore / 2, long * 2)
    s.label, b.label = "shaft", "hub"
    export_step(Compound(label="fit", children=[s, b]), name + ".step", unit=unit)
fit("r100_mm", 100, 100.1, 80, 60)
fit("r10_in", 4, 4.004, 3, 3, Unit.IN)
fit("r2_mm", 2, 2.1, 4, 6)
fit("press_in", 4, 3.998, 3, 3, Unit.IN)
fit("r1_m", 0.1, 0.1001, 0.08, 0.06, Unit.M)
"""


class Case(NamedTuple):
    """One answer beside an oracle's.

    deviation : of a proved gap below the oracle's, metres; group : has a row of its own.
    """

    said: str
    is_wrong: bool
    deviation: float = 0.0
    group: str = ""


def said_of(found: Swept) -> str:
    """Verdict of a sweep in the words of the table."""
    if found.verdict == "hits":
        return "hit"
    return "clear" if found.is_free else "undecided"


def opened(folder: str, file: Path, chord: float | None = None) -> Environment:
    """Environment of a file's parts."""
    url = Path(folder, f"{file.stem}.db")
    hapticdb.import_files(url, [file], replace(OPTIONS, chord=chord))
    return hapticdb.open(url)


def convex(mesh: trimesh.Trimesh) -> Any:  # noqa: ANN401 - coal has no types
    """coal's solid of a convex mesh, millimetres."""
    points, triangles = coal.StdVec_Vec3s(), coal.StdVec_Triangle()
    for at in MM * mesh.vertices:
        points.append(at)
    for face in mesh.faces:
        triangles.append(coal.Triangle(*face.tolist()))
    return coal.Convex(points, triangles)


def depths(solids: Sequence[Any], tool: Any, poses: Floats) -> Floats:  # noqa: ANN401
    """Signed distances of a tool from a union of solids, metres: below zero, its depth in one."""
    request, found, here = coal.DistanceRequest(), coal.DistanceResult(), coal.Transform3s()
    placed = [coal.Transform3s(pose[:3, :3].copy(), MM * pose[:3, 3]) for pose in poses]
    told = []
    for pose in placed:
        told.append(np.inf)
        for one in solids:
            found.clear()
            told[-1] = min(told[-1], coal.distance(one, here, tool, pose, request, found) / MM)
    return np.array(told)


class Contact(NamedTuple):
    """A thing and the solids for which it stands, metres; a tool; how it moves from its place."""

    thing: list[trimesh.Trimesh]
    solids: list[trimesh.Trimesh]
    tool: trimesh.Trimesh
    by: Floats


def boxed(size: Sequence[float], at: Sequence[float]) -> trimesh.Trimesh:
    """Box of edges and middle in millimetres."""
    made = trimesh.creation.box(np.array(size) / MM)
    made.apply_translation(np.array(at) / MM)
    return made


def contacts(rng: np.random.Generator) -> Iterator[Contact]:
    """Thin, touching, buried, coplanar, nested pairs, and labels on open sheets: one of each."""
    block, over = boxed((40, 40, 40), (0, 0, -20)), rng.choice([0.0, 0.01, 0.03, -0.02, -0.04])
    thin, wide = float(rng.choice([0.05, 0.08, 0.1, 0.5, 0.9])), rng.uniform(2.0, 15.0)

    def motion() -> Floats:
        found = rng.normal(size=3) * rng.choice([0.0, 1.0], 3)
        length = rng.uniform(0.1, 15.0) / MM / max(float(np.linalg.norm(found)), 1e-9)
        return np.asarray(length * found)

    tools = [
        boxed((wide, thin, 20), (0, 0, 10 + over)),
        boxed((wide, 6, thin), (0, 0, 0.5 * thin + over)),
        trimesh.creation.cylinder(0.5 * thin / MM, 0.02, sections=12),
        trimesh.creation.cylinder(0.5 * wide / MM, 5e-3, sections=24),
    ]
    tools[2].apply_translation((0, 0, (10 + over) / MM))
    tools[3].apply_translation((0, 0, (2.5 + over) / MM))
    for tool in tools:
        yield Contact([block], [block], tool.apply_translation((*rng.uniform(-5e-3, 5e-3, 2), 0)),
                      motion())  # fmt: skip
    yield Contact([block], [block], boxed((wide, 5, 5), (0, 0, -rng.uniform(2.52, 36))), motion())
    buried = boxed((wide, 6, 5), (0, 0, 2.5 - rng.uniform(0.1, 4.9)))
    yield Contact([block], [block], buried, motion())
    # flush with the face of the step, too
    step = boxed((10, 40, 20), (15, 0, 10))
    flush = boxed((wide, 6, 20), (10 - 0.5 * wide, 0, 10 + over))
    yield Contact([block, step], [block, step], flush, motion())
    hollow = [boxed((20, 20, 20), (0, 0, 0)), boxed((16, 16, 16), (0, 0, 0))]
    hollow[1].invert()
    walls = [
        boxed(20 - 18 * np.eye(3)[n], 9 * side * np.eye(3)[n]) for n in range(3) for side in (-1, 1)
    ]
    low = boxed((8, 5, thin), (0, 0, 0.5 * thin - 8 + over))
    yield Contact([trimesh.util.concatenate(hollow)], walls, low, motion())
    corners = [(-0.02, -0.02, 0), (0.02, -0.02, 0), (0.02, 0.02, 0), (-0.02, 0.02, 0)]
    sheet = trimesh.Trimesh(corners, [(0, 1, 2), (0, 2, 3)]).subdivide().subdivide()
    label = boxed((8, 6, thin), (0, 0, 0.5 * thin + abs(over)))
    yield Contact([sheet], [block], label, motion() / 3.0)


def judged(found: Swept, apart: Floats) -> Case:
    """A verdict beside signed distances along the path.

    A contact of the start may be FREED deep, until it is farther than the tolerance. A hit is
    false if one small shift frees a chord of the solid so shallow.
    """
    said, first = said_of(found), len(apart)
    if apart[0] <= CONTACT:
        first = int(np.argmax(apart > CONTACT)) if (apart > CONTACT).any() else len(apart)
    start, later = apart[:first].min(initial=np.inf), apart[first:].min(initial=np.inf)
    if apart[0] > CONTACT:
        start, later = np.inf, apart.min()
    if said == "clear":
        off = later - found.gap.at_least if apart[0] > CONTACT else 0.0
        return Case(said, start < -FREED - ROUNDED or later < -ROUNDED or off < -ROUNDED, off)
    if said == "hit":
        return Case(said, bool(start > -0.7 * CONTACT and later > MEETING + ROUNDED))
    return Case(said, is_wrong=False)


def in_contact(until: float) -> Iterator[Case]:
    """Public sweeps of tools that touch, by coal's depths."""
    rng, n = np.random.default_rng(0), 0
    while time.monotonic() < until:
        made = [one for _ in range(10) for one in contacts(rng)]
        scene, n = trimesh.Scene(), n + 1
        places = [trimesh.transformations.random_rotation_matrix(rng.random(3)) for _ in made]
        for k, one in enumerate(made):
            thing = trimesh.util.concatenate(one.thing).apply_transform(places[k])
            scene.add_geometry(thing, node_name=f"part{k}", geom_name=f"part{k}")
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder, "s.glb")
            file.write_bytes(scene.export(file_type="glb"))
            with opened(folder, file) as env:
                for k, one in enumerate(made):
                    if time.monotonic() > until:
                        return
                    yield swept_contact(env, f"part{k}", one, places[k])


def swept_contact(env: Environment, name: str, one: Contact, place: Floats) -> Case:
    """One sweep in a turned frame."""
    poses = np.stack([place, place])
    poses[1, :3, 3] += place[:3, :3] @ one.by
    found = hapticdb.sweep(
        env, PointShell.from_mesh(one.tool.vertices, one.tool.faces), poses, where=[name]
    )
    path = np.tile(np.eye(4), (PLACES, 1, 1))
    path[:, :3, 3] = np.linspace(0.0, 1.0, PLACES)[:, None] * one.by
    return judged(found, depths([convex(s) for s in one.solids], convex(one.tool), path))


def windings(triangles: Floats, points: Floats) -> Floats:
    """Winding numbers by closed solid angles (van Oosterom and Strackee 1983)."""
    a, b, c = (triangles[None, :, n] - points[:, None] for n in range(3))
    x, y, z = (np.linalg.norm(one, axis=2) for one in (a, b, c))
    volume = np.einsum("ijk,ijk->ij", a, np.cross(b, c))
    below = x * y * z + z * (a * b).sum(2) + y * (a * c).sum(2) + x * (b * c).sum(2)
    return np.asarray(np.arctan2(volume, below).sum(axis=1) / (2.0 * np.pi))


def insides(until: float) -> Iterator[Case]:
    """A tool of a hundredth of a millimetre in real parts, where winding numbers are whole."""
    rng = np.random.default_rng(0)
    files = [*ASSEMBLIES, *(f"dirty/{name}" for name in DIRTY)]
    share = (until - time.monotonic()) / len(files)
    for name in files:
        with tempfile.TemporaryDirectory() as folder, opened(folder, DATA / name) as env:
            objects = env.objects()
            rng.shuffle(objects)
            end = time.monotonic() + share  # after the import
            for obj, part in parts_of(env.store, objects):
                if time.monotonic() > end:
                    break
                yield from inside(env, obj.id, part.triangles(obj.transform), rng)


def closed_of(triangles: Floats) -> Floats:
    """The triangles of bodies without an open edge."""
    mesh = trimesh.Trimesh(triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3))
    numbers = trimesh.grouping.unique_rows(mesh.edges_sorted)[1]
    is_odd = (np.bincount(numbers) % 2 == 1)[numbers].reshape(-1, 3).any(axis=1)
    body = trimesh.graph.connected_component_labels(mesh.face_adjacency, len(mesh.faces))
    return np.asarray(mesh.triangles[~np.isin(body, body[is_odd])])


def inside(
    env: Environment, name: int, triangles: Floats, rng: np.random.Generator
) -> Iterator[Case]:
    """Places in a part's box, and beside its surface."""
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    on = triangles[rng.integers(len(triangles), size=6)]
    normals = np.cross(on[:, 1] - on[:, 0], on[:, 2] - on[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None] + 1e-30
    near = on.mean(axis=1) + normals * rng.choice([-3e-4, 3e-4, -1e-3, 1e-3], (6, 1))
    points = np.concatenate([rng.uniform(low, high, (6, 3)), near])
    around, closed = windings(triangles, points), windings(closed_of(triangles), points)
    tool = trimesh.creation.icosahedron().apply_scale(5e-6)
    shell, tree, mine = (
        PointShell.from_mesh(tool.vertices, tool.faces),
        tree_in_mm(triangles),
        tree_in_mm(np.asarray(tool.triangles)),
    )
    poses = np.tile(np.eye(4), (len(points), 2, 1, 1))
    poses[:, :, :3, 3] = points[:, None]
    for pose, turns, own in zip(poses, around, closed, strict=True):
        # of an open surface it is no whole number
        is_known = abs(turns - round(turns)) < 1e-4
        if is_known and coal_distance(tree, mine, pose[0]) > 2.0 * CONTACT:
            found = said_of(hapticdb.sweep(env, shell, pose, where=[name]))
            is_wrong = found == ("clear" if round(turns) else "hit")
            torn = "" if round(own) == round(turns) else "inside of bodies with T-junctions"
            yield Case(found, is_wrong, group=torn)


def pairs(until: float) -> Iterator[Case]:
    """Pairs of real assemblies whose boxes are near: kinds and distances beside coal."""
    rng, here = np.random.default_rng(0), np.eye(4)
    share = (until - time.monotonic()) / len(ASSEMBLIES)
    for name in ASSEMBLIES:
        with tempfile.TemporaryDirectory() as folder, opened(folder, DATA / name) as env:
            parts = list(parts_of(env.store, env.objects()))
            told = {one[:2]: one for one in hapticdb.find_clashes(env, within=WITHIN).pairs}
        triangles = {obj.id: part.triangles(obj.transform) for obj, part in parts}
        boxes = {obj.id: obj.bounds for obj, _ in parts}
        near = [
            (a, b)
            for a, b in combinations(sorted(boxes), 2)
            if np.maximum(boxes[a][0] - boxes[b][1], boxes[b][0] - boxes[a][1]).max() <= WITHIN
        ]
        rng.shuffle(near)
        trees: dict[int, Any] = {}
        end = time.monotonic() + share  # of coal alone
        for a, b in near:
            if time.monotonic() > end:
                break
            for one in {a, b} - trees.keys():
                trees[one] = tree_in_mm(triangles[one])
            apart = coal_distance(trees[a], trees[b], here)
            yield pair_case(told.get((a, b)), apart, triangles[a], triangles[b])


def pair_case(found: Clash | None, apart: float, a: Floats, b: Floats) -> Case:
    """One pair; inside : by the winding number of a corner of either."""
    if found is None:
        return Case("clear", apart <= WITHIN - 1e-9)
    if found.kind == "inside":
        holds = windings(a, b[:, 0]), windings(b, a[:, 0])
        return Case("hit", apart > 0.0 and not any((abs(one) > 0.5).any() for one in holds))
    if found.kind == "overlapping":
        return Case("hit", apart > ROUNDED)
    if found.kind in {"touching", "apart"}:
        off = apart - found.at_least
        return Case("clear", off < -1e-9, off)
    return Case("undecided", is_wrong=False)


def step_fits(python: str, until: float) -> Iterator[Case]:
    """Shafts in hubs as true cylinders, files of build123d: their distance beside the nominal."""
    with tempfile.TemporaryDirectory() as folder:
        share = until - time.monotonic()
        subprocess.run([python, "-c", STEP], cwd=folder, check=True, timeout=300)
        until = time.monotonic() + share
        for name, nominal in NOMINAL.items():
            if time.monotonic() > until:
                break
            with opened(folder, Path(folder, f"{name}.step"), CHORD) as env:
                (found,) = hapticdb.find_clashes(env, within=WITHIN, contact=1e-5).pairs
            if found.kind == "overlapping":
                yield Case("hit", nominal > 0.0)
            else:
                said = "clear" if found.kind == "apart" else "undecided"
                off = nominal - found.at_least
                yield Case(said, off < 0.0, off)
