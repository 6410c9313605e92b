"""Quantiles from the server's statistics, and plans that read only the index."""

import re

import numpy as np
import psycopg
import pytest

import hapticdb
from hapticdb import Grid
from hapticdb.query.quantiles import DEFAULT_RESOLUTION
from hapticdb.store.postgres.address import parse
from hapticdb.store.postgres.tables import statements
from hapticdb.store.postgres.tables.histogram import SERVER_RESOLUTION
from hapticdb.testing import write_voxels
from servers import Place

GRID = Grid(0.005, (0, 0, 0), 8)


@pytest.fixture
def large(place: Place) -> hapticdb.Environment:
    """Two objects of together 130,000 voxels, some of them shared, in the voxel layout."""
    env = hapticdb.create(place(), GRID, layout="voxel")
    rng = np.random.default_rng(5)
    with env.store.loading():
        for n, center in enumerate((100, 110)):
            drawn = np.unique(rng.normal(center, 22, (70_000, 3)).astype(np.int64), axis=0)
            inside = drawn[((drawn >= 0) & (drawn < 256)).all(axis=1)]
            write_voxels(env.store, inside, f"cloud {n}")
    env.store.analyze(DEFAULT_RESOLUTION)
    return env


def test_the_default_resolution_comes_from_the_server(large: hapticdb.Environment) -> None:
    served = large.quantiles()
    assert served.source == "server statistics"
    assert served.resolution == DEFAULT_RESOLUTION == SERVER_RESOLUTION
    keys = np.sort(large.store.scan(*(np.array([b]) for b in (0, 2**62))).keys)
    assert served.n_rows == pytest.approx(len(keys), rel=0.01)
    # a bucket holds 13 rows; each bound is within three buckets of its rank
    ranks = np.searchsorted(keys, served.bounds) / len(keys)
    error = np.abs(ranks - np.arange(SERVER_RESOLUTION + 1) / SERVER_RESOLUTION)
    assert error.max() <= 3 / SERVER_RESOLUTION
    assert large.quantiles(1000).source == "computed"


@pytest.mark.parametrize("form", ["lookup", "scan"])
def test_frames_are_read_from_the_index_alone(
    large: hapticdb.Environment, admin: psycopg.Connection, form: str
) -> None:
    """No heap page is fetched: the visibility map is set after loading."""
    name = parse(large.url).environment
    keys = large.quantiles(300).bounds
    text = {"lookup": statements.LOOKUP, "scan": statements.SCAN}[form]["voxel"]
    arrays = [keys.tolist()] if form == "lookup" else [keys[::2].tolist(), keys[1::2].tolist()]
    if form == "scan":
        arrays[0] = arrays[0][: len(arrays[1])]
    admin.execute(f"SET search_path = {name}")
    admin.execute("SET plan_cache_mode = force_generic_plan")
    admin.execute("SET enable_seqscan = off")
    admin.execute("SET enable_bitmapscan = off")
    types = ", ".join(["bigint[]"] * len(arrays))
    admin.execute(f"PREPARE frame({types}) AS {text}")
    values = ", ".join(f"'{{{','.join(map(str, a))}}}'" for a in arrays)
    plan = [row[0] for row in admin.execute(f"EXPLAIN (ANALYZE, BUFFERS) EXECUTE frame({values})")]
    admin.execute("DEALLOCATE frame")
    shown = "\n".join(plan)
    assert "Index Only Scan using voxel_key" in shown
    assert re.findall(r"Heap Fetches: (\d+)", shown) == ["0"]
