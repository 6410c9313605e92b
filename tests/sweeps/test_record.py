"""A sweep's result as text and as JSON: both say what the sweep found."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.distance import cdist

import hapticdb
from hapticdb import Environment, Grid, PointShell
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.pointshell.shell import fibonacci_sphere
from hapticdb.sweeps.record import median_spacing, sweep_record
from hapticdb.sweeps.run import sweep
from hapticdb.sweeps.verdict import MOST_NAMED, names_of, verdict_line
from hapticdb.testing import voxel_object

GRID = Grid(0.01, (0.0, 0.0, 0.0), 7)


def ball(n_points: int = 60, radius: float = 0.024) -> PointShell:
    out = fibonacci_sphere(n_points)
    return PointShell(out * radius, -out, np.zeros(3))


def path(*places: tuple[float, float, float]) -> np.ndarray:
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = places
    return poses


THROUGH = path((0.2, 0.6, 0.6), (1.0, 0.6, 0.6))


@pytest.fixture
def env(tmp_path: Path) -> Iterator[Environment]:
    """An environment: a plate of one voxel's thickness across the tool's path."""
    with hapticdb.create(tmp_path / "plate.db", GRID) as made:
        ijk = np.stack(np.meshgrid([60], range(50, 70), range(50, 70), indexing="ij"), axis=-1)
        ijk = ijk.reshape(-1, 3)
        made.store.add(voxel_object(GRID, ijk, "plate"), rows_of_voxels(ijk, GRID, made.layout))
        yield made


def test_the_record_holds_what_the_sweep_found_and_is_json(env: Environment) -> None:
    shell = ball()
    found = sweep(env, shell, THROUGH)
    record = json.loads(json.dumps(sweep_record(found, shell, [3], [3, 4])))
    assert record["line"] == verdict_line(found, shell)
    assert (record["verdict"], record["hits"], record["samples"]) == (
        "hits", found.hits, found.samples,
    )  # fmt: skip
    assert [one["name"] for one in record["objects"]] == ["plate"]
    assert (record["tool"]["parts"], record["tool"]["excluded"]) == ([3], [3, 4])
    assert record["proportions"] == json.loads(json.dumps(found.proportions.record()))


def test_the_median_spacing_is_that_of_all_pairs_of_points() -> None:
    shell = ball(400)
    apart = cdist(shell.points, shell.points)
    np.fill_diagonal(apart, np.inf)
    assert median_spacing(shell) == pytest.approx(float(np.median(apart.min(axis=1))))
    assert median_spacing(ball(1)) == 0.0


def test_a_phrase_names_a_few_objects_and_counts_the_others() -> None:
    objects = [voxel_object(GRID, np.array([[0, 0, 0]]), name) for name in "abcde"]
    assert names_of(objects[:MOST_NAMED]) == "a, b, c"
    assert names_of(objects) == "a, b, c and 2 more"
