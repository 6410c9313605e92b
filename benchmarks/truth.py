"""Truth: verdicts and bounds against oracles of others, a row of a table each.

    HAPTICDB_TEST_DATA=... python benchmarks/truth.py [--seconds 20]    # for each row

coal measures in millimetres. Tight-Inclusion, OMPL (with coal) and build123d run in Pythons of
their own; a row without one is left out.
"""

import argparse
import csv
import json
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import page_tables
import records
from fits import FITS, measured
from hapticdb import PointShell
from hapticdb.exact.distance import Pair
from hapticdb.exact.path import ToolPath
from hapticdb.kernels.triangles.path_distance import MEETING, Search
from hapticdb.mesh import read_file
from hapticdb.pointshell.shape import bvh_of
from hapticdb.pointshell.tool_surface import ToolSurface
from test_mesh_proofs import bracket, clamp, coal_distance, tree_in_mm
from truth_paths import machines, planned
from truth_shapes import DATA, Case, in_contact, insides, pairs, step_fits

Floats = NDArray[np.float64]
POSES = 100
"""Places of a path at which coal measures."""
PEERS = {"ipctk": "ipctk", "ompl": "ompl and coal", "step": "build123d"}
TIGHT = """
import json, sys, time, ipctk, numpy as np
told, began = [], time.perf_counter()
for kind, p, d in json.load(sys.stdin):
    p = np.array(p); q = p.copy(); q[:2 if kind == "edge-edge" else 1] += d
    ccd = ipctk.TightInclusionCCD()
    f = ccd.edge_edge_ccd if kind == "edge-edge" else ccd.point_triangle_ccd
    told.append(bool(f(*p, *q)[0]))
json.dump([told, time.perf_counter() - began], sys.stdout)
"""


def pair_of(thing: Floats, tool: Floats, poses: Floats) -> Pair:
    """A tool on a path beside one object."""
    corners = tool.reshape(-1, 3)
    surface = ToolSurface(PointShell.from_mesh(corners, np.arange(len(corners)).reshape(-1, 3)))
    return Pair(bvh_of(thing), surface, ToolPath.of(poses, surface.corners, np.zeros(3)))


def away(thing: Floats, tool: Floats, poses: Floats) -> Case:
    """One sweep beside coal at places of the path, and at the nearest place."""
    pair = pair_of(thing, tool, poses)
    least, closed = pair.least(0.0, np.inf)
    assert least is not None
    trees, path = (tree_in_mm(thing), tree_in_mm(tool)), pair.path
    parameters = np.append(np.linspace(0.0, path.length, POSES), least.parameter)
    found = min(coal_distance(*trees, pose) for pose in path.at(parameters))
    is_hit = least.at_most <= MEETING
    # a hit's place is one that coal sees; a gap is below coal's at every place
    is_right = found <= MEETING + 1e-7 if is_hit else closed <= found + 1e-7
    return Case("hit" if is_hit else "clear", not is_right, 0.0 if is_hit else found - closed)


def open_shapes(until: float) -> Iterator[Case]:
    """Brackets and clamps past one another."""
    rng = np.random.default_rng(0)
    while time.monotonic() < until:
        thing, tool = (
            np.asarray((bracket, clamp)[n](rng).triangles) for n in rng.integers(2, size=2)
        )
        poses = np.tile(np.eye(4), (2, 1, 1))
        poses[:, :3, :3] = Rotation.random(2, rng=rng).as_matrix()
        poses[:, :3, 3] = rng.uniform(-0.15, 0.15, (2, 3))
        yield away(thing, tool, poses)


def nuts(until: float) -> Iterator[Case]:
    """The M16 nut turned by a quarter on its bolt."""
    bolt, nut = (
        np.concatenate([part.triangles() for part in read_file(DATA / "fits" / name).parts])
        for name in ("factory_bolt_m16_loose.obj", "factory_nut_m16_loose_subdiv_3x.obj")
    )
    del until
    poses = np.tile(np.eye(4), (13, 1, 1))
    turns = np.linspace(0.0, 0.5 * np.pi, 13)
    poses[:, :3, :3] = Rotation.from_euler("z", turns[:, None]).as_matrix()
    poses[:, 2, 3] = 2e-3 * (1.0 + turns / (2.0 * np.pi))
    yield away(bolt, nut, poses)


def pegs(until: float) -> Iterator[Case]:
    """Round pegs drawn out, beside half the difference of the diameters."""
    with tempfile.TemporaryDirectory() as folder:
        for name, fit in FITS.items():
            if fit.nominal_m is None or time.monotonic() > until:
                continue
            row = measured(Path(folder), DATA / "fits", name, 6)
            off = fit.nominal_m - row["gap_m"]
            yield Case(str(row["verdict"]), row["gap_m"] > fit.nominal_m, off)


