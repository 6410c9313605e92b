"""Sweeps in an environment, decided on surfaces: what is hit, touched, left and enclosed."""

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
from contact_scenes import judged
from hapticdb import Environment, PointShell
from hapticdb.errors import ObjectNotFoundError, UsageError
from hapticdb.exact.separation import CONTACT
from hapticdb.exact.sweep import sweep
from hapticdb.exact.sweep_report import verdict_line
from hapticdb.exact.swept import Swept
from hapticdb.kernels.triangles.path_distance import MEETING
from hapticdb.poses import rotation_of

Floats = NDArray[np.float64]

PARTS = {
    "plate": ((0.3, 0.3, 0.02), (0.0, 0.0, -0.01)),
    "wall": ((0.02, 0.3, 0.2), (0.15, 0.0, 0.1)),
    "shelf": ((0.1, 0.1, 0.01), (-0.1, 0.0, 0.125)),
}
"""Boxes: edges and middles, metres. The plate's upper side is at 0, the wall's side at x 0.14."""
CUBE = 0.04


def pose_of(place: Any, quaternion: Any = (1, 0, 0, 0)) -> Floats:  # noqa: ANN401 - any triple
    pose = np.eye(4)
    unit = np.asarray(quaternion, dtype=float)
    pose[:3, :3] = rotation_of(unit / np.linalg.norm(unit))[0]
    pose[:3, 3] = place
    return pose


def line(*places: Any) -> Floats:  # noqa: ANN401
    return np.array([pose_of(place) for place in places])


def box_at(edges: Any, middle: Any) -> trimesh.Trimesh:  # noqa: ANN401
    made = trimesh.creation.box(edges)
    made.apply_translation(middle)
    return made


def imported(folder: Path, parts: dict[str, trimesh.Trimesh], bits: int = 5) -> Environment:
    folder.mkdir(exist_ok=True)
    scene = trimesh.Scene()
    for name, made in parts.items():
        scene.add_geometry(made, node_name=name, geom_name=name)
    file = folder / "parts.glb"
    file.write_bytes(scene.export(file_type="glb"))
    options = hapticdb.ImportOptions(grid=hapticdb.GridOptions(bits=bits), distances=False)
    hapticdb.import_files(folder / "parts.db", [file], options)
    return hapticdb.open(folder / "parts.db")


def shell_of(made: trimesh.Trimesh) -> PointShell:
    return PointShell.from_mesh(made.vertices, made.faces)


TOOL = shell_of(trimesh.creation.box((CUBE,) * 3))


@pytest.fixture(scope="module")
def env(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Environment]:
    parts = {name: box_at(*placed) for name, placed in PARTS.items()}
    with imported(tmp_path_factory.mktemp("swept"), parts) as made:
        yield made


def names(found: Swept) -> list[str]:
    return [place.object.name for place in found.hits]


def test_sweep_gap_independent_of_voxels(tmp_path: Path) -> None:
    parts = {name: box_at(*placed) for name, placed in PARTS.items()}
    told = []
    for bits in (4, 7):
        with imported(tmp_path / str(bits), parts, bits) as env:
            found = sweep(env, TOOL, line((-0.05, 0.1, 0.0204), (0.05, 0.1, 0.0204)))
        assert found.verdict == "clear"
        assert found.comes_out
        assert found.gap.at_most == pytest.approx(4e-4, abs=1e-7)
        assert 4e-4 - 1e-5 <= found.gap.at_least <= 4e-4 + 1e-7
        place = found.gap.place
        assert place is not None
        assert place.object.name == "plate"
        assert place.on_object[2] == pytest.approx(0.0, abs=1e-6)
        assert place.on_tool[2] == pytest.approx(4e-4, abs=1e-6)
        told.append((found.gap.at_least, found.gap.at_most, place.fraction))
    assert told[0] == told[1]


def test_sweep_first_contacts_in_order(env: Environment) -> None:
    found = sweep(env, TOOL, line((-0.1, 0.0, 0.06), (-0.1, 0.0, 0.16), (0.2, 0.0, 0.16)))
    assert found.verdict == "hits"
    assert names(found) == ["shelf", "wall"]
    shelf, wall = found.hits
    # the tool's upper side meets the shelf's lower one after 4 cm of 40
    assert shelf.fraction == pytest.approx(0.1, abs=2.0 * MEETING / 0.4)
    assert shelf.segment == 0
    assert shelf.on_object[2] == pytest.approx(0.12, abs=2.0 * MEETING)
    assert wall.segment == 1
    assert wall.pose[0, 3] == pytest.approx(0.12, abs=2.0 * MEETING)
    assert (found.gap.at_least, found.gap.at_most) == (0.0, 0.0)
    first = sweep(env, TOOL, found.path.poses, until_hit=True)
    assert names(first) == ["shelf"]
    assert first.hits[0].fraction == pytest.approx(shelf.fraction, abs=1e-4)


