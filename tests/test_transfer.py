"""Copies of environments: equal content in any layout and curve; a cut-off copy can go on."""

from contextlib import closing
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import apsw
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import hapticdb
from assemblies import PAIRS, Kind, left_behind, make, placement, rows_of, voxel_set
from hapticdb import Environment, Grid, copy_environment, diff_environments
from hapticdb.check import check_environment
from hapticdb.grid import CurveName
from hapticdb.ingest import geometry
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.kernels.field import packing
from hapticdb.store.base import Band, Rows
from hapticdb.store.sqlite.sqlite_store import SQLiteStore
from hapticdb.transfer import CopyReport
from voxels import blob, voxel_object, with_distances, write_voxels

PLACES = ((10, 10, 10), (13, 10, 10), (11, 14, 9), (22, 22, 22))


def make_blobs(path: Path, kind: Kind = ("brick", "z")) -> Path:
    """An environment of four objects with ids 2, 3, 5 and 9; three of them share voxels."""
    with make(path, kind) as env:
        for n, object_id in enumerate((2, 3, 5, 9)):
            add(env, blob(n, PLACES[n]), f"blob {n}", id=object_id)
    return path


def add(env: Environment, ijk: NDArray[np.int64], name: str, **fields: Any) -> int:  # noqa: ANN401
    record = replace(voxel_object(env.grid, ijk, name), **fields)
    return env.store.add(record, rows_of_voxels(ijk, env.grid, env.layout))


def change(path: Path, *statements: str) -> None:
    with closing(apsw.Connection(str(path))) as connection:
        for sql in statements:
            connection.execute(sql)


@st.composite
def scattered(draw: st.DrawFn, bits: int) -> NDArray[np.int64]:
    """Distinct random voxels, at least one."""
    coordinate = st.integers(0, 2**bits - 1)
    found = draw(st.sets(st.tuples(coordinate, coordinate, coordinate), min_size=1, max_size=60))
    return np.array(sorted(found), dtype=np.int64)


@pytest.mark.parametrize("most_rows", [1, 1 << 19])
@pytest.mark.parametrize(("kind", "other"), PAIRS, ids=str)
def test_copy_environment_layouts_and_curves_round_trip(
    monkeypatch: pytest.MonkeyPatch, kind: Kind, other: Kind, most_rows: int
) -> None:
    """A copy and a copy back, in one batch and in many, also on grids smaller than a brick."""
    monkeypatch.setattr(geometry, "MOST_ROWS", most_rows)

    @settings(max_examples=3, deadline=None)
    @given(drawn=st.integers(1, 7).flatmap(lambda b: st.tuples(st.just(b), scattered(b))))
    def there_and_back(drawn: tuple[int, NDArray[np.int64]]) -> None:
        bits, ijk = drawn
        with TemporaryDirectory() as folder:
            here, there, back = (Path(folder) / f"{n}.db" for n in range(3))
            with make(here, kind, bits) as env:
                write_voxels(env.store, ijk, "one")
                write_voxels(env.store, ijk[::2], "two")
            copy_environment(here, there, layout=other[0], curve=other[1])
            copy_environment(there, back, layout=kind[0], curve=kind[1])
            with hapticdb.open(there, read_only=True) as env:
                assert (env.layout, env.grid.curve) == other
                assert voxel_set(env.voxels(1)) == voxel_set(ijk)
                assert voxel_set(env.voxels(2)) == voxel_set(ijk[::2])
            tables = ("object", kind[0])
            assert rows_of(back, *tables) == rows_of(here, *tables)

    there_and_back()


def test_copy_environment_all_object_fields(tmp_path: Path) -> None:
    source = tmp_path / "a.db"
    with make(source) as env:
        ijk = blob(1, PLACES[0])
        placed = placement(0.1, 1 / 3, -2e-9, 0.3)
        attributes = {"unit": "mm", "paint": {"colour": "grün"}}
        add(env, ijk, "ä/b", id=7, transform=placed, attributes=attributes, link="/over/there.obj")
    report = copy_environment(source, tmp_path / "b.db", layout="voxel", curve="lexicographic")
    assert report == CopyReport(str(source), str(tmp_path / "b.db"), 1, len(ijk), 0, 0)
    with hapticdb.open(source) as a, hapticdb.open(tmp_path / "b.db") as b:
        (left,), (right,) = a.objects(), b.objects()
    for name, value in vars(left).items():
        if name != "rows_crc":  # a checksum of rows, which differ between layouts
            np.testing.assert_array_equal(getattr(right, name), value)
    assert right.id == 7


