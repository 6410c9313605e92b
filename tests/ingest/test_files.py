"""Importing: what goes in, what is refused, and that nothing is left half-done."""

import sys
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
from numpy.typing import NDArray

import hapticdb
from assemblies import (
    ORIGIN,
    SIZE,
    Rows,
    assembly,
    ball,
    box,
    left_behind,
    oracle_voxels,
    placement,
    rows_of,
    small_grid,
    small_options,
    voxel_set,
    write_obj,
)
from children import finished
from hapticdb import FileReport, GridOptions, ImportOptions
from hapticdb.grid import ROOM, CurveName
from hapticdb.ingest import files
from hapticdb.ingest.files import ImportProgress
from hapticdb.kernels.surfaces.voxelize import brick_voxels, voxelize
from hapticdb.mesh import MeshFile, Part, parse_in_process, read_file
from hapticdb.store import base
from hapticdb.store.base import Layout, Object
from hapticdb.store.sqlite.tables.file_tables import FileTables
from hapticdb.store.store_errors import present_already
from mesh_files import gltf
from naive import Voxel, voxels_of_points
from voxels import KINDS


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An OBJ file of seven parts that overlap."""
    return write_obj(tmp_path_factory.mktemp("files") / "assembly.obj", assembly(7))


@pytest.fixture(scope="module")
def parts(file: Path) -> list[Part]:
    return parse_in_process(file).parts


@pytest.fixture(scope="module")
def wanted(parts: list[Part]) -> list[set[Voxel]]:
    return [oracle_voxels(part, small_grid()) for part in parts]


def import_one(database: Path, file: Path, options: ImportOptions | None = None) -> FileReport:
    (report,) = hapticdb.import_files(database, [file], options)
    return report


def refusal(report: FileReport, kind: type[hapticdb.errors.HapticDBError]) -> str:
    """Message of the error of a file that was skipped."""
    assert report.status == "failed"
    assert not report.added
    assert type(report.error) is kind
    assert "\n" not in str(report.error)
    return str(report.error)


@pytest.mark.parametrize(("layout", "curve"), KINDS)
def test_import_files_voxels_equal_oracle(
    tmp_path: Path, file: Path, wanted: list[set[Voxel]], layout: Layout, curve: CurveName
) -> None:
    report = import_one(tmp_path / "e.db", file, small_options(curve, layout))
    assert report.status == "imported"
    with hapticdb.open(tmp_path / "e.db", read_only=True) as env:
        assert (env.layout, env.grid) == (layout, small_grid(curve))
        assert [o.id for o in env.objects()] == list(range(1, 8))
        for obj, voxels in zip(env.objects(), wanted, strict=True):
            found = env.voxels(obj.id)
            assert voxel_set(found) == voxels
            assert obj.voxels == len(voxels)
            assert (np.diff(env.grid.encode(found)) > 0).all()


def test_add_same_rows_as_import(tmp_path: Path, file: Path) -> None:
    import_one(tmp_path / "imported.db", file, small_options())
    with hapticdb.create(tmp_path / "added.db", small_grid()) as env:
        report = env.add(file)
        written = [(o.id, o.name, o.revision) for o in env.objects()]
        assert [(o.id, o.name, o.revision) for o in report.added] == written
    assert rows_of(tmp_path / "added.db") == rows_of(tmp_path / "imported.db")


def test_import_files_instances_are_objects(tmp_path: Path) -> None:
    nodes = [
        {"name": "axle", "children": [1, 2], "translation": [0.02, 0, 0]},
        {"name": "left", "mesh": 0, "translation": [0, -0.08, 0]},
        {"name": "right", "mesh": 0, "translation": [0, 0.08, 0], "rotation": [0, 0, 1, 0]},
    ]
    vertices, faces = ball((0, 0, 0), 0.05)
    wheels = gltf(
        {"nodes": nodes, "scenes": [{"nodes": [0]}]},
        tmp_path / "wheels.gltf",
        vertices.astype(np.float32),
        faces.ravel().tolist(),
    )
    report = import_one(tmp_path / "e.db", wheels, small_options())
    left, right = report.added
    assert [left.name, right.name] == ["axle/left", "axle/right"]
    assert left.digest == right.digest
    np.testing.assert_allclose(left.transform, placement(0.02, -0.08, 0))
    np.testing.assert_allclose(right.transform, placement(0.02, 0.08, 0, np.pi), atol=1e-12)
    with hapticdb.open(tmp_path / "e.db") as env:
        for obj, part in zip(env.objects(), parse_in_process(wheels).parts, strict=True):
            assert voxel_set(env.voxels(obj.id)) == oracle_voxels(part, env.grid)


@pytest.mark.parametrize("suffix", ["ply", "las"])
def test_import_files_cloud_voxels(tmp_path: Path, suffix: str) -> None:
    points = np.round(np.random.default_rng(1).uniform(-0.159, 0.159, (400, 3)), 4)
    points[:10] = np.round(points[:10], 2)  # on the voxels' borders
    cloud = write_ply if suffix == "ply" else write_las
    report = import_one(
        tmp_path / "e.db", cloud(tmp_path / f"scan.{suffix}", points), small_options()
    )
    (obj,) = report.added
    assert obj.name == "scan"
    with hapticdb.open(tmp_path / "e.db") as env:
        read = parse_in_process(tmp_path / f"scan.{suffix}").parts[0].world_points()
        scaled = env.grid.to_voxel_units(read).tolist()
        assert voxel_set(env.voxels(1)) == voxels_of_points(scaled, env.grid.bits)
        assert obj.voxels == len(env.voxels(1)) > 350


def write_ply(path: Path, points: NDArray[np.float64]) -> Path:
    header = f"ply\nformat ascii 1.0\nelement vertex {len(points)}\n"
    fields = "".join(f"property double {axis}\n" for axis in "xyz")
    rows = "".join(f"{x!r} {y!r} {z!r}\n" for x, y, z in points.tolist())
    path.write_text(f"{header}{fields}end_header\n{rows}")
    return path


def write_las(path: Path, points: NDArray[np.float64]) -> Path:
    header = laspy.LasHeader(point_format=0, version="1.2")
    header.scales = np.full(3, 1e-4)
    cloud = laspy.LasData(header)
    cloud.x, cloud.y, cloud.z = points.T
    cloud.write(path)
    return path


@pytest.mark.parametrize("unit", ["mm", "in"])
def test_import_files_unit(tmp_path: Path, unit: str) -> None:
    length = {"mm": 0.001, "in": 0.0254}[unit]
    block = write_obj(tmp_path / "block.obj", {"block": box((-3, -2, -1), (3, 2, 1))})
    (obj,) = import_one(tmp_path / "e.db", block, ImportOptions(unit=unit)).added
    np.testing.assert_allclose(obj.bounds, np.array([[-3, -2, -1], [3, 2, 1]]) * length)
    assert obj.attributes == {"unit": unit}
    with hapticdb.open(tmp_path / "e.db") as env:
        assert env.grid.edge == pytest.approx(ROOM * 6 * length)


def test_import_files_grid_options_of_existing(tmp_path: Path, file: Path) -> None:
    database = tmp_path / "e.db"
    import_one(database, file, small_options("hilbert", "voxel"))
    before = rows_of(database)
    for options in (
        None,
        small_options("hilbert", "voxel"),
        ImportOptions(grid=GridOptions(bits=5)),
        ImportOptions(grid=GridOptions(voxel_size=SIZE, origin=list(ORIGIN))),
    ):
        assert import_one(database, file, options).status == "complete"
    for grid, words in [
        (GridOptions(bits=6), "bits 6 instead of 5"),
        (GridOptions(voxel_size=0.011), "voxel size 0.011"),
        (GridOptions(origin=(0, 0, 0)), "origin"),
        (GridOptions(curve="z"), "curve z instead of hilbert"),
    ]:
        with pytest.raises(hapticdb.errors.GridError, match=words) as raised:
            hapticdb.import_files(database, [file], ImportOptions(grid=grid))
        assert "\n" not in str(raised.value)
    with pytest.raises(hapticdb.errors.UsageError, match="layout voxel, not brick"):
        hapticdb.import_files(database, [file], ImportOptions(layout="brick"))
    assert rows_of(database) == before


def test_import_files_outside_grid_rolls_back(tmp_path: Path, file: Path) -> None:
    database = tmp_path / "e.db"
    import_one(database, file, small_options())
    before = rows_of(database)
    far = write_obj(
        tmp_path / "far.obj",
        {"near": ball((0, 0, 0), 0.05), "gone far": box((0.1, 0, 0), (0.2, 0.01, 0.01))},
    )
    with pytest.raises(hapticdb.errors.OutsideGridError) as raised:
        import_one(database, far)
    for words in ("far.obj", "'gone far'", "(0.1, 0, 0) to (0.2, 0.01, 0.01)", "--extent"):
        assert words in str(raised.value)
    assert rows_of(database) == before


def test_import_files_voxel_limit(tmp_path: Path) -> None:
    """A cube of 0.1 m has 600 voxels of 1 cm by its area, and 6e4 voxels of 1 mm."""
    file = write_obj(tmp_path / "a.obj", {"cube": box((0, 0, 0), (0.1, 0.1, 0.1))})
    fine = ImportOptions(grid=GridOptions(voxel_size=1e-3, bits=8), voxel_limit=59_000)
    database = tmp_path / "e.db"
    with pytest.raises(hapticdb.errors.FileError, match="about 60,000 voxels of 1 mm") as raised:
        hapticdb.import_files(database, [file], fine)
    assert "more than 59,000" in str(raised.value)
    assert not database.exists()
    assert import_one(database, file, replace(fine, voxel_limit=61_000)).added
    with pytest.raises(hapticdb.errors.UsageError, match="a limit of 0 voxels"):
        ImportOptions(voxel_limit=0)


def test_import_files_surface_on_grid_border(tmp_path: Path) -> None:
    whole = write_obj(tmp_path / "whole.obj", {"whole": box([-0.16] * 3, [0.16] * 3)})
    (obj,) = import_one(tmp_path / "e.db", whole, small_options()).added
    assert obj.voxels == 32**3 - 30**3


@pytest.mark.parametrize("is_cloud", [True, False])
def test_import_files_rounding_at_border(tmp_path: Path, is_cloud: bool) -> None:
    """It is marked or refused. A file in single precision may be off by 2e-7 of a voxel."""
    if is_cloud:
        points = np.array([[0.0, 0, 0], [ORIGIN[0] - 1e-7 * SIZE, 0.05, 0.05]])
        file, least = write_ply(tmp_path / "scan.ply", points), 2
    else:
        corners = np.array([[-0.1, -0.1, ORIGIN[2] - 2e-9]] * 3)
        corners[1, 0] = corners[2, 1] = 0.1
        corners[2, 0] = 0.0
        plate = {"plate": (corners, np.array([[0, 1, 2]]))}
        file, least = write_obj(tmp_path / "plate.obj", plate), 201
    report = import_one(tmp_path / "e.db", file, small_options())
    assert report.status == "failed" or report.added[0].voxels >= least


MEMORY = """
import resource, sys
import hapticdb
from hapticdb import GridOptions, ImportOptions

