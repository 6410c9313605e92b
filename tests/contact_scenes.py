"""Scenes in contact whose outcome is known in closed form; lengths in millimetres."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import hapticdb
from assemblies import write_obj
from hapticdb import Environment, PointShell
from hapticdb.exact.clash import PairResult, classify_pair
from hapticdb.exact.sweep import sweep
from hapticdb.exact.swept import Swept
from hapticdb.pointshell.shape import CollisionShape

Floats = NDArray[np.float64]
Triple = tuple[float, float, float]

MM = 1e-3
CONTACT = 0.05
"""Default of the contact tolerance."""
REACH = CONTACT + 0.02
"""Greatest motion that may free what is touched: the tolerance and the search's margin."""


def moved(made: trimesh.Trimesh, at: Triple = (0.0, 0.0, 0.0)) -> Floats:
    return np.asarray(made.triangles + np.array(at), dtype=np.float64)


def box(edges: Triple, at: Triple = (0.0, 0.0, 0.0)) -> Floats:
    return moved(trimesh.creation.box(edges), at)


def rod(radius: float, length: float, sections: int, at: Triple = (0.0, 0.0, 0.0)) -> Floats:
    """A cylinder along z."""
    return moved(trimesh.creation.cylinder(radius, length, sections=sections), at)


def ring(
    inner: float, outer: float, length: float, sections: int, at: Triple = (0.0, 0.0, 0.0)
) -> Floats:
    return moved(trimesh.creation.annulus(inner, outer, length, sections=sections), at)


def ball(radius: float, at: Triple, subdivisions: int = 1) -> Floats:
    return moved(trimesh.creation.icosphere(subdivisions, radius), at)


def quad(*corners: Triple) -> Floats:
    a = np.array(corners)
    return np.stack([a[[0, 1, 2]], a[[0, 2, 3]]])


def sheet(side: float, height: float = 0.0) -> Floats:
    h = 0.5 * side
    return quad((-h, -h, height), (h, -h, height), (h, h, height), (-h, h, height))


def grid(axis: str, side: float, n: int, at: Triple = (0.0, 0.0, 0.0)) -> Floats:
    """An open square of n x n quads, normal to z or x."""
    u = np.linspace(-0.5 * side, 0.5 * side, n + 1)
    a, b = np.meshgrid(u, u, indexing="ij")
    flat = np.zeros_like(a)
    places = np.stack([a, b, flat] if axis == "z" else [flat, a, b], axis=-1) + np.array(at)
    p, q, r, s = places[:-1, :-1], places[1:, :-1], places[1:, 1:], places[:-1, 1:]
    both = np.stack([np.stack([p, q, r], axis=-2), np.stack([p, r, s], axis=-2)])
    return both.reshape(-1, 3, 3)


def inverted(triangles: Floats) -> Floats:
    return triangles[:, ::-1]


def joined(*surfaces: Floats) -> Floats:
    return np.concatenate(surfaces)


def hollow(outer: float, inner: float) -> Floats:
    """A closed cube with an empty cube inside."""
    return joined(box((outer,) * 3), inverted(box((inner,) * 3)))


def angle() -> Floats:
    """Floor, its upper side at 0, and a wall of 10 from x 20 to 30: one closed body."""
    profile = [(-30, -10), (30, -10), (30, 40), (20, 40), (20, 0), (-30, 0)]
    n, caps = len(profile), [(0, 5, 4), (0, 4, 1), (1, 4, 3), (1, 3, 2)]
    places = [(x, y, z) for y in (-15, 15) for x, z in profile]
    faces = caps + [(a + n, c + n, b + n) for a, b, c in caps]
    for i in range(n):
        j = (i + 1) % n
        faces += [(i, j, j + n), (i, j + n, i + n)]
    made = trimesh.Trimesh(np.array(places, dtype=float), faces)
    made.fix_normals()
    assert made.is_watertight
    return moved(made)


