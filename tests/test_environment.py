"""An opened environment: its objects, moving and removing them, and what other readers see."""

import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import hapticdb
from assemblies import (
    assembly,
    ball,
    drop_surfaces,
    index_rows,
    oracle_voxels,
    placement,
    rows_of,
    small_grid,
    small_options,
    voxel_set,
    write_obj,
)
from hapticdb import Environment, Object, PointShell
from hapticdb.check import check_environment
from hapticdb.grid import CurveName
from hapticdb.ingest import object_moves
from hapticdb.ingest.geometry import parts_of
from hapticdb.mesh import parse_in_process
from hapticdb.paper.cost_model import machine_name
from hapticdb.store.base import Layout, Store
from mesh_files import gltf
from voxels import KINDS

ELSEWHERE = placement(0.03, -0.05, 0.04, 0.7)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment of four objects in a grid of 32^3 voxels, whose file is gone."""
    folder = tmp_path_factory.mktemp("made")
    file = write_obj(folder / "assembly.obj", assembly(4))
    hapticdb.import_files(folder / "e.db", [file], small_options())
    file.unlink()
    return folder / "e.db"


@pytest.fixture
def env(tmp_path: Path, made: Path) -> Environment:
    shutil.copy(made, tmp_path)
    return hapticdb.open(tmp_path / "e.db")


def write_balls(path: Path, *placed: NDArray[np.float64]) -> Path:
    """A glTF file: a ball of 40 mm for each placement."""
    vertices, faces = ball((0, 0, 0), 0.04)
    nodes = [
        {"name": f"ball {n}", "mesh": 0, "matrix": p.T.ravel().tolist()}
        for n, p in enumerate(placed)
    ]
    tree = {"nodes": nodes, "scenes": [{"nodes": list(range(len(nodes)))}]}
    return gltf(tree, path, vertices.astype(np.float32), faces.ravel().tolist())


def test_objects_newest_revision(env: Environment, tmp_path: Path) -> None:
    ids = [obj.id for obj in env.objects()]
    with hapticdb.open(tmp_path / "e.db") as other:
        other.remove(ids[1])
        assert [obj.id for obj in env.objects()] == [ids[0], *ids[2:]]
        env.remove(ids[2])
        assert [obj.id for obj in env.find("*")] == [ids[0], *ids[3:]]
        assert [obj.id for obj in other.select(exclude=[ids[0]])] == ids[3:]
    env.objects().clear()
    assert [obj.id for obj in env.objects()] == [ids[0], *ids[3:]]


def test_objects_reread_after_error(
    env: Environment, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    wanted = env.objects()
    env.remove(wanted[0].id)

    def failing(*_: object) -> None:
        raise KeyboardInterrupt

    with hapticdb.open(tmp_path / "e.db") as other, monkeypatch.context() as patch:
        patch.setattr(other.store, "objects", failing)
        with pytest.raises(KeyboardInterrupt):
            other.objects()
        patch.undo()
        assert [obj.id for obj in other.objects()] == [obj.id for obj in wanted[1:]]
        env.remove(wanted[1].id)
        patch.setattr(other.store, "object", failing)
        with pytest.raises(KeyboardInterrupt):
            other.objects()
        patch.undo()
        assert [obj.id for obj in other.objects()] == [obj.id for obj in wanted[2:]]


@pytest.mark.parametrize(("layout", "curve"), KINDS)
def test_move_equals_import_at_new_pose(tmp_path: Path, layout: Layout, curve: CurveName) -> None:
    (tmp_path / "there").mkdir()
    here = write_balls(tmp_path / "balls.gltf", placement(0, 0, 0), placement(0.02, 0, 0))
    there = write_balls(tmp_path / "there" / "balls.gltf", ELSEWHERE, placement(0.02, 0, 0))
    options = small_options(curve, layout)
    hapticdb.import_files(tmp_path / "e.db", [here], options)
    hapticdb.import_files(tmp_path / "there" / "e.db", [there], options)
    with (
        hapticdb.open(tmp_path / "e.db") as env,
        hapticdb.open(tmp_path / "there" / "e.db", read_only=True) as fresh,
    ):
        before, old = index_rows(env), env.object(1)
        with pytest.raises(hapticdb.errors.UsageError, match=r"'ball \*' selects 2 objects"):
            env.move("ball *", ELSEWHERE)
        moved = env.move("ball 0", ELSEWHERE)
        assert index_rows(env) == index_rows(fresh) != before
        wanted = fresh.object(1)
        assert (moved.id, moved.name, moved.digest) == (1, "ball 0", wanted.digest)
        assert (moved.voxels, moved.revision, moved.link) == (wanted.voxels, 3, str(here))
        np.testing.assert_array_equal(moved.transform, wanted.transform)
        np.testing.assert_array_equal(moved.bounds, wanted.bounds)
        np.testing.assert_array_equal(env.voxels(1), fresh.voxels(1))

        *_, change = env.store.changes()
        assert (change.revision, change.action, change.id) == (3, "move", 1)
        shift = 9 if layout == "brick" else 0
        keys = np.array([row[0] for row in before ^ index_rows(env)])[:, None] << shift
        inside = (keys >= change.ranges[:, 0]) & (keys <= change.ranges[:, 1])
        assert inside.any(axis=1).all()

        env.move(1, old.transform)
        assert index_rows(env) == before


def test_move_random_series_equals_fresh_import(tmp_path: Path) -> None:
    """No row of an earlier place remains, even when that place was at the grid's border."""
    rng = np.random.default_rng(11)
    n_balls = 3
    file = write_balls(tmp_path / "balls.gltf", *[placement(0, 0, 0)] * n_balls)
    hapticdb.import_files(tmp_path / "e.db", [file], small_options("hilbert", "brick"))
    last = [np.eye(4)] * n_balls
    with hapticdb.open(tmp_path / "e.db") as env:
        for _ in range(8):
            n = int(rng.integers(n_balls))
            x, y, z = rng.choice([-0.12, -0.1, 0.0, 0.0371, 0.12], 3)
            last[n] = placement(x, y, z, rng.choice([0.0, np.pi / 4, 1.0]))
            env.move(n + 1, last[n])
        (tmp_path / "there").mkdir()
        fresh = hapticdb.create(tmp_path / "there" / "e.db", env.grid, layout="brick")
        fresh.add(write_balls(tmp_path / "there" / "balls.gltf", *last))
        assert index_rows(env) == index_rows(fresh)


