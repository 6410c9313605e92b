"""The real-time benchmarks run on a tiny scene."""

from pathlib import Path

import numpy as np
import pytest

import hapticdb
from across import over, places_over
from editing import edits
from hapticdb import GridOptions, ImportOptions, PointShell
from hapticdb.poses import read_poses
from hapticdb.sample import SampleFiles, write_sample
from in_real_time import RUNS, lifted, measure_frames, table

TIMES = {"p50": 1e-5, "p99": 2e-5, "p999": 3e-5, "worst": 4e-5}
LOOP = {"rate": 999.5, "missed": 3, "lateness": TIMES, "elapsed": TIMES}


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> SampleFiles:
    return write_sample(tmp_path_factory.mktemp("sample"), count=20)


@pytest.fixture(scope="module")
def database(sample: SampleFiles) -> Path:
    path = Path(sample.car).with_name("car.db")
    options = ImportOptions(grid=GridOptions(bits=7, extent=1.6), distances=False)
    hapticdb.import_files(path, [sample.car], options)
    return path


def test_cells_and_the_dense_bitmap_feel_the_same(database: Path, sample: SampleFiles) -> None:
    """`measure_frames` compares every bit itself; this test asserts that there were hits."""
    shell = PointShell.from_file(sample.wrench, 3000)
    found = measure_frames(database, shell, read_poses(sample.path), [])
    assert found["hits"] > 0
    assert set(found["ratio"]) == set(RUNS)


def test_a_part_is_lifted_without_hitting_itself(database: Path, sample: SampleFiles) -> None:
    found = lifted(database, Path(sample.car), "body/hood")
    assert found["points"] == 100_000
    assert found["hits"] < 0.5 * found["points"]


def test_a_table_has_a_row_for_each_measurement() -> None:
    frame = {
        "part": "body/hood",
        "points": 300,
        "hits": 1.0,
        "us_per_frame": {"dense": 10.0},
        "ratio": {"flat": 1.1, "clusters": 0.3},
    }
    session = {"engine": "SQLite", "rate": 1000, "loop": LOOP, "empty": LOOP, "unknown_frames": 0}
    edit = {
        "engine": "PostgreSQL",
        "edits": 60,
        "voxels": 1000,
        "felt_after_ms": {"p50": 2.0, "p90": 4.0, "worst": 9.0},
        "unknown_frames": 0,
    }
    text = table({"frames": [frame] * 3, "sessions": [session] * 2, "edits": [edit]})
    assert text.count("body/hood") == 3
    assert text.count("SQLite") == 2
    assert text.count("2.0 / 4.0 / 9.0") == 1


def test_edits_are_felt_and_taken_back(database: Path, sample: SampleFiles) -> None:
    with hapticdb.open(database, read_only=True) as env:
        before = [(obj.id, obj.transform.tolist(), obj.voxels) for obj in env.objects()]
    found = edits(str(database), Path(sample.wrench), Path(sample.path), n_edits=2)
    assert (found["edits"], found["voxels"] > 0) == (2, True)
    with hapticdb.open(database, read_only=True) as env:
        assert [(obj.id, obj.transform.tolist(), obj.voxels) for obj in env.objects()] == before


def test_a_hand_flies_over_every_place(database: Path) -> None:
    with hapticdb.open(database, read_only=True) as env:
        tops = places_over(env, "body/roof")
    aside = np.array([5.0, 0.0, 0.0])
    hand = over(np.concatenate([tops, tops + aside]), 4.0)
    assert hand.duration > 5.0 / 4.0
