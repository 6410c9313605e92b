"""Copies equal their source at another place: at tiny sizes, on every engine found."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import hapticdb
import scale
from copies import Plan, Source
from hapticdb import Object
from hapticdb.bench.workload import random_poses, sphere_shell
from hapticdb.errors import DatabaseError, UsageError
from hapticdb.grid import Grid
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.kernels.surfaces.voxelize import brick_voxels
from places import EnginePlace, place_of
from scale import Built, ScaleSize, stored
from servers import FOUND
from validity import assert_valid

BITS = 7
ENGINES = ["sqlite", *(str(found.major) for found in FOUND if not isinstance(found, str))]
COUNTS = (1, 2, 4)


class Car(NamedTuple):
    """One sample car, its file, and the folder in which environments are built."""

    source: Source
    home: Path
    folder: Path

    def size(self, copies: int) -> ScaleSize:
        return ScaleSize(Plan.of(self.source, copies), copies, self.home)


@pytest.fixture(scope="module")
def car(tmp_path_factory: pytest.TempPathFactory) -> Car:
    folder = tmp_path_factory.mktemp("scale")
    return Car(*scale.car_at_home(folder, BITS), folder)


@pytest.fixture(scope="module", params=ENGINES)
def engine(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def place(engine: str, car: Car) -> Iterator[EnginePlace]:
    with place_of(engine, car.folder) as found:
        yield found


@pytest.fixture(scope="module")
def builds(engine: str, place: EnginePlace, car: Car) -> dict[int, Built]:
    """Number of copies -> built environment."""
    found = {n: Built(engine, place, car.size(n), car.folder) for n in COUNTS}
    for built in found.values():
        stored(built, may_build=True)
    return found


@pytest.mark.parametrize("copies", COUNTS)
def test_a_copy_feels_like_the_car_by_itself(
    car: Car, builds: dict[int, Built], copies: int
) -> None:
    plan = builds[copies].size.plan
    shell = sphere_shell(plan.grid.voxel_size)
    n_hits = 0
    with hapticdb.open(car.home) as home, hapticdb.open(builds[copies].url) as env:
        for pose in random_poses(home, 20):
            wanted = home.touch(shell, pose)
            n_hits += len(wanted.hits)
            for copy, offset in enumerate(plan.offsets()):
                moved = pose.copy()
                moved[:3, 3] += offset
                felt = env.touch(shell, moved)
                assert felt.hits.tolist() == wanted.hits.tolist()
                np.testing.assert_allclose(felt.force, wanted.force, rtol=1e-6, atol=1e-9)
                names = [f"copy {copy}/{obj.name}" for obj in wanted.objects]
                assert sorted(obj.name for obj in felt.objects) == sorted(names)
    assert n_hits > 100


@pytest.mark.parametrize("copies", COUNTS)
def test_an_environment_of_copies_is_valid(car: Car, builds: dict[int, Built], copies: int) -> None:
    cell = builds[copies].cell()
    assert cell is not None
    with hapticdb.open(car.home) as home, hapticdb.open(builds[copies].url) as env:
        assert_valid(env)
        objects = env.objects()
        assert cell["rows"] == env.size().rows == copies * home.size().rows
        assert cell["object_voxels"] == copies * sum(obj.voxels for obj in home.objects())
        assert len(objects) == len({obj.name for obj in objects}) == copies * len(home.objects())
        low, high = env.grid.bounds
        assert all((obj.bounds >= low).all() and (obj.bounds <= high).all() for obj in objects)


def test_a_copy_can_be_taken_out(engine: str, place: EnginePlace, car: Car) -> None:
    built = Built(engine, place, car.size(3), car.folder)
    built.build()
    with hapticdb.open(built.url) as env:
        rows = env.size().rows
        for obj in env.objects():
            if obj.name.startswith("copy 1/"):
                env.remove(obj.id)
        assert_valid(env)
        assert env.size().rows == rows - rows // 3


@given(
    copies=st.integers(1, 256),
    voxels=st.sets(st.tuples(*[st.integers(0, 31)] * 3), min_size=1, max_size=30),
    choice=st.integers(0, 255),
)
def test_shifted_keys_are_shifted_voxels(
    copies: int, voxels: set[tuple[int, int, int]], choice: int
) -> None:
    grid = Grid(0.1, (1.0, 2.0, 3.0), 5)
    ijk = np.array(sorted(voxels))
    record = Object(
        name="part",
        link="made",
        digest="",
        transform=np.eye(4),
        voxels=len(ijk),
        bounds=grid.centers(ijk[[0, -1]]),
    )
    rows = rows_of_voxels(ijk, grid, "brick")
    plan = Plan.of(Source(grid, "brick", ((record, rows),)), copies)
    copy = choice % copies
    ((moved, there),) = plan.parts_of(copy)
    found = brick_voxels(there.keys, there.occupancy.reshape(-1, 64))
    assert sorted(map(tuple, (found - plan.tiles[copy] * grid.side).tolist())) == sorted(voxels)
    assert plan.grid.contains(found).all()
    # the record's bounds fit the rows
    first = plan.grid.voxels_of(moved.bounds[:1]) - plan.tiles[copy] * grid.side
    assert first.tolist() == ijk[:1].tolist()
    np.testing.assert_allclose(moved.transform[:3, 3], plan.offsets()[copy])


@given(copies=st.integers(1, 256))
def test_copies_stand_on_a_square_each_on_its_own_tile(copies: int) -> None:
    grid = Grid(0.1, (0.0, 0.0, 0.0), 11)
    plan = Plan.of(Source(grid, "brick", ()), copies)
    tiles = {tuple(tile) for tile in plan.tiles.tolist()}
    assert len(tiles) == copies
    assert plan.tiles.max() ** 2 < copies
    assert (plan.tiles[:, 2] == 0).all()
    keys = plan.grid.encode(plan.tiles * grid.side)
    assert (np.diff(keys) > 0).all()


def test_part_of_a_car_is_some_of_its_objects(car: Car) -> None:
    wanted = car.source.voxels / 10
    (size,) = scale.sizes_of(car.folder, [wanted], BITS)
    assert 0.5 * wanted < size.plan.voxels <= wanted
    assert size.copies == pytest.approx(size.plan.voxels / car.source.voxels, abs=1e-3)
    whole = {obj.name for obj, _ in car.source.parts}
    assert {obj.name for obj, _ in size.plan.source.parts} < whole


def test_what_is_built_is_not_built_again(
    engine: str,
    place: EnginePlace,
    car: Car,
    builds: dict[int, Built],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def refuse(_: Built) -> None:
        pytest.fail("built again")

    monkeypatch.setattr(Built, "build", refuse)
    again = Built(engine, place, car.size(2), car.folder)
    assert stored(again, may_build=True) == builds[2].cell()


def test_what_was_cut_off_is_built_anew(
    engine: str, place: EnginePlace, car: Car, monkeypatch: pytest.MonkeyPatch
) -> None:
    built = Built(engine, place, car.size(5), car.folder)

    def end(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as cut:
        cut.setattr(scale, "write_copies", end)
        with pytest.raises(KeyboardInterrupt):
            built.build()
    assert built.cell() is None
    with pytest.raises(UsageError, match="not built"):
        stored(built, may_build=False)
    assert stored(built, may_build=True)["copies"] == 5


def test_the_command_writes_storage_and_frames(
    engine: str, car: Car, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(scale, "ROUNDS", 2)
    voxels = car.source.voxels
    out = tmp_path / "results" / "scale.json"
    sizes = f"{voxels / 10},{voxels},{2 * voxels}"
    fixed = ["--folder", str(tmp_path), "--bits", str(BITS), "--poses", "20", "--out", str(out)]
    scale.main([*fixed, "--engines", engine, "--sizes", sizes])
    found = json.loads(out.read_text())
    frames = [cell for cell in found["cells"] if "us" in cell]
    assert found["name"] == "scale"
    assert len(found["cells"]) - len(frames) == 3
    assert len(frames) == 3 * 2 * 3
    for cell in frames:
        assert cell["frames"] == 20
        assert not cell["cut_short"]
        assert cell["hits"] > 0
        assert cell["false_rows"] >= 0
        assert cell["bytes_per_voxel"] > 0
    whole = [cell for cell in frames if cell["copies"] >= 1 and cell["strategy"] == "array"]
    for kind in ("slide", "random"):
        same = [(cell["hits"], cell["rows"]) for cell in whole if cell["poses"] == kind]
        assert same[0] == same[1]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--engines", "9"], "choose sqlite or a PostgreSQL"),
        (["--sizes", "many"], "many"),
        (["--sizes", "1e15"], "bits an axis"),
        (["--sizes", "1"], "give a larger size"),
        (["--measure"], "not built"),
    ],
)
def test_a_mistake_is_told_in_one_line(
    arguments: list[str], message: str, car: Car, tmp_path: Path
) -> None:
    out = tmp_path / "out.json"
    fixed = ["--bits", str(BITS), "--folder", str(car.folder), "--out", str(out)]
    with pytest.raises(SystemExit) as stopped:
        scale.main([*fixed, *arguments])
    assert message in str(stopped.value)
    assert "\n" not in str(stopped.value)
    assert not out.exists()


def test_a_full_disk_is_told_before_anything_is_built(
    car: Car, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with place_of("sqlite", tmp_path) as place:
        built = Built("sqlite", place, car.size(1), tmp_path)
        usage = shutil.disk_usage(tmp_path)._replace(free=10**9)
        monkeypatch.setattr(shutil, "disk_usage", lambda _: usage)
        with pytest.raises(DatabaseError, match=r"1\.0 GB free"):
            scale.check_room([built], tmp_path)
        built.build()
        scale.check_room([built], tmp_path)  # everything is built, so no room is needed