def test_move_unit_of_import(tmp_path: Path) -> None:
    block = write_obj(tmp_path / "block.obj", {"ball": ball((0, 0, 0), 40)})
    with hapticdb.create(tmp_path / "e.db", small_grid()) as env:
        env.add(block, unit="mm")
        moved = env.move(1, placement(0.1, 0, 0))
        np.testing.assert_allclose(moved.bounds.mean(axis=0), (0.1, 0, 0), atol=1e-12)
        part = parse_in_process(block, unit="mm").parts[0]
        part.world_from_part[:] = moved.transform
        assert voxel_set(env.voxels(1)) == oracle_voxels(part, env.grid)


def test_environment_independent_of_its_files(env: Environment) -> None:
    """Tools of parts, moves and removals, of the last object of a shape, too."""
    assert len(env.shell(1, 3, points=200)) == 200
    before = index_rows(env)
    home = env.object(2).transform
    env.move(2, ELSEWHERE)
    assert index_rows(env) != before
    env.move(2, home)
    env.shift([1, 3], (0.01, 0, 0))
    env.shift([1, 3], (-0.01, 0, 0))
    removed = env.remove(2)
    assert removed.digest not in env.store.surface_digests()
    assert env.restore(removed).id == 2
    assert index_rows(env) == before
    assert check_environment(env.url).findings == []


