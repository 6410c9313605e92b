"""Huge parts are voxelized in bounded pieces, to the same bits, and report their progress."""

import threading
from pathlib import Path

import numpy as np
import pytest

from hapticdb.errors import FileError
from hapticdb.grid import GridOptions
from hapticdb.ingest.files import ImportOptions, ImportProgress, import_files
from hapticdb.ingest.layout import Bricks
from hapticdb.ingest.voxelizing import bricks_of_pieces, pieces_of_points
from hapticdb.kernels.surfaces import voxelize
from mesh_files import text

BITS = 8
HUGE = np.array([[[1.0, 2.0, 3.0], [250.0, 80.3, 41.7], [50.2, 251.0, 199.9]]])


def triangles() -> "np.ndarray[tuple[int, ...], np.dtype[np.float64]]":
    """Triangles: one across the grid, long thin ones, some that leave the grid, many small."""
    random = np.random.default_rng(5)
    far = random.uniform(-100.0, 400.0, (20, 3, 3))
    small = random.uniform(0.0, 255.0, (300, 1, 3)) + random.uniform(-3.0, 3.0, (300, 3, 3))
    flat = np.array([[[0.0, 0.0, 8.0], [256.0, 0.0, 8.0], [0.0, 256.0, 8.0]]])
    return np.concatenate([HUGE, far, small, flat])


@pytest.mark.parametrize("most", [1, 100])
@pytest.mark.parametrize("given", [HUGE, triangles()], ids=["one", "many"])
def test_voxelize_pieces_equal_whole(
    given: "np.ndarray[tuple[int, ...], np.dtype[np.float64]]", most: int
) -> None:
    """Each piece begins and ends within a row of a triangle."""
    keys, occupancy = voxelize.voxelize(4 * given, BITS + 2)
    found = bricks_of_pieces(voxelize.voxelize_pieces(4 * given, BITS + 2, most), "a part")
    np.testing.assert_array_equal(found.keys, keys)
    np.testing.assert_array_equal(found.occupancy, occupancy)


def test_voxelize_pieces_bounded_with_share() -> None:
    pieces = list(voxelize.voxelize_pieces(8 * HUGE, BITS + 3, 100))
    shares = [share for share, _, _ in pieces]
    assert len(pieces) > 5
    # a piece ends after the batch of runs that fills it, each of which crosses few bricks
    assert max(len(keys) for _, keys, _ in pieces) <= 100 + 2 * 1024
    assert shares == sorted(shares)
    assert 0.0 < shares[0] < 0.5 < shares[-2] < shares[-1] == 1.0


@pytest.mark.parametrize("axis", range(3))
def test_voxelize_pieces_bounded_at_coincident_triangles(axis: int) -> None:
    needle = np.full((3, 3), 3.5)
    needle[:, axis] = 0.25, 2.0**21 - 0.25, 7.0
    once = voxelize.voxelize(needle[None], 21)
    found = list(voxelize.voxelize_pieces(np.repeat(needle[None], 8, axis=0), 21, 1 << 17))
    assert len(found) >= 3
    for _, *bricks in found:
        np.testing.assert_array_equal(bricks[0], once[0])
        np.testing.assert_array_equal(bricks[1], once[1])


def test_pieces_of_points_equal_whole(monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(1).uniform(0.0, 40.0, (1000, 1, 3))
    monkeypatch.setattr("hapticdb.ingest.voxelizing.POINTS_AT_ONCE", 300)
    found = list(pieces_of_points(points, BITS))
    assert [share for share, *_ in found] == [0.3, 0.6, 0.9, 1.0]
    bricks = bricks_of_pieces(found, "a part")
    whole = voxelize.mark_points(points, BITS)
    np.testing.assert_array_equal(bricks.keys, whole[0])
    np.testing.assert_array_equal(bricks.occupancy, whole[1])
    assert bricks_of_pieces(pieces_of_points(points[:0], BITS), "a part").keys.shape == (0,)


def test_bricks_of_pieces_out_of_memory(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hapticdb.ingest.voxelizing._MERGE_FROM", 100)
    monkeypatch.setattr("hapticdb.ingest.voxelizing.bytes_available", lambda: 50_000)
    with pytest.raises(FileError, match=r"a part: its rows take .*fewer --bits"):
        bricks_of_pieces(voxelize.voxelize_pieces(HUGE, BITS, 100), "a part")
    path = text(tmp_path / "a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    options = ImportOptions(grid=GridOptions(bits=BITS), layout="voxel")
    with pytest.raises(FileError, match=str(path)):
        import_files(tmp_path / "a.db", [path], options)
    assert not (tmp_path / "a.db").exists()


@pytest.mark.parametrize("layout", ["voxel", "brick"])
def test_import_files_progress_share_of_part(
    tmp_path: Path, layout: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    told = threading.Event()
    heard: list[ImportProgress] = []

    def slow(*given: object) -> "object":
        given[2](0.5)  # type: ignore[operator]
        assert told.wait(60)
        return Bricks(*voxelize.voxelize(HUGE, BITS))

    def progress(now: ImportProgress) -> None:
        heard.append(now)
        if now.share:
            told.set()

    monkeypatch.setattr("hapticdb.ingest.voxelizing.bricks_of_pieces", slow)
    path = text(tmp_path / "a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n")
    grid = GridOptions(bits=BITS)
    options = ImportOptions(grid=grid, layout=layout, distances=False)  # type: ignore[arg-type]
    (report,) = import_files(tmp_path / "a.db", [path], options, progress)
    assert report.status == "imported"
    assert any(0.0 < now.share < 1.0 and now.parts_done == 0 for now in heard)
    assert heard[-1].share == 0.0
    assert heard[-1].parts_done == 1
