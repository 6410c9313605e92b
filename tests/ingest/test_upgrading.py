"""Surfaces and distances for objects that lack them: resumable, and equal to those of an import.

An upgrade that is interrupted is a process of its own that says how many objects it has written.
"""

import dataclasses
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hapticdb
from assemblies import assembly, drop_surfaces, index_rows, small_options, write_obj
from children import child
from hapticdb import Environment, ImportOptions, upgrade_environment
from hapticdb.check import check_environment
from hapticdb.ingest.files import ImportProgress
from hapticdb.ingest.geometry import parts_of
from hapticdb.ingest.voxelizing import rows_of_part
from hapticdb.mesh import parse_in_process
from hapticdb.store.base import Layout
from servers import Place

EVERYWHERE = np.array([0]), np.array([2**62])
N_PARTS = 7
SHELL = hapticdb.PointShell(
    points=np.zeros((1, 3)), normals=np.array([[1.0, 0, 0]]), center=np.zeros(3)
)
UPGRADE = """
import sys, time
import hapticdb

def say(progress):
    if not progress.share:
        print(progress.parts_done, flush=True)
    if progress.parts_done == progress.parts_total - 1:
        time.sleep(600)

print(0, flush=True)
hapticdb.upgrade_environment(sys.argv[1], jobs=2, progress=say)
"""


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return write_obj(tmp_path / "assembly.obj", assembly(N_PARTS))


@pytest.fixture
def plain(file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An environment without distances, compared in pieces; its first object has been moved."""
    monkeypatch.setattr("hapticdb.ingest.geometry.MOST_ROWS", 3)
    hapticdb.import_files(tmp_path / "plain.db", [file], small_options(distances=False))
    with hapticdb.open(tmp_path / "plain.db") as env:
        placed = env.object(1).transform.copy()
        placed[:3, 3] += 0.013
        env.move(1, placed)
    return tmp_path / "plain.db"


def band_of(env: Environment) -> list[tuple[Any, ...]]:
    """All rows with distances."""
    rows = env.store.scan(*EVERYWHERE, distances=True)
    assert rows.distances is not None
    ends = rows.distances.ends.tolist()
    starts = [0, *ends[:-1]]
    data = rows.distances.data.tobytes()
    packed = [data[start:end] for start, end in zip(starts, ends, strict=True)]
    return list(zip(rows.keys.tolist(), rows.ids.tolist(), packed, strict=True))


def wanted_band(env: Environment, file: Path, ids: set[int]) -> list[tuple[Any, ...]]:
    """What an import of these objects at their places gives."""
    parts = {part.name: part for part in parse_in_process(file).parts}
    found: list[tuple[Any, ...]] = []
    for obj in env.objects():
        if obj.id in ids:
            rows, _ = rows_of_part(
                parts[obj.name], env.grid, "brick", obj.transform, distances=True
            )
            assert rows.distances is not None
            for n, key in enumerate(rows.keys.tolist()):
                found.append((key, obj.id, rows.distances.part(n, n + 1).data.tobytes()))
    return sorted(found)


def test_every_object_gets_the_distances_of_an_import(
    file: Path, plain: Path, place: Place
) -> None:
    """On both engines, at the object's place now. Voxels stay; open readers learn of it."""
    on_a_server = place()
    hapticdb.copy_environment(plain, on_a_server)
    for url in (str(plain), on_a_server):
        shares: list[ImportProgress] = []
        with hapticdb.open(url, read_only=True) as reader:
            before, revision = index_rows(reader), reader.store.revision()
            assert reader.touch(SHELL, np.eye(4)).law == hapticdb.TangentPlane()
            report = upgrade_environment(url, jobs=2, progress=shares.append)
            assert (report.upgraded, report.present, report.left_out) == (N_PARTS, 0, ())
            assert report.voxels == sum(obj.voxels for obj in reader.objects())
            assert [now.parts_done for now in shares if not now.share][-1] == N_PARTS
            assert reader.touch(SHELL, np.eye(4)).law == hapticdb.DistanceField()
            assert reader.has_distances
            changes = list(reader.store.changes(revision))
            assert [(c.action, c.id) for c in changes] == [("move", i + 1) for i in range(N_PARTS)]
            assert index_rows(reader) == before
            assert band_of(reader) == wanted_band(reader, file, set(range(1, N_PARTS + 1)))
        again = upgrade_environment(url)
        assert (again.upgraded, again.present, again.is_complete) == (0, N_PARTS, True)
        assert check_environment(url).findings == []


def test_parts_imported_later_get_distances_too(plain: Path, tmp_path: Path) -> None:
    upgrade_environment(plain)
    more = write_obj(tmp_path / "more.obj", assembly(2))
    hapticdb.import_files(plain, [more], ImportOptions())
    with hapticdb.open(plain) as env:
        assert env.store.wants_distances
        assert env.has_distances


@pytest.mark.long
@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT], ids=str)
@pytest.mark.parametrize("is_file", [True, False])
def test_an_interrupted_upgrade_goes_on(
    file: Path,
    plain: Path,
    place: Place,
    how: signal.Signals,
    is_file: bool,
) -> None:
    """Each object has all of its distances or none; in the end all have them."""
    url = str(plain) if is_file else place()
    if not is_file:
        hapticdb.copy_environment(plain, url)
    command = [sys.executable, "-c", UPGRADE, url]
    with child(command, stderr=subprocess.DEVNULL) as upgrading:
        assert upgrading.stdout is not None
        assert any(int(line) >= 3 for line in upgrading.stdout)
        upgrading.send_signal(how)
    assert upgrading.returncode == -how
    assert check_environment(url).findings == []
    with hapticdb.open(url, read_only=True) as env:
        done = {obj.id for obj in env.objects() if obj.has_distances}
        assert 3 <= len(done) < N_PARTS
        assert band_of(env) == wanted_band(env, file, done)
    report = upgrade_environment(url)
    assert (report.upgraded, report.present) == (N_PARTS - len(done), len(done))
    with hapticdb.open(url, read_only=True) as env:
        assert env.has_distances
        assert band_of(env) == wanted_band(env, file, set(range(1, N_PARTS + 1)))


