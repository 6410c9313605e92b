"""Truth: verdicts and bounds against oracles of others, a row of a table each.

    HAPTICDB_TEST_DATA=... python benchmarks/truth.py [--seconds 20]    # for each row

coal measures in millimetres. Tight-Inclusion, OMPL (with coal) and build123d run in Pythons of
their own; a row without one is left out. The seconds do not limit rows of given cases.
"""

import argparse
import csv
import tempfile
import time
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import RigidTransform, Rotation
from trimesh.transformations import translation_matrix

import hapticdb
import page_tables
import places  # noqa: F401 - finds `winding`
import records
from batch_peers import Floats, mesh_of
from fits import FITS, STEPS, measured, path
from hapticdb import Environment, PointShell
from hapticdb.clashes.clash_results import Clash
from hapticdb.exact.distance import Pair
from hapticdb.exact.path import ToolPath
from hapticdb.exact.separation import CONTACT
from hapticdb.ingest.geometry import parts_of
from hapticdb.kernels.triangles.path_distance import MEETING, Search
from hapticdb.pointshell.shape import bvh_of
from hapticdb.pointshell.tool_surface import ToolSurface
from test_mesh_proofs import ASSEMBLIES, WITHIN, bracket, clamp, coal_distance, tree_in_mm
from truth_solids import DATA, SAID, Case, answer, before, in_contact, machines, opened, planned
from winding import winding_numbers

POSES = 100
"""Places of a path at which coal measures."""
CHORD = 3e-7
"""Chord error of STEP files, metres: less than 1 % of their gaps."""
PEERS = {"ipctk": "ipctk", "ompl": "ompl and coal", "step": "build123d"}
DIRTY = (
    "assimp_BoxBadNormals.glb", "trimesh_featuretype.STEP", "trimesh_1002_tray_bottom.STL",
    "trimesh_cube_and_sphere_same_name.3mf",
)  # fmt: skip
TIGHT = """
import json, sys, ipctk, numpy as np
told, ccd = [], ipctk.TightInclusionCCD()
for n, corners in json.load(sys.stdin):
    *p, d = np.array(corners)
    q = [one + d if k < n else one for k, one in enumerate(p)]
    told.append(bool((ccd.edge_edge_ccd if n == 2 else ccd.point_triangle_ccd)(*p, *q)[0]))
json.dump(told, sys.stdout)
"""
FITTED = """
import json, sys
from build123d import *
for name, _, unit, shaft, bore, out, long in json.load(sys.stdin):
    s = Rot(0, 0, 3.7) * Cylinder(shaft / 2, long)
    b = Cylinder(out, long * 0.7) - Cylinder(bore / 2, long * 2)
    s.label, b.label = "shaft", "hub"
    export_step(Compound(label="fit", children=[s, b]), name, unit=Unit[unit])
print("null")
"""
SHAFTS = (
    ("0.step", 50e-6, "MM", 100, 100.1, 80, 60), ("1.step", 50.8e-6, "IN", 4, 4.004, 3, 3),
    ("2.step", 50e-6, "MM", 2, 2.1, 4, 6), ("3.step", -25.4e-6, "IN", 4, 3.998, 3, 3),
    ("4.step", 50e-6, "M", 0.1, 0.1001, 0.08, 0.06),
)  # fmt: skip
"""Files; half the difference of the diameters, metres; diameters, radius and length of hubs."""


def away(thing: Floats, tool: Floats, poses: Floats) -> Case:
    """One sweep beside coal at places of the path, and at the nearest place."""
    surface = ToolSurface(PointShell.from_mesh(*mesh_of(tool)))
    pair = Pair(bvh_of(thing), surface, ToolPath.of(poses, surface.corners, np.zeros(3)))
    least, closed = pair.least(0.0, np.inf)
    assert least is not None
    parameters = np.append(np.linspace(0.0, pair.path.length, POSES), least.parameter)
    trees = tree_in_mm(thing), tree_in_mm(tool)
    found = min(coal_distance(*trees, pose) for pose in pair.path.at(parameters))
    # a hit's place is one that coal sees; a gap is below coal's at every place
    if least.at_most <= MEETING:
        return Case("hit", found > MEETING + 1e-7)
    return Case("clear", closed > found + 1e-7, found - closed)


def open_shapes(until: float) -> Iterator[Case]:
    """Brackets and clamps past one another."""
    rng = np.random.default_rng(0)
    while time.monotonic() < until:
        thing, tool = ((bracket, clamp)[n](rng).triangles for n in rng.integers(2, size=2))
        turns, middles = Rotation.random(2, rng=rng), rng.uniform(-0.15, 0.15, (2, 3))
        poses = RigidTransform.from_components(middles, turns).as_matrix()
        yield away(np.asarray(thing), np.asarray(tool), poses)