def test_sweep_selection_of_objects(env: Environment) -> None:
    path = line((-0.1, 0.0, 0.06), (-0.1, 0.0, 0.16))
    assert names(sweep(env, TOOL, path)) == ["shelf"]
    assert sweep(env, TOOL, path, exclude=["shelf"]).verdict == "clear"
    near = sweep(env, TOOL, path, where=["wall"]).gap.place
    assert near is not None
    assert near.object.name == "wall"
    with pytest.raises(ObjectNotFoundError, match="no object 77"):
        sweep(env, TOOL, path, exclude=[77])


# --- contact at the start ------------------------------------------------------------------------

SEATED = (0.0, 0.0, 0.5 * CUBE)


def test_sweep_part_slides_or_lifts_off(env: Environment) -> None:
    lifted = sweep(env, TOOL, line(SEATED, (0.0, 0.0, 0.1)))
    assert (lifted.verdict, lifted.comes_out) == ("clear", True)
    (plate,) = lifted.touching
    assert plate.object.name == "plate"
    assert plate.until <= 5.0 * CONTACT / 0.08
    assert not plate.is_sliding
    path = line(SEATED, (0.05, 0.0, 0.5 * CUBE), (0.05, 0.0, 0.1))
    found = sweep(env, TOOL, path)
    assert (found.verdict, found.comes_out) == ("slides", True)
    assert found.touching[0].until == pytest.approx(0.05 / 0.13, abs=2e-3)
    still = sweep(env, TOOL, path[:2])
    assert (still.verdict, still.is_free, still.comes_out) == ("slides", True, False)


def test_sweep_hits_deeper_than_tolerance(env: Environment) -> None:
    for deep in (0.5, 0.9, 2.1, 3.0, 400.0):
        found = sweep(env, TOOL, line(SEATED, (0.01, 0.0, 0.5 * CUBE - deep * CONTACT)))
        assert (found.verdict == "hits") == (deep > 2.0), deep
        for hit in found.hits:
            assert hit.object.name == "plate"
            assert hit.pose[2, 3] == pytest.approx(0.5 * CUBE - CONTACT, abs=0.5 * CONTACT)
            assert hit.at_least > CONTACT


def test_sweep_contact_tolerance(env: Environment) -> None:
    path = line((0.0, 0.0, 0.5 * CUBE + 2e-4), (0.05, 0.0, 0.5 * CUBE + 2e-4))
    assert sweep(env, TOOL, path).verdict == "clear"
    assert sweep(env, TOOL, path, contact=3e-4).verdict == "slides"


# --- inside --------------------------------------------------------------------------------------


def test_sweep_enclosed_objects(tmp_path: Path) -> None:
    parts = {"tank": box_at((0.3,) * 3, (0.0,) * 3), "pea": box_at((0.01,) * 3, (1.0, 0.0, 0.0))}
    hollow = trimesh.creation.box((CUBE,) * 3)
    hollow.update_faces(np.arange(len(hollow.faces)) > 1)  # a box without a side is open
    with imported(tmp_path / "inside", parts) as env:
        in_tank = sweep(env, TOOL, line((0.0, 0.0, 0.0), (0.02, 0.0, 0.0)))
        out = sweep(env, TOOL, line((0.0, 0.0, 0.0), (0.3, 0.0, 0.0)))
        around = sweep(env, TOOL, line((1.0, 0.0, 0.0), (1.002, 0.0, 0.0)))
        assert sweep(env, shell_of(hollow), line((1.0, 0.0, 0.0))).enclosed == ()
    for found, name in ((in_tank, "tank"), (around, "pea")):
        assert [obj.name for obj in found.enclosed] == [name]
        assert (found.verdict, found.hits) == ("hits", ())
    assert names(out) == ["tank"]