def test_move_object_without_surface(env: Environment) -> None:
    drop_surfaces(env.url)
    before = rows_of(Path(env.url))
    for edit in (env.shell, lambda number: env.move(number, ELSEWHERE)):
        with pytest.raises(hapticdb.errors.DamagedError, match=r"object 2 \(box 1\) has no surf"):
            edit(2)
    assert rows_of(Path(env.url)) == before
    removed = env.remove(2)
    with pytest.raises(hapticdb.errors.UsageError, match="cannot be put back"):
        env.restore(removed)
    report = check_environment(env.url)
    assert len(report.findings) == 3
    assert all(finding.endswith("has no surface") for finding in report.findings)


def test_move_bad_or_outside_grid(env: Environment) -> None:
    before = rows_of(Path(env.url))
    for far in (placement(0.3, 0, 0), placement(0, 0, -0.3), placement(1e300, 0, 0)):
        with pytest.raises(hapticdb.errors.OutsideGridError, match="part 'ball 0' spans"):
            env.move(1, far)
    for wrong in (
        np.eye(3), np.full((4, 4), np.nan), np.diag([1.0, 1.0, 0.0, 1.0]),
        np.diag([1, 1, 1, 2.0]), np.eye(4)[:, ::-1],
    ):  # fmt: skip
        with pytest.raises(hapticdb.errors.UsageError):
            env.move(1, wrong)
    assert rows_of(Path(env.url)) == before


@pytest.mark.parametrize("layout", ["voxel", "brick"])
def test_move_concurrent_leaves_no_stray_rows(
    tmp_path: Path, layout: Layout, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two editors move one object at once: it ends at the place of the last writer only."""
    file = write_balls(tmp_path / "balls.gltf", placement(-0.1, 0, 0))
    hapticdb.import_files(tmp_path / "e.db", [file], small_options("z", layout))
    env, other = hapticdb.open(tmp_path / "e.db"), hapticdb.open(tmp_path / "e.db")

    def read_while_another_moves(store: Store, objects: list[Object]) -> object:
        monkeypatch.undo()
        other.move(1, placement(0.1, 0, 0))
        return parts_of(store, objects)

    monkeypatch.setattr(object_moves, "parts_of", read_while_another_moves)
    moved = env.move(1, placement(0, 0.1, 0))
    assert moved.revision == 3
    np.testing.assert_array_equal(moved.transform, placement(0, 0.1, 0))
    once = index_rows(env)
    env.move(1, np.eye(4))
    env.move(1, placement(0, 0.1, 0))
    assert index_rows(env) == once
    env.remove(1)
    assert not index_rows(env)


def test_read_only_environment_refuses_writes(env: Environment) -> None:
    before, file = rows_of(Path(env.url)), Path(env.url).with_name("more.obj")
    write_obj(file, assembly(1))
    reader = hapticdb.open(env.url, read_only=True)
    for write in (
        lambda: reader.add(file),
        lambda: reader.remove(1),
        lambda: reader.move(1, ELSEWHERE),
    ):
        with pytest.raises(hapticdb.errors.ReadOnlyError, match="opened to read"):
            write()
    assert rows_of(Path(env.url)) == before


def test_calibrate_stored_for_machine(env: Environment, sphere: PointShell) -> None:
    costs = env.calibrate()
    assert env.store.costs(machine_name()) == costs.figures()
    figures = [value for name, value in costs.figures().items() if "spread" not in name]
    assert all(np.isfinite(figures))
    assert costs.statement > 0
    with hapticdb.open(env.url, read_only=True) as reader:
        assert reader.touch(sphere, placement(0, 0, 0), "cbgroup").query.strategy == "cbgroup"
        assert reader._figures.both()[1] == costs
        reader.calibrate()  # a reader measures, and stores nothing
    assert env.store.costs(machine_name()) == costs.figures()
    env.calibrate(keep=False)
    assert env.store.costs(machine_name()) == costs.figures()


def test_calibrate_empty_environment(tmp_path: Path, sphere: PointShell) -> None:
    with hapticdb.create(tmp_path / "e.db", small_grid()) as env:
        touch = env.touch(sphere, np.eye(4))
        assert not touch.force.any()
        assert touch.objects == []
        assert env.quantiles(3).n_rows == 0
        with pytest.raises(hapticdb.errors.UsageError, match="import a file before"):
            env.calibrate()