def ccd(python: str, until: float) -> Iterator[tuple[str, list[bool], list[bool], float]]:
    """Public queries of shifted primitives, whose truth is rational arithmetic's."""
    with (DATA / "ccd" / "translations.csv").open() as file:
        rows = list(csv.reader(file))[1:]
    queries = [
        (row[0], np.array(row[2:14], float).reshape(4, 3), np.array(row[14:17], float))
        for row in rows
    ]
    truth, said, began = [row[-1] == "1" for row in rows], [], time.perf_counter()
    for kind, p, d in queries:
        if time.monotonic() > until:
            break
        n = 2 if kind == "edge-edge" else 1
        tool, thing = p[[0, n - 1, n - 1]], p[[n, -2, -1]]
        poses = np.tile(np.eye(4), (2, 1, 1))
        poses[1, :3, 3] = d
        path = ToolPath.of(poses, tool, tool.mean(axis=0))
        trees = bvh_of(thing[None]), bvh_of(tool[None])
        search = Search(*trees, path.motion, radius=0.0, begin=0.0, best=2 * MEETING, fine=9e-6)
        while not search.go_on(1 << 16):
            pass
        said.append(bool(search.found.distance[0] <= MEETING))
    yield "hapticdb", truth, said, time.perf_counter() - began
    if python:
        asked = json.dumps([(kind, p.tolist(), d.tolist()) for kind, p, d in queries])
        words = [python, "-c", TIGHT]
        done = subprocess.run(
            words, input=asked, capture_output=True, text=True, check=True, timeout=300
        )
        yield "Tight-Inclusion", truth, *json.loads(done.stdout)


def row_of(what: str, oracle: str, found: list[Case], took: float) -> dict[str, object]:
    """Counts of cases, said and wrong; gap_below_m : None without a proved gap."""
    row: dict[str, object] = {"what": what, "oracle": oracle, "cases": len(found)}
    for said in ("clear", "hit"):
        row[f"said_{said}"] = sum(one.said == said for one in found)
        row[f"wrong_{said}"] = sum(one.is_wrong and one.said == said for one in found)
    row["undecided"] = sum(one.said not in {"clear", "hit"} for one in found)
    return row | {"gap_below_m": max(one.deviation for one in found) or None, "s": took}


def main() -> None:
    """Measure, print, and fill the table of docs/evaluation.md."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--seconds", type=float, default=20.0)
    for name in ("ipctk", "ompl", "step"):
        parser.add_argument(f"--{name}", default="", help=f"a Python that has {PEERS[name]}")
    chosen = parser.parse_args()
    rows: list[dict[str, object]] = []
    next(open_shapes(np.inf))  # compiles the kernels
    oracles: dict[tuple[str, str], Callable[[float], Iterator[Case]]] = {
        ("open shapes past one another", "coal"): open_shapes,
        ("sweeps in contact", "coal"): in_contact,
        ("inside of closed bodies", "winding numbers"): insides,
        ("machines among boxes", "coal"): machines,
        ("pairs of three assemblies", "coal"): pairs,
        ("M16 nut, a quarter turn", "coal"): nuts,
        ("round pegs drawn out", "nominal gap"): pegs,
    }
    if chosen.step:
        oracles["shafts in STEP files", "nominal gap"] = partial(step_fits, chosen.step)
    if chosen.ompl:
        oracles["OMPL's valid paths", "coal"] = partial(planned, chosen.ompl)
    for (what, oracle), cases in oracles.items():
        began = time.perf_counter()
        found = list(cases(time.monotonic() + chosen.seconds))
        took = time.perf_counter() - began
        for group in sorted({one.group for one in found}):
            rows.append(row_of(group or what, oracle, [x for x in found if x.group == group], took))
            print(rows[-1], flush=True)
    for name, truth, told, took in ccd(chosen.ipctk, time.monotonic() + chosen.seconds):
        both = [*zip(truth, told, strict=False)]
        row: dict[str, object] = {
            "what": f"CCD of shifts, {name}",
            "oracle": "exact",
            "cases": len(both),
        }
        row["wrong_clear"] = sum(is_hit and not one for is_hit, one in both)
        row["wrong_hit"] = sum(one and not is_hit for is_hit, one in both)
        rows.append(row | {"undecided": 0, "gap_below_m": None, "s": took})
    for name, package in PEERS.items():
        if not getattr(chosen, name):
            print(f"left out: --{name} names a Python that has {package}")
    found_all = records.conditions() | {"inputs": {"seconds": chosen.seconds}, "rows": rows}
    print(page_tables.truth({"truth": found_all}))
    records.write(Path("results"), {"truth": found_all})
    page_tables.refill("docs/evaluation.md", Path("results"))


if __name__ == "__main__":
    main()