def rotated(triangles: Floats, degrees: float, axis: str, at: Triple = (0.0, 0.0, 0.0)) -> Floats:
    turn = Rotation.from_euler(axis, degrees, degrees=True).as_matrix()
    return np.asarray(triangles @ turn.T + np.array(at))


def frame_of(seed: int) -> Floats:
    """A random rigid transform (4, 4); seed 0: none."""
    frame = np.eye(4)
    if seed:
        rng = np.random.default_rng(seed)
        frame[:3, :3] = Rotation.random(rng=rng).as_matrix()
        frame[:3, 3] = rng.uniform(-300.0, 300.0, 3)
    return frame


def placed(triangles: Floats, pose: Floats) -> Floats:
    return np.asarray(triangles @ pose[:3, :3].T + pose[:3, 3])


def pulls(*places: Triple) -> Floats:
    """Displacements (M, 4, 4) of a path through places, from the start on."""
    poses = np.tile(np.eye(4), (len(places) + 1, 1, 1))
    poses[1:, :3, 3] = np.reshape(places, (-1, 3))
    return poses


def turns(axis: str, *degrees: float) -> Floats:
    poses = np.tile(np.eye(4), (len(degrees) + 1, 1, 1))
    for pose, angle_of in zip(poses[1:], degrees, strict=True):
        pose[:3, :3] = Rotation.from_euler(axis, angle_of, degrees=True).as_matrix()
    return poses


def in_frame(poses: Floats, frame: Floats) -> Floats:
    """The same displacements of surfaces that a frame has moved."""
    back = np.linalg.inv(frame)
    found = frame @ poses @ back
    found[:, 3] = (0.0, 0.0, 0.0, 1.0)
    return np.asarray(found)


def imported(url: Path, surfaces: Mapping[str, Floats]) -> Environment:
    """An environment of objects with these surfaces, exact to the last bit, opened to read."""
    url.parent.mkdir(parents=True, exist_ok=True)
    parts = {}
    for name, triangles in surfaces.items():
        places, faces = np.unique(MM * triangles.reshape(-1, 3), axis=0, return_inverse=True)
        parts[name] = places, faces.reshape(-1, 3)
    file = write_obj(url.with_suffix(".obj"), parts)
    options = hapticdb.ImportOptions(
        grid=hapticdb.GridOptions(bits=3), distances=False, unit="m", jobs=1
    )
    (report,) = hapticdb.import_files(url, [file], options)
    assert report.status == "imported", report
    return hapticdb.open(url, read_only=True)


def shell_of(triangles: Floats) -> PointShell:
    corners = MM * triangles.reshape(-1, 3)
    return PointShell.from_mesh(corners, np.arange(len(corners)).reshape(-1, 3), points=1)


def swept(
    env: Environment,
    tool: Floats | PointShell,
    poses: Floats,
    names: Sequence[str],
    *,
    seated: bool = True,
    contact: float = CONTACT,
    **options: Any,  # noqa: ANN401 - of a sweep
) -> Swept:
    """Sweep a tool along displacements, millimetres, past objects of these names."""
    path = poses.copy()
    path[:, :3, 3] *= MM
    shell = shell_of(tool) if isinstance(tool, np.ndarray) else tool
    return sweep(
        env, shell, path, where=names, contact=MM * contact, **{"seated": seated, **options}
    )


def judged(a: Floats, b: Floats, contact: float = CONTACT) -> PairResult:
    """Judge two surfaces; lengths of the result in millimetres."""
    shapes = [CollisionShape(MM * triangles) for triangles in (a, b)]
    found = classify_pair(shapes[0], shapes[1], np.eye(4), MM, MM * contact)
    return found._replace(at_least=found.at_least / MM, at_most=found.at_most / MM)


class Pull(NamedTuple):
    """A sweep with a known outcome.

    expected : "free", "overlaps" or "hits"; start : greatest start overlap that may be told, and by
    which a tool without a seat is hit at 0 if it is above the tolerance; after, by : millimetres of
    the path between which the hit is told.
    """

    name: str
    tool: Floats
    object: Floats
    poses: Floats
    expected: str
    contact: float = CONTACT
    start: float = 0.0
    after: float = 0.0
    by: float = np.inf