def peak():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss << 10

folder, file = sys.argv[1:]
for bits, origin in ((9, (-0.3, -0.3, -0.3)), (21, (-900.0, -1000.0, -1100.0))):
    before = peak()
    grid = GridOptions(bits=bits, voxel_size=0.001, origin=origin)
    reports = hapticdb.import_files(f"{folder}/{bits}.db", [file], ImportOptions(grid=grid))
    assert reports[0].status == "imported", reports[0].error
print(peak() - before)
"""


def test_import_files_memory_independent_of_bits(tmp_path: Path) -> None:
    """The same part of 80,000 voxels at 9 and at 21 bits an axis, one after the other."""
    part = write_obj(
        tmp_path / "part.obj",
        {"ball": ball((0, 0, 0), 0.08, 40), "bar": box((-0.2, 0, 0), (0.2, 0.001, 0.001))},
    )
    printed = finished([sys.executable, "-c", MEMORY, str(tmp_path), str(part)], check=True)
    assert int(printed.stdout) < 32 << 20
    with hapticdb.open(tmp_path / "21.db", read_only=True) as env:
        assert env.grid.side == 2**21
        for obj, here in zip(env.objects(), parse_in_process(part).parts, strict=True):
            scaled = env.grid.to_voxel_units(here.triangles())
            np.testing.assert_array_equal(
                sorted(env.voxels(obj.id).tolist()),
                sorted(brick_voxels(*voxelize(scaled, 21)).tolist()),
            )


def test_import_files_bad_file_skipped(tmp_path: Path, file: Path) -> None:
    (tmp_path / "bad.stl").write_text("no facets here")
    other = write_obj(tmp_path / "other.obj", {"one more": ball((0, 0, 0), 0.02)})
    given = [tmp_path / "bad.stl", file, tmp_path / "gone.obj", other]
    options = replace(small_options(), skip_unusable=True)
    reports = hapticdb.import_files(tmp_path / "e.db", given, options)
    assert [r.status for r in reports] == ["failed", "imported", "failed", "imported"]
    assert "bad.stl" in refusal(reports[0], hapticdb.errors.FileError)
    assert "there is no such file" in refusal(reports[2], hapticdb.errors.FileError)
    with hapticdb.open(tmp_path / "e.db") as env:
        assert [o.link for o in env.objects()] == [str(file)] * 7 + [str(other)]
        assert [o.id for o in reports[3].added] == [8]


@pytest.mark.parametrize("ahead", [0, files.MOST_AHEAD])
def test_import_files_new_grid_encloses_all_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ahead: int
) -> None:
    monkeypatch.setattr(files, "MOST_AHEAD", ahead)
    (tmp_path / "bad.stl").write_text("no facets here")
    near = write_obj(tmp_path / "near.obj", {"near": ball((0, 0, 0), 0.1)})
    far = write_obj(tmp_path / "far.obj", {"far": ball((9, 0, 0), 0.1)})
    given = [tmp_path / "bad.stl", near, tmp_path / "gone.obj", far]
    options = ImportOptions(grid=GridOptions(bits=8, extent=1.5), skip_unusable=True)
    reports = hapticdb.import_files(tmp_path / "e.db", given, options)
    assert [r.status for r in reports] == ["failed", "imported", "failed", "imported"]
    with hapticdb.open(tmp_path / "e.db") as env:
        assert env.grid.edge == pytest.approx(1.5 * 9.2)
    reports = hapticdb.import_files(tmp_path / "e.db", given, options)  # has the same extent
    assert [r.status for r in reports] == ["failed", "complete", "failed", "complete"]


@pytest.mark.parametrize("cause", ["unreadable", "outside", "interrupted"])
def test_import_files_failure_leaves_no_database(
    tmp_path: Path, file: Path, cause: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "bad.obj").write_text("v 0 0\n")
    if cause == "unreadable":
        options = ImportOptions(skip_unusable=True)
        reports = hapticdb.import_files(tmp_path / "e.db", [tmp_path / "bad.obj"] * 2, options)
        assert [r.status for r in reports] == ["failed", "failed"]
    elif cause == "outside":
        grid = GridOptions(bits=5, voxel_size=0.001, origin=(0, 0, 0))
        with pytest.raises(hapticdb.errors.OutsideGridError):
            import_one(tmp_path / "e.db", file, ImportOptions(grid=grid))
    else:

        def interrupted(*_: object) -> FileReport:
            raise KeyboardInterrupt

        monkeypatch.setattr(files, "ingest_file", interrupted)
        with pytest.raises(KeyboardInterrupt):
            import_one(tmp_path / "e.db", file)
    assert left_behind(tmp_path) == []


def test_import_files_complete_file_unchanged(tmp_path: Path, file: Path) -> None:
    database = tmp_path / "e.db"
    added = import_one(database, file, small_options()).added
    before = rows_of(database)
    report = import_one(database, file)
    assert (report.status, report.added, report.present) == ("complete", (), len(added))
    with hapticdb.open(database) as env:
        assert env.add(file).status == "complete"
        assert env.store.revision() == len(added)
    assert rows_of(database) == before


def test_import_files_jobs_same_rows(tmp_path: Path) -> None:
    many = write_obj(tmp_path / "many.obj", assembly(40))
    found: list[Rows] = []
    for jobs in (1, 2, 5):
        import_one(tmp_path / f"{jobs}.db", many, small_options(jobs=jobs))
        found.append(rows_of(tmp_path / f"{jobs}.db"))
    assert len(found[0]["object"]) == 40
    assert found[0] == found[1] == found[2]


def test_import_files_progress(tmp_path: Path, file: Path) -> None:
    seen: list[ImportProgress] = []
    (report,) = hapticdb.import_files(tmp_path / "e.db", [file], small_options(), seen.append)
    assert [p.parts_done for p in seen] == list(range(1, 8))
    assert {(p.link, p.parts_total) for p in seen} == {(str(file), 7)}
    voxels = np.cumsum([o.voxels for o in report.added])
    assert [p.voxels for p in seen] == voxels.tolist()


@pytest.mark.parametrize("name", ["car\udcff", "car\0"])
def test_import_files_bad_link_name(
    name: str, file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read = read_file

    def named(path: str, *, unit: str | None = None) -> MeshFile:
        return replace(read(path, unit=unit), link=name)

    monkeypatch.setattr(files, "read_file", named)
    with pytest.raises(hapticdb.errors.FileError, match="is no text") as raised:
        hapticdb.import_files(tmp_path / "e.db", [str(file)])
    str(raised.value).encode()  # the message itself can be printed
    assert not (tmp_path / "e.db").exists()


def test_import_files_concurrent_add_and_remove(
    tmp_path: Path, file: Path, parts: list[Part], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another process removes the part after the engine has refused to add it again."""
    calls: list[str] = []
    add = FileTables.add

    def overtaken(writer: FileTables, record: Object, rows: base.Rows, surface: bytes) -> int:
        calls.append(record.name)
        if len(calls) == 2:
            raise present_already(record, "a.db")
        return add(writer, record, rows, surface)

    monkeypatch.setattr(FileTables, "add", overtaken)
    report = import_one(tmp_path / "a.db", file)
    names = [part.name for part in parts]
    assert calls == [names[0], names[1], *names[1:]]
    assert [obj.name for obj in report.added] == names
    assert report.present == 0