def test_copy_environment_batch_size(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    source = make_blobs(tmp_path / "a.db")
    monkeypatch.setattr(geometry, "MOST_ROWS", 8)
    brought: list[int] = []
    rows_of_object = SQLiteStore.rows_of

    def counting(reader: SQLiteStore, *asked: Any, distances: bool = False) -> Any:  # noqa: ANN401
        rows = rows_of_object(reader, *asked, distances=distances)
        brought.append(len(rows))
        return rows

    monkeypatch.setattr(SQLiteStore, "rows_of", counting)
    copy_environment(source, tmp_path / "b.db")
    assert max(brought) <= 8
    assert len(brought) > 12
    assert diff_environments(source, tmp_path / "b.db").is_equal


def test_copy_environment_taken_id_renumbered(tmp_path: Path) -> None:
    source = make_blobs(tmp_path / "a.db")
    with make(tmp_path / "b.db", ("voxel", "hilbert")) as env:
        for n in range(3):
            write_voxels(env.store, blob(9, PLACES[0]), f"other {n}")
    report = copy_environment(source, tmp_path / "b.db")
    assert (report.copied, report.renumbered) == (4, 2)
    with hapticdb.open(tmp_path / "b.db") as env:
        ids = {obj.name: obj.id for obj in env.objects()}
        assert (ids["blob 2"], ids["blob 3"], ids["other 1"], ids["other 2"]) == (5, 9, 2, 3)
        assert voxel_set(env.voxels(ids["blob 0"])) == voxel_set(blob(0, PLACES[0]))
    found = diff_environments(source, tmp_path / "b.db")
    assert [obj.name for obj in found.only_in_b] == ["other 0", "other 1", "other 2"]
    assert [pair[0].id for pair in found.renumbered] == [2, 3]
    assert (found.compared, found.voxels) == (4, ())


@pytest.mark.parametrize(
    ("sql", "word"),
    [
        ("UPDATE object SET digest = 'else' WHERE id = 5", "with another geometry"),
        ("UPDATE object SET transform = zeroblob(128) WHERE id = 5", "in another place"),
        ("UPDATE object SET voxels = 7 WHERE id = 5", "with 7 voxels instead of"),
    ],
)
def test_copy_environment_conflict_before_writing(tmp_path: Path, sql: str, word: str) -> None:
    source = make_blobs(tmp_path / "a.db")
    copy_environment(source, tmp_path / "b.db")
    change(
        tmp_path / "b.db", sql, "DELETE FROM brick WHERE id = 2", "DELETE FROM object WHERE id=2"
    )
    before = rows_of(tmp_path / "b.db")
    with pytest.raises(hapticdb.errors.ConflictError, match=rf"object 5 \(blob 2\) of .* {word}"):
        copy_environment(source, tmp_path / "b.db")
    assert rows_of(tmp_path / "b.db") == before


@pytest.mark.parametrize("spelling", ["{0}", "sqlite:///{0}", "{1}/x/../a.db", "{1}/link.db"])
def test_copy_environment_onto_itself(tmp_path: Path, spelling: str) -> None:
    source = make_blobs(tmp_path / "a.db")
    (tmp_path / "x").mkdir()
    (tmp_path / "link.db").symlink_to(source)
    before = rows_of(source)
    with pytest.raises(hapticdb.errors.UsageError, match="are one"):
        copy_environment(source, spelling.format(source, tmp_path))
    assert rows_of(source) == before


def test_copy_environment_other_grid(tmp_path: Path) -> None:
    source = make_blobs(tmp_path / "a.db")
    hapticdb.create(tmp_path / "b.db", Grid(0.010001, (-0.1, 0.2, -0.3), 5)).close()
    with pytest.raises(hapticdb.errors.GridError, match="another grid"):
        copy_environment(source, tmp_path / "b.db")
    found = diff_environments(source, tmp_path / "b.db")
    assert not found.is_same_grid
    assert not found.is_equal


@pytest.mark.parametrize(
    ("asked", "word"),
    [({"layout": "voxel"}, "has the layout brick"), ({"curve": "hilbert"}, "has the curve z")],
)
def test_copy_environment_other_layout_or_curve(
    tmp_path: Path, asked: dict[str, Any], word: str
) -> None:
    source = make_blobs(tmp_path / "a.db", ("voxel", "hilbert"))
    make(tmp_path / "b.db").close()
    with pytest.raises(hapticdb.errors.UsageError, match=word):
        copy_environment(source, tmp_path / "b.db", **asked)
    assert copy_environment(source, tmp_path / "b.db").copied == 4


@pytest.mark.parametrize(
    ("kind", "asked", "word"),
    [
        (("brick", "z"), {"curve": "lexicographic"}, "hierarchical"),
        (("voxel", "lexicographic"), {"layout": "brick"}, "hierarchical"),
        (("brick", "z"), {"curve": "peano"}, "peano"),
        (("brick", "z"), {"layout": "heap"}, "heap"),
    ],
)
def test_copy_environment_impossible_target(
    tmp_path: Path, kind: Kind, asked: dict[str, Any], word: str
) -> None:
    source = make_blobs(tmp_path / "a.db", kind)
    before = left_behind(tmp_path)
    with pytest.raises(hapticdb.errors.UsageError, match=word):
        copy_environment(source, tmp_path / "b.db", **asked)
    assert set(left_behind(tmp_path)) - {"a.db-wal", "a.db-shm"} == set(before)


def test_copy_environment_damaged_object(tmp_path: Path) -> None:
    source = make_blobs(tmp_path / "a.db", ("voxel", "z"))
    change(source, "DELETE FROM voxel WHERE z_val = (SELECT min(z_val) FROM voxel WHERE id = 2)")
    with pytest.raises(
        hapticdb.errors.DamagedError, match=r"object 2, blob 0, has \d+ voxels instead"
    ):
        copy_environment(source, tmp_path / "b.db", layout="brick")
    assert not (tmp_path / "b.db").exists()


def test_copy_environment_concurrent_edits(tmp_path: Path) -> None:
    """A copy has the revision at which it began; started again, it reports the conflict."""
    source = make_blobs(tmp_path / "a.db")
    copy_environment(source, tmp_path / "before.db")

    def edit(done: int, _: int) -> None:
        if done == 1:
            with hapticdb.open(source) as env:
                env.remove(9)
                moved = blob(2, (20, 20, 20))
                turned = replace(
                    voxel_object(env.grid, moved, "blob 2"), id=5, transform=placement(1, 0, 0)
                )
                rows = rows_of_voxels(moved, env.grid, env.layout)
                env.store.replace(turned, rows)

    report = copy_environment(source, tmp_path / "b.db", curve="hilbert", progress=edit)
    assert report.copied == 4
    assert diff_environments(tmp_path / "before.db", tmp_path / "b.db").is_equal
    found = diff_environments(source, tmp_path / "b.db")
    assert [obj.id for obj in found.only_in_b] == [9]
    assert [pair[0].id for pair in found.moved] == [5]
    with pytest.raises(hapticdb.errors.ConflictError, match="object 5"):
        copy_environment(source, tmp_path / "b.db")


def test_copy_environment_two_at_once(tmp_path: Path) -> None:
    """The slower copy finds and accepts the objects that the faster one has written."""
    source = make_blobs(tmp_path / "a.db")

    def overtake(done: int, _: int) -> None:
        if done == 1:
            assert copy_environment(source, tmp_path / "b.db").copied == 3

    report = copy_environment(source, tmp_path / "b.db", progress=overtake)
    assert (report.copied, report.present) == (1, 3)
    assert diff_environments(source, tmp_path / "b.db").is_equal


def with_packed(ijk: NDArray[np.int64], grid: Grid, seed: int) -> Rows:
    """Rows of voxels with made-up distances that can be unpacked."""
    rows = with_distances(ijk, grid, "brick")
    values = np.full((len(rows), 1000), 255, np.uint8)
    values[:, ::50] = np.random.default_rng(seed).integers(0, 255, (len(rows), 20))
    return rows.having(Band(*packing.pack(values)))


@pytest.mark.parametrize("curves", [("z", "z"), ("z", "hilbert"), ("hilbert", "z")])
def test_copy_environment_distances_by_target(
    tmp_path: Path, curves: tuple[CurveName, CurveName]
) -> None:
    """Of objects that have them. A target that does not want them gets the voxels alone."""
    everywhere = np.array([0]), np.array([2**62])
    first, second = curves
    grid = Grid(0.01, (-0.1, 0.2, -0.3), 5, first)
    with hapticdb.create(tmp_path / "a.db", grid, distances=True) as env:
        for n, place in enumerate(PLACES[:2]):
            ijk = blob(n, place)
            rows = with_packed(ijk, grid, n) if n else rows_of_voxels(ijk, grid, "brick")
            write_voxels(env.store, ijk, f"{n}", rows)
        was = env.store.scan(*everywhere, distances=True)
    copy_environment(tmp_path / "a.db", tmp_path / "b.db", curve=second)
    hapticdb.create(tmp_path / "c.db", grid, distances=False).close()
    for target in ("b.db", "c.db"):
        copy_environment(tmp_path / "a.db", tmp_path / target)
        assert check_environment(tmp_path / target).findings == []
    with hapticdb.open(tmp_path / "b.db") as env:
        assert env.store.wants_distances
        assert [obj.has_distances for obj in env.objects()] == [False, True]
    copy_environment(tmp_path / "b.db", tmp_path / "d.db", curve=first)
    with hapticdb.open(tmp_path / "d.db") as env:
        found = env.store.scan(*everywhere, distances=True)
    assert found.distances is not None
    assert was.distances is not None
    columns = (*found[:3], *found.distances), (*was[:3], *was.distances)
    for column, other in zip(*columns, strict=True):
        np.testing.assert_array_equal(column, other)
    with hapticdb.open(tmp_path / "c.db") as env:
        assert not any(obj.has_distances for obj in env.objects())
    copy_environment(tmp_path / "a.db", tmp_path / "e.db", layout="voxel")
    assert check_environment(tmp_path / "e.db").findings == []