BLOCK = box((40, 40, 40), (0, 0, -20))
TIN = hollow(40, 36)
LABEL = box((10, 10, 0.1), (0, 0, -17.94))
OPEN = sheet(100)
SMALL = sheet(10, 0.01)
PRESSED = rod(4.02, 20, 96)
HOOD, SEAM = box((100, 60, 1)), box((20, 60, 10), (58, 0, -3))
RAIL, BEAM = box((50, 400, 50)), box((400, 50, 50))
GROOVE = joined(box((60, 60, 4), (0, 0, -2)), box((4, 60, 10), (16.5, 0, 5)))
T_JOINT, SKIN = box((20, 1, 20), (0, 0, 10.47)), box((60, 60, 1))
SUNK, BASE = box((10, 10, 1), (0, 0, 0.98)), box((30, 30, 1))
BULLET = ball(1.5, (3, 4, 24.5))
GASKET, FLANGE = ring(10, 15, 0.1, 48, (0, 0, 0.55)), box((40, 40, 1))
SHORT = ring(4, 10, 20, 96)
RIBS = {place: grid("x", 20, 17, (place, place / 2, 10.01)) for place in (0.0, 1.37)}

PULLS = (
    Pull("inside", box((5, 5, 5), (0, 0, 17.48)), box((40, 40, 40)), pulls((0, 0, -5)), "hits",
         by=0.0),
    Pull("shim", box((20, 0.1, 20), (1, 2, 10.01)), BLOCK, pulls((0, 0, -15)), "hits", by=0.1),
    Pull("wire", rod(0.04, 20, 12, (1, 2, 10.01)), BLOCK, pulls((0, 0, -15)), "hits", by=0.1),
    Pull("plate, 0.5", box((20, 0.9, 20), (1, 2, 10.01)), BLOCK, pulls((0, 0, -15)), "hits", 0.5,
         by=0.55),
    Pull("pane", box((30, 2, 20), (0, 0, 8.8)), angle(), pulls((20, 0, 0)), "hits", start=1.3,
         after=4.9, by=6.5),
    Pull("label, down", LABEL, TIN, pulls((0, 0, -30)), "hits", by=0.1),
    Pull("label, along", LABEL, TIN, pulls((10, 0, 0)), "free"),
    Pull("label, up", LABEL, TIN, pulls((0, 0, 10)), "free"),
    Pull("ball, in", BULLET, box((40, 46, 50)), pulls((0, 0, -2.5)), "hits", start=2.3, by=0.3),
    Pull("ball, out", BULLET, box((40, 46, 50)), pulls((0, 0, 5)), "overlaps", start=2.3),
    Pull("label through open sheet", box((10, 10, 0.08), (0, 0, 0.05)), OPEN, pulls((0, 0, -5)),
         "hits", by=0.1),
    Pull("label off open sheet", box((10, 10, 0.08), (0, 0, 0.05)), OPEN, pulls((0, 0, 5)),
         "free"),
    Pull("sheet through sheet", SMALL, OPEN, pulls((0, 0, -5)), "hits", by=0.1),
    Pull("sheet off sheet", SMALL, OPEN, pulls((0, 0, 5)), "free"),
    Pull("sheet along sheet", SMALL, OPEN, pulls((20, 7, 0)), "free"),
    Pull("coarse peg, out", rod(4, 20, 24), SHORT, pulls((0, 0, 25)), "free"),
    Pull("press fit, out", PRESSED, SHORT, pulls((0, 0, 25)), "free"),
    Pull("press fit, sideways", PRESSED, SHORT, pulls((5, 0, 0)), "hits", by=0.15),
    Pull("thread, out", rod(4, 20, 24), ring(3.5, 10, 20, 96), pulls((0, 0, 25)), "overlaps",
         start=0.8),
    Pull("bolt without bore", rod(4, 20, 24), box((30, 30, 20)), pulls((0, 0, 25)), "hits",
         start=6.0, by=0.0),
    Pull("flush plate, along", box((10, 10, 1), (0, 0, 1)), BASE, pulls((12, 3, 0)), "free"),
    Pull("sunk plate, along", SUNK, BASE, pulls((12, 3, 0)), "free"),
    Pull("sunk plate, in", SUNK, BASE, pulls((0, 0, -1)), "hits", by=0.1),
    Pull("gasket, off", GASKET, FLANGE, pulls((0, 0, 3)), "free"),
    Pull("gasket, in", GASKET, FLANGE, pulls((0, 0, -1)), "hits", by=0.12),
    Pull("T-joint, along", T_JOINT, SKIN, pulls((10, 0, 0)), "free"),
    Pull("T-joint, through", T_JOINT, SKIN, pulls((0, 0, -15)), "hits", by=0.1),
    Pull("foil on edge through foil", box((20, 0.08, 20), (0, 0, 10.05)), box((60, 60, 0.08)),
         pulls((0, 0, -10)), "hits", by=0.12),
    Pull("wire through open sheet", rod(0.04, 20, 12, (0, 0, 10.02)), OPEN, pulls((0, 0, -10)),
         "hits", by=0.12),
    Pull("hood in its seam, up", HOOD, SEAM, pulls((0, 0, 40)), "overlaps", start=2.4),
    Pull("hood in its seam, on", HOOD, SEAM, pulls((10, 0, 0)), "hits", start=2.4, by=0.5),
    Pull("press fit, then a wall", PRESSED, joined(SHORT, box((40, 40, 1), (0, 0, 30))),
         pulls((0, 0, 60)), "hits", after=19.3, by=19.7),
    Pull("cube in a groove", box((5, 5, 5), (0, 0, 2.5)), GROOVE, pulls((12, 0, 0), (12, 20, 0)),
         "free"),
    Pull("hinge pin", rod(3, 30, 24), ring(3, 6, 20, 32), turns("z", 45.0, 90.0), "free"),
    Pull("rail, along", RAIL, BEAM, pulls((0, 300, 0)), "hits", start=25.0, by=0.0),
    Pull("rail, sideways", RAIL, BEAM, pulls((60, 0, 0)), "hits", start=25.0, by=0.0),
    Pull("rib on a row of edges", RIBS[0.0], grid("z", 30, 16), pulls((0, 0, -8)), "hits", by=0.1),
    Pull("rib beside it", RIBS[1.37], grid("z", 30, 16), pulls((0, 0, -8)), "hits", by=0.1),
    Pull("buried tool", rod(3, 60, 24, (0, 0, 24)), box((80, 80, 1.2)), pulls(), "hits",
         start=6.0, by=0.0),
    Pull("sunk plate, rests", SUNK, BASE, pulls(), "free"),
)  # fmt: skip