def holed(edge: float, missing: int) -> trimesh.Trimesh:
    """A cube of 3,072 faces, without some of them."""
    made = trimesh.creation.box((edge,) * 3).subdivide().subdivide().subdivide().subdivide()
    made.update_faces(np.arange(len(made.faces)) >= missing)
    return made


@pytest.mark.parametrize("is_tool", [False, True])
def test_sweep_not_watertight(tmp_path: Path, is_tool: bool) -> None:
    """A small hole does not make free what is inside; a missing side does."""
    small, path = trimesh.creation.box((0.01,) * 3), line((0.0, 0.0, 0.0), (0.002, 0.0, 0.0))
    for missing, verdict in ((0, "hits"), (1, "not decided"), (512, "clear")):
        outer = holed(CUBE, missing)
        thing, tool = (small, outer) if is_tool else (outer, small)
        with imported(tmp_path / f"{missing}", {"thing": thing}) as env:
            found = sweep(env, shell_of(tool), path)
            beside = sweep(env, shell_of(tool), line((0.1, 0.0, 0.0), (0.2, 0.0, 0.0)))
        assert found.verdict == verdict
        assert [obj.name for obj in found.leaky] == ["thing"] * (missing == 1)
        said = verdict_line(found, shell_of(tool))
        assert ("thing around the tool or inside it, and not watertight" in said) == (missing == 1)
        assert beside.verdict == "clear"
        kind = judged(outer.triangles * 1e3, small.triangles * 1e3).kind
        assert kind == {"hits": "inside", "not decided": "not known", "clear": "far"}[verdict]


@pytest.mark.parametrize("gap", [1e-6, 0.0, -2e-5])
def test_sweep_resting_in_not_watertight(tmp_path: Path, gap: float) -> None:
    """A part on the inner floor is inside; one on the roof, or in a box without a lid, is not."""
    edge = 0.01
    floor, roof = -0.5 * CUBE + 0.5 * edge + gap, 0.5 * CUBE + 0.5 * edge + gap
    part = trimesh.creation.box((edge,) * 3)
    for missing, z, verdict in (
        (1, floor, "not decided"), (1, roof, "clear"), (512, floor, "clear")
    ):  # fmt: skip
        outer = holed(CUBE, missing)
        with imported(tmp_path / f"{missing} {z}", {"thing": outer}) as env:
            found = sweep(env, shell_of(part), line((0.0, 0.0, z), (0.0, 0.0, z + 0.005)))
        assert found.verdict == verdict
        placed = part.triangles + np.array([0.0, 0.0, z])
        kind = judged(outer.triangles * 1e3, placed * 1e3).kind
        assert kind == ("not known" if verdict == "not decided" else "touching")


def test_shape_almost_encloses_by_one_part_or_all() -> None:
    """Sheets beside a holed body in one part, or pieces beside its hole, do not hide it."""
    outer, small = np.array(holed(CUBE, 1).triangles), trimesh.creation.box((0.004,) * 3).triangles
    sheet = np.array([[(-1, -1, 0), (1, -1, 0), (1, 1, 0)]]) * 0.1 + (0.0, 0.0, 0.05)
    places = np.array(
        [(x, y, 0.018) for x in (-0.017, 0.017) for y in np.linspace(-0.017, 0.017, 12)]
    )
    aside = [small + place for place in places]
    halves = np.split(outer[np.argsort(outer[:, :, 2].mean(axis=1))], [1500])
    for thing, tool in (
        (np.concatenate([outer, sheet]), small),
        (outer, np.concatenate([*aside, small])),
        (np.concatenate([halves[0], halves[1] + (0.0, 0.0, 1e-5)]), small),
    ):
        assert judged(thing * 1e3, tool * 1e3).kind == "not known"


# --- turns, balls, clouds ------------------------------------------------------------------------


def test_sweep_rotation_about_centre(env: Environment) -> None:
    rod = shell_of(box_at((0.2, 0.01, 0.01), (0.1, 0.0, 0.0)))
    quarter = [pose_of((0.0, 0.0, 0.005), (1, 0, 0, 0)), pose_of((0.0, 0.0, 0.005), (1, 0, 0, 1))]
    path = np.array(quarter) + pose_of((-0.1, 0.0, 0.05)) - np.eye(4)
    about = sweep(env, rod, path, where=["wall"], about=(0.0, 0.0, 0.0))
    # about its end, 0.24 m from the wall, the rod of 0.2 m keeps away by 0.04 m less its edge
    corner = np.hypot(0.2, 0.005)
    assert about.gap.at_most == pytest.approx(0.24 - corner, rel=0.01)
    with pytest.raises(UsageError, match="centre of turns"):
        sweep(env, rod, path, about=(0.0, np.nan, 0.0))


