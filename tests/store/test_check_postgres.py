"""Checks on reading, and `hapticdb check`, on PostgreSQL: wrong values that its types allow."""

import numpy as np
import psycopg
import pytest
from psycopg import sql

import hapticdb
from crafted import GRID
from hapticdb.store.postgres.address import parse
from hapticdb.store.postgres.store import PostgresStore
from hapticdb.testing import floor_voxels, write_voxels
from servers import Place

CRAFTED = {
    "attributes that are no object": "UPDATE object SET attributes = '[1]'",
    "bounds that are no numbers": "UPDATE object SET bounds = array_fill('nan'::float8, '{6}')",
    "bounds upside down": "UPDATE object SET bounds = '{1,1,1,0,0,0}'",
    "voxels below nothing": "UPDATE object SET voxels = -1",
    "a grid of no bits": "UPDATE environment SET bits = 0",
    "an unknown curve": "UPDATE environment SET curve = 'dragon'",
    "a view for the rows": ("ALTER TABLE brick RENAME TO t; CREATE VIEW brick AS SELECT * FROM t"),
    "changes upside down": "UPDATE change SET ranges = '{9,3}'",
    "statistics upside down": "UPDATE quantile SET bounds = '{9,3}'",
    "costs that are no numbers": 'UPDATE cost SET figures = \'{"row": "much"}\'',
    "rows without their object": "DELETE FROM object WHERE id = 2",
    "rows that are gone": "DELETE FROM brick WHERE id = 2 AND z_val % 3 = 0",
    "rows outside the grid": "UPDATE brick SET z_val = z_val + (1::bigint << 40) WHERE id = 2",
    "rows of negative keys": "UPDATE brick SET z_val = -z_val - 1 WHERE id = 2",
    "a log with a gap": "DELETE FROM change WHERE revision = 1",
    "a revision ahead": "UPDATE environment SET revision = 9",
}


@pytest.mark.long
def test_a_crafted_schema_is_told_and_found(place: Place, sphere: hapticdb.PointShell) -> None:
    pose = np.eye(4)
    pose[:3, 3] = 0.06, 0.06, 0.21
    for name, statements in CRAFTED.items():
        url = place()
        store = PostgresStore.create(url, GRID)
        voxels = floor_voxels(GRID, width=16)
        write_voxels(store, voxels, "a")
        write_voxels(store, voxels + np.array([0, 0, 40]), "b")
        store.analyze(10)
        store.save_costs("elsewhere", {"row": 1.0})
        store.close()
        assert hapticdb.check_environment(url).findings == []
        address = parse(url)
        with psycopg.connect(address.conninfo, autocommit=True) as connection:
            schema = sql.Identifier(address.environment)
            connection.execute(sql.SQL("SET search_path = {}").format(schema))
            for statement in statements.split("; "):
                connection.execute(statement.encode())
        report = hapticdb.check_environment(url)
        assert not report.is_sound, name
        assert all("\n" not in finding for finding in report.findings)
        for strategy in ("array", "statement", "cbgroup"):
            try:
                with hapticdb.open(url, read_only=True) as env:
                    env.touch(sphere, pose, strategy)
            except hapticdb.errors.DatabaseError as error:
                said = str(error)
            else:
                said = ""
            assert "\n" not in said