class Meeting(NamedTuple):
    """A pair of surfaces; depth : what is proved of it, 0 where nothing is."""

    name: str
    a: Floats
    b: Floats
    kind: str
    depth: float = 0.0
    contact: float = CONTACT


CUBE = box((20, 20, 20))
UPRIGHT = quad((1.3, -50, -50), (1.3, 50, -50), (1.3, 50, 50), (1.3, -50, 50))
KNIFE = rotated(box((30, 10, 10)), 45.0, "x", (0, 0, 50**0.5 - 0.02))
SHAFT = rotated(rod(5, 120, 96), 90.0, "y", (0, 0, 4.98))
CORNERS = (
    quad((0, -10, -0.02), (10, -10, -0.02), (10, 10, -0.02), (0, 10, -0.02)),
    quad((0.02, 0, -10), (0.02, 0, 0), (-10, 0, 0), (-10, 0, -10)),
)
JAWS = joined(box((40, 40, 1), (0, 0, 0.55)), box((40, 40, 1), (0, 0, -0.55)))

MEETINGS = (
    Meeting("sheet through cube", CUBE, sheet(100, 2.0), "overlapping", 8.0),
    Meeting("sheet through sheet", UPRIGHT, sheet(100, 2.0), "overlapping"),
    Meeting("wire through cube", CUBE, rod(0.04, 100, 16, (1, 2, 0)), "overlapping", 8.04),
    Meeting("pin through cube", CUBE, rod(0.2, 100, 16, (1, 2, 0)), "overlapping", 8.2),
    Meeting("foil through cube", CUBE, box((100, 100, 0.08), (0, 0, 2)), "overlapping", 8.04),
    Meeting("foil into cube", CUBE, box((100, 100, 0.08), (55, 0, 2)), "overlapping", 5.0),
    Meeting("X of foils", box((50, 50, 0.08)), box((50, 0.08, 50)), "overlapping"),
    Meeting("flush side by side", box((10, 10, 1)), box((10, 10, 1), (5, 0, 0)), "overlapping",
            0.5),
    Meeting("flush faces", box((10, 10, 1)), box((30, 30, 1), (0, 0, 1)), "touching"),
    Meeting("sunk by 0.03", box((10, 10, 1)), box((30, 30, 1), (0, 0, 0.97)), "touching"),
    Meeting("sunk by 0.07", box((10, 10, 1)), box((30, 30, 1), (0, 0, 0.93)), "overlapping", 0.07),
    Meeting("press fit of 0.02", PRESSED, SHORT, "touching"),
    Meeting("press fit of 0.2", rod(4.2, 20, 96), SHORT, "overlapping", 0.2),
    Meeting("coarse bolt in its bore", rod(4, 20, 24), SHORT, "touching"),
    Meeting("knife in a sheet", KNIFE, OPEN, "touching"),
    Meeting("shaft in a sheet", SHAFT, OPEN, "touching"),
    Meeting("corners of sheets", *CORNERS, "touching"),
    Meeting("duplicate", box((10, 10, 10)), box((10, 10, 10)), "inside"),
    Meeting("nested shells", box((10, 10, 10)), box((12, 12, 12)), "inside"),
    Meeting("flush in a cube", box((8, 8, 8)), box((2, 2, 2), (3, 3, 0)), "inside"),
    Meeting("a piece in a cube", box((8, 8, 8)), joined(box((1, 1, 1)), box((1, 1, 1), (20, 0, 0))),
            "inside"),
    Meeting("part in a void", box((10, 10, 10)), TIN, "far"),
    Meeting("part near a void", hollow(8, 6), box((5, 5, 5)), "apart"),
    Meeting("part flush in a void", hollow(8, 6), box((6, 6, 6)), "touching"),
    Meeting("part beside a void", hollow(8, 6), box((0.5, 0.5, 0.5), (3.5, 0, 0)), "inside"),
    Meeting("edge on edge", box((4, 4, 4)), box((4, 4, 4), (4, 4, 0)), "touching"),
    Meeting("corner on corner", box((4, 4, 4)), box((4, 4, 4), (4, 4, 4)), "touching"),
    Meeting("cube on a sheet", SMALL, box((2, 2, 2), (0, 0, 1.01)), "touching"),
    Meeting("cube over a sheet", SMALL, box((2, 2, 2), (0, 0, 1.31)), "apart"),
    Meeting("cube in a sheet", SMALL, box((2, 2, 2), (0, 0, 0.71)), "overlapping", 0.3),
    Meeting("gasket in a gap", ring(10, 15, 0.14, 48), JAWS, "touching"),
    Meeting("hood in its seam", HOOD, SEAM, "overlapping", 2.0),
    Meeting("wire through plate", box((40, 40, 2)), rod(0.04, 60, 12), "overlapping", 1.0),
    Meeting("pin through plate, 0.5", box((40, 40, 2)), rod(0.45, 60, 12), "overlapping", 1.0,
            0.5),
)  # fmt: skip