def test_sweep_point_cloud_hits_never_touches(tmp_path: Path) -> None:
    file = tmp_path / "cloud.ply"
    x, y = np.meshgrid(np.linspace(-0.1, 0.1, 41), np.linspace(-0.1, 0.1, 41))
    points = np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1)
    trimesh.PointCloud(points).export(file)
    hapticdb.import_files(tmp_path / "cloud.db", [file])
    with hapticdb.open(tmp_path / "cloud.db") as env:
        above = line((0.0, 0.0, 0.5 * CUBE + 1e-3), (0.02, 0.0, 0.5 * CUBE + 1e-3))
        assert sweep(env, TOOL, above).gap.at_most == pytest.approx(1e-3, rel=0.01)
        resting = sweep(env, TOOL, line((0.0, 0.0, 0.5 * CUBE), (0.0, 0.0, 0.1)))
        assert resting.touching == ()
        assert resting.verdict == "hits"


# --- limits, revisions, wrong use -------------------------------------------------------


def test_sweep_limit_and_progress(env: Environment) -> None:
    told: list[tuple[int, int]] = []
    found = sweep(env, TOOL, line((0.0, 0.0, 0.05)), limit=0.01)
    assert (found.gap[:3], found.verdict) == ((0.01, 0.01, None), "clear")
    sweep(env, TOOL, line((0.0, 0.0, 0.05)), progress=lambda *now: told.append(now))
    assert told
    assert [done for done, _ in told] == list(range(1, len(told) + 1))


def test_sweep_time_limit_undecided(env: Environment) -> None:
    found = sweep(env, TOOL, line((0.0, 0.0, 0.05), (0.05, 0.0, 0.05)), seconds=1e-9)
    assert found.verdict == "not decided"
    assert found.gap.at_least == 0.0


def test_sweep_time_limit_in_contact(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The tool slides by many tolerances: each look at the clock takes a second of it."""
    seconds = count()
    clock = SimpleNamespace(monotonic=lambda: float(next(seconds)))
    monkeypatch.setattr("hapticdb.exact.distance.time", clock)
    monkeypatch.setattr("hapticdb.exact.movers.time", clock)
    path = line(SEATED, (0.05, 0.0, 0.5 * CUBE))
    with imported(tmp_path, {"plate": box_at((0.3, 0.3, 0.02), (0.0, 0.0, -0.01))}) as env:
        found = sweep(env, TOOL, path, contact=1e-6, seconds=20.0)
    assert found.verdict == "not decided"
    assert next(seconds) <= 25


def test_sweep_one_revision(tmp_path: Path) -> None:
    parts = {name: box_at(*placed) for name, placed in PARTS.items()}
    with imported(tmp_path / "shared", parts) as env, hapticdb.open(env.url) as other:
        before = env.store.revision()
        path = line((-0.1, 0.0, 0.06), (-0.1, 0.0, 0.16))
        shelf = other.find("shelf")[0]

        def take_away(done: int, total: int) -> None:
            del total
            if done == 1:
                other.remove(shelf.id)

        meanwhile = sweep(env, TOOL, path, progress=take_away)
        after = sweep(env, TOOL, path)
    assert (names(meanwhile), meanwhile.revision) == (["shelf"], before)
    assert (names(after), after.revision) == ([], before + 1)


def test_sweep_bad_arguments(env: Environment) -> None:
    path = line((0.0, 0.0, 0.05))
    points = PointShell(TOOL.points, TOOL.normals, TOOL.center)
    with pytest.raises(UsageError, match="no surface"):
        sweep(env, points, path)
    wrong: tuple[dict[str, Any], ...] = ({"contact": 0.0}, {"limit": -1.0}, {"seconds": 0.0})
    for options in wrong:
        with pytest.raises(UsageError, match=r"above 0|seconds"):
            sweep(env, TOOL, path, **options)
    mirrored = np.array([np.eye(4), np.diag([1.0, 1.0, -1.0, 1.0])])
    paths: tuple[Any, ...] = (np.eye(4), np.empty((0, 4, 4)), mirrored, "abc")
    for poses in paths:
        with pytest.raises(UsageError, match=r"shape|pose 1|numbers"):
            sweep(env, TOOL, poses)