@pytest.mark.parametrize("layout", ["brick", "voxel"])
def test_surfaces_come_from_the_files_once(
    file: Path, place: Place, tmp_path: Path, layout: Layout
) -> None:
    """What is there already is not read again; the layout voxel has surfaces and no distances."""
    hapticdb.import_files(tmp_path / "e.db", [file], small_options(layout=layout))
    on_a_server = place()
    hapticdb.copy_environment(tmp_path / "e.db", on_a_server)
    for url in (str(tmp_path / "e.db"), on_a_server):
        with hapticdb.open(url) as env:
            digests = sorted(env.store.surface_digests())
            wanted = env.store.surfaces(digests)
            assert len(wanted) == N_PARTS == env.size().surfaces
            drop_surfaces(url, digests[0])
            report = upgrade_environment(url)
            assert (report.surfaces, report.upgraded, report.present) == (1, 0, N_PARTS - 1)
            assert env.store.surfaces(digests) == wanted
    drop_surfaces(tmp_path / "e.db")
    with hapticdb.open(tmp_path / "e.db") as env:
        env.remove(1)
        assert upgrade_environment(env.url).surfaces == N_PARTS - 1
        assert env.store.surface_digests() == {obj.digest for obj in env.objects()}
        assert check_environment(env.url).findings == []


def test_any_file_that_holds_a_shape_will_do(file: Path, tmp_path: Path) -> None:
    other = write_obj(tmp_path / "other.obj", assembly(N_PARTS))
    hapticdb.import_files(tmp_path / "e.db", [file, other], small_options())
    drop_surfaces(tmp_path / "e.db")
    file.unlink()
    report = upgrade_environment(tmp_path / "e.db")
    assert (report.surfaces, report.left_out) == (2 * N_PARTS, ())


def test_objects_whose_file_is_gone_are_left_out_once(plain: Path, file: Path) -> None:
    """One reason for all of them. When the file is back, the same call goes on."""
    drop_surfaces(plain)
    hidden = file.rename(file.with_name("hidden.obj"))
    report = upgrade_environment(plain)
    ((objects, error),) = report.left_out
    assert (len(objects), report.surfaces, report.upgraded) == (N_PARTS, 0, 0)
    assert "object 1 (ball 0) and 6 of the same file cannot be upgraded" in str(error)
    hidden.rename(file)
    assert upgrade_environment(plain).upgraded == N_PARTS


def test_an_object_whose_geometry_changed_is_left_out(plain: Path, file: Path) -> None:
    """The others get surfaces and distances."""
    drop_surfaces(plain)
    changed = assembly(N_PARTS)
    vertices, faces = changed["ball 3"]
    write_obj(file, {**changed, "ball 3": (vertices * 1.01, faces)})
    report = upgrade_environment(plain)
    ((objects, error),) = report.left_out
    assert [obj.name for obj in objects] == ["ball 3"]
    assert "no longer holds the geometry that was imported" in str(error)
    assert report.surfaces == report.upgraded == N_PARTS - 1
    with hapticdb.open(plain) as env:
        assert [obj.name for obj in env.objects() if not obj.has_distances] == ["ball 3"]
        assert not env.has_distances


def test_distances_need_no_file(plain: Path, file: Path) -> None:
    with hapticdb.open(plain) as env:
        hidden = file.rename(file.with_name("hidden.obj"))
        assert upgrade_environment(plain).upgraded == N_PARTS
        assert band_of(env) == wanted_band(env, hidden, set(range(1, N_PARTS + 1)))


def test_an_object_with_other_voxels_than_its_surface_gives_is_left_out(plain: Path) -> None:
    """Such as one that another version has voxelized otherwise."""
    with hapticdb.open(plain) as env:
        obj = env.remove(2)
        rows = env.store.rows_of(3, *EVERYWHERE)
        env.store.add(obj, rows, obj.surface)
    report = upgrade_environment(plain)
    ((objects, error),) = report.left_out
    assert [obj.id for obj in objects] == [2]
    assert "its voxels are not those that its surface gives now" in str(error)
    assert report.upgraded == N_PARTS - 1
    with pytest.raises(hapticdb.errors.UsageError, match="0 jobs"):
        upgrade_environment(plain, jobs=0)


def test_parts_that_were_imported_without_their_colours_get_their_surfaces(tmp_path: Path) -> None:
    """An import that asks for what has changed brings the colours."""
    name, url = "coloured.mtl", tmp_path / "plain.db"
    file = write_obj(tmp_path / "assembly.obj", assembly(2))
    file.write_text(f"mtllib {name}\nusemtl red\n{file.read_text()}")
    hapticdb.import_files(url, [file], small_options())
    drop_surfaces(url)
    (tmp_path / name).write_text("newmtl red\nKd 1 0 0\n")
    assert upgrade_environment(url).is_complete
    with hapticdb.open(url) as env:
        assert [part.colours for _, part in parts_of(env.store, env.objects())] == [None, None]
        again = dataclasses.replace(small_options(), replace=True)
        hapticdb.import_files(url, [file], again)
        for _, part in parts_of(env.store, env.objects()):
            assert part.colours is not None
            assert (part.colours == [255, 0, 0, 255]).all()
    assert check_environment(url).is_sound