def nuts(_: float) -> Iterator[Case]:
    """The M16 nut turned by a quarter on its bolt."""
    fit = FITS["M16 nut, half a turn"]
    files = (DATA / "fits" / f"factory_{name}.obj" for name in (fit.hole, fit.peg))
    bolt, nut = (np.asarray(trimesh.load_mesh(file).triangles) for file in files)
    yield away(bolt, nut, path(fit)[: STEPS // 2 + 1])


def pegs(_: float) -> Iterator[Case]:
    """Round pegs drawn out, beside half the difference of the diameters."""
    with tempfile.TemporaryDirectory() as folder:
        for name, fit in FITS.items():
            if fit.nominal_m is not None:
                row = measured(Path(folder), DATA / "fits", name, 6)
                said, off = SAID.get(row["verdict"], "undecided"), fit.nominal_m - row["gap_m"]
                yield Case(said, said == "hit" or off < 0.0, off if said == "clear" else 0.0)


def shafts(python: str, _: float) -> Iterator[Case]:
    """Shafts in hubs as true cylinders, files of build123d: their distance beside the nominal."""
    with tempfile.TemporaryDirectory() as folder:
        answer(python, FITTED, [(f"{folder}/{name}", *rest) for name, *rest in SHAFTS])
        for name, nominal, *_sizes in SHAFTS:
            with opened(Path(folder, name), CHORD) as env:
                (found,) = hapticdb.find_clashes(env, within=WITHIN, contact=1e-5).pairs
            off, is_apart = nominal - found.at_least, found.kind == "apart"
            if found.kind == "overlapping":
                yield Case("hit", nominal > 0.0)
            else:
                said = "clear" if is_apart else "undecided"
                yield Case(said, off < 0.0, off if is_apart else 0.0)


def insides(until: float) -> Iterator[Case]:
    """A tool of a hundredth of a millimetre in real parts, where winding numbers are whole."""
    rng = np.random.default_rng(0)
    files = [*ASSEMBLIES, *(f"dirty/{name}" for name in DIRTY)]
    share = (until - time.monotonic()) / len(files)
    for name in files:
        with opened(DATA / name) as env:
            objects = env.objects()
            rng.shuffle(objects)
            # after the import
            for obj, part in before(time.monotonic() + share, parts_of(env.store, objects)):
                yield from inside(env, obj.id, part.triangles(obj.transform), rng)


def closed_of(triangles: Floats) -> Floats:
    """The triangles of bodies without an open edge."""
    mesh = trimesh.Trimesh(*mesh_of(triangles))
    numbers = trimesh.grouping.unique_rows(mesh.edges_sorted)[1]
    is_odd = (np.bincount(numbers) % 2 == 1)[numbers].reshape(-1, 3).any(axis=1)
    body = trimesh.graph.connected_component_labels(mesh.face_adjacency, len(mesh.faces))
    return np.asarray(mesh.triangles[~np.isin(body, body[is_odd])])


def inside(env: Environment, n: int, triangles: Floats, rng: np.random.Generator) -> Iterator[Case]:
    """Places in a part's box, and beside its surface."""
    on = triangles[rng.integers(len(triangles), size=6)]
    normals = np.cross(on[:, 1] - on[:, 0], on[:, 2] - on[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None] + 1e-30
    near = on.mean(axis=1) + normals * rng.choice([-3e-4, 3e-4, -1e-3, 1e-3], (6, 1))
    box = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    points = np.concatenate([rng.uniform(*box, (6, 3)), near])
    tool = trimesh.creation.icosahedron().apply_scale(5e-6)
    shell = PointShell.from_mesh(tool.vertices, tool.faces)
    trees = tree_in_mm(triangles), tree_in_mm(np.asarray(tool.triangles))
    both = winding_numbers(points, triangles), winding_numbers(points, closed_of(triangles))
    for point, turns, own in zip(points, *both, strict=True):
        pose = translation_matrix(point)
        # of an open surface it is no whole number
        is_known = abs(turns - round(turns)) < 1e-4
        if is_known and coal_distance(*trees, pose) > 2.0 * CONTACT:
            found = hapticdb.sweep(env, shell, np.stack([pose, pose]), where=[n])
            said = SAID.get(found.verdict, "undecided")
            torn = "" if round(own) == round(turns) else "inside of bodies with open edges"
            yield Case(said, said == ("clear" if round(turns) else "hit"), group=torn)


def pairs(until: float) -> Iterator[Case]:
    """Pairs of real assemblies whose boxes are near: kinds and distances beside coal."""
    rng, share = np.random.default_rng(0), (until - time.monotonic()) / len(ASSEMBLIES)
    for name in ASSEMBLIES:
        with opened(DATA / name) as env:
            objects = sorted(env.objects(), key=lambda obj: obj.id)
            parts = [part.triangles(obj.transform) for obj, part in parts_of(env.store, objects)]
            told = {one[:2]: one for one in hapticdb.find_clashes(env, within=WITHIN).pairs}
        low, high = (np.array([get(one, axis=(0, 1)) for one in parts]) for get in (np.min, np.max))
        gaps = np.maximum(low[:, None] - high, low - high[:, None]).max(axis=2)
        near = np.argwhere(np.triu(gaps <= WITHIN, 1))
        rng.shuffle(near)
        trees: dict[int, Any] = {}
        for a, b in before(time.monotonic() + share, near.tolist()):  # share : of coal alone
            trees |= {n: tree_in_mm(parts[n]) for n in (a, b) if n not in trees}
            apart = coal_distance(trees[a], trees[b], np.eye(4))
            yield pair_case(told.get((objects[a].id, objects[b].id)), apart, parts[a], parts[b])


def pair_case(found: Clash | None, apart: float, a: Floats, b: Floats) -> Case:
    """One pair; inside : by the winding number of a corner of either."""
    if found is None:
        return Case("clear", apart <= WITHIN - 1e-9)
    if found.kind == "inside":
        holds = np.concatenate([winding_numbers(b[:, 0], a), winding_numbers(a[:, 0], b)])
        return Case("hit", apart > 0.0 and not (np.abs(holds) > 0.5).any())
    if found.kind == "overlapping":
        return Case("hit", apart > 1e-6)
    off = apart - found.at_least
    is_known = found.kind in {"touching", "apart"}
    return Case("clear", off < -1e-9, off) if is_known else Case("undecided", is_wrong=False)


def shifts() -> Iterator[tuple[int, Floats, bool]]:
    """Public queries: how many of four corners move; corners and shift (5, 3); the exact truth."""
    with (DATA / "ccd" / "translations.csv").open() as file:
        for row in list(csv.reader(file))[1:]:
            corners = np.array(row[2:17], float).reshape(5, 3)
            yield 2 if row[0] == "edge-edge" else 1, corners, row[-1] == "1"


def ccd(_: float) -> Iterator[Case]:
    """Shifted primitives as triangles without area."""
    for n, p, is_hit in shifts():
        tool, thing = p[[0, n - 1, n - 1]], p[[n, 2, 3]]
        poses = np.array([np.eye(4), translation_matrix(p[4])])
        motion = ToolPath.of(poses, tool, tool.mean(axis=0)).motion
        trees = bvh_of(thing[None]), bvh_of(tool[None])
        search = Search(*trees, motion, radius=0.0, begin=0.0, best=2 * MEETING, fine=9e-6)
        assert search.go_on(1 << 40)
        said = bool(search.found.distance[0] <= MEETING)
        yield Case("hit" if said else "clear", said != is_hit)


def tight(python: str, _: float) -> Iterator[Case]:
    """The same by Tight-Inclusion."""
    told = answer(python, TIGHT, [(n, p.tolist()) for n, p, _ in shifts()])
    for said, (_n, _p, is_hit) in zip(told, shifts(), strict=True):
        yield Case("hit" if said else "clear", said != is_hit)


def row_of(what: str, oracle: str, found: list[Case], took: float) -> dict[str, Any]:
    """Counts of cases, said and wrong; gap_below_m : None without a proved gap."""
    row: dict[str, Any] = {"what": what, "oracle": oracle, "cases": len(found)}
    for said in ("clear", "hit"):
        row[f"said_{said}"] = sum(one.said == said for one in found)
        row[f"wrong_{said}"] = sum(one.is_wrong and one.said == said for one in found)
    row["undecided"] = len(found) - row["said_clear"] - row["said_hit"]
    below = max((one.deviation for one in found), default=0.0)
    return row | {"gap_below_m": below or None, "s": took}


def main() -> None:
    """Measure, print, and fill the table of docs/evaluation.md."""
    parser = argparse.ArgumentParser(description=records.first_line(__doc__))
    parser.add_argument("--seconds", type=float, default=20.0)
    for name, package in PEERS.items():
        parser.add_argument(f"--{name}", default="", help=f"a Python that has {package}")
    chosen = parser.parse_args()
    oracles: list[tuple[str, str, Any]] = [
        ("open shapes past one another", "coal", open_shapes),
        ("sweeps in contact", "coal", in_contact),
        ("inside of closed bodies", "winding numbers", insides),
        ("machines among boxes", "coal", machines),
        ("distances of pairs, three assemblies", "coal", pairs),
        ("M16 nut, a quarter turn", "coal", nuts),
        ("round pegs drawn out", "nominal gap", pegs),
        ("shafts in STEP files", "nominal gap", chosen.step and partial(shafts, chosen.step)),
        ("OMPL's valid paths", "coal", chosen.ompl and partial(planned, chosen.ompl)),
        ("CCD of shifts, hapticdb", "exact", ccd),
        ("CCD of shifts, Tight-Inclusion", "exact", chosen.ipctk and partial(tight, chosen.ipctk)),
    ]
    rows = []
    next(open_shapes(np.inf))  # compiles the kernels
    for what, oracle, cases in oracles:
        if not cases:
            print(f"left out without its Python: {what}")
            continue
        began = time.perf_counter()
        found = list(cases(time.monotonic() + chosen.seconds))
        took = time.perf_counter() - began
        for group in sorted({"", *(one.group for one in found)}):
            own = [one for one in found if one.group == group]
            rows.append(row_of(group or what, oracle, own, took))
            print(rows[-1], flush=True)
    found_all = records.conditions() | {"inputs": {"seconds": chosen.seconds}, "rows": rows}
    print(page_tables.truth({"truth": found_all}))
    records.write(records.ROOT / "results", {"truth": found_all})
    page_tables.refill("docs/evaluation.md", records.ROOT / "results")


if __name__ == "__main__":
    main()
