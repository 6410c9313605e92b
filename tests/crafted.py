"""Environments that were damaged, or crafted to do harm, and the edits that make them so."""

from contextlib import closing
from pathlib import Path

import apsw
import numpy as np

from hapticdb import Grid
from hapticdb.mesh import surface_packing
from hapticdb.paper.cost_model import CostModel, machine_name
from hapticdb.store.base import Layout
from hapticdb.store.sqlite.sqlite_store import SQLiteStore
from voxels import floor_voxels, write_voxels

GRID = Grid(0.005, (0, 0, 0), 7)
NANS = np.full(6, np.nan).tobytes().hex()
UPSIDE_DOWN = np.array([1.0, 1, 1, 0, 0, 0]).tobytes().hex()
DESCENDING = np.array([9, 3], np.int64).tobytes().hex()
BALL = surface_packing.pack(np.eye(3), np.array([[0, 1, 2]])).hex()
VIEW = "ALTER TABLE {0} RENAME TO t; CREATE VIEW {0} AS SELECT * FROM t"
CRAFTED = {
    "attributes that are no JSON": "UPDATE object SET attributes = '{'",
    "attributes that are no object": "UPDATE object SET attributes = '[1]'",
    "attributes nested deeply": f"UPDATE object SET attributes = '{'[' * 100_000}'",
    "bounds that are no numbers": f"UPDATE object SET bounds = x'{NANS}'",
    "bounds upside down": f"UPDATE object SET bounds = x'{UPSIDE_DOWN}'",
    "bounds of no length": "UPDATE object SET bounds = x''",
    "a transform of no numbers": f"UPDATE object SET transform = x'{'ff' * 128}'",
    "a transform cut short": "UPDATE object SET transform = zeroblob(64)",
    "voxels below nothing": "UPDATE object SET voxels = -1",
    "a revision below nothing": "UPDATE object SET revision = -1",
    "an id below nothing": "UPDATE object SET id = -5 WHERE id = 1",
    "a name that is no text": "UPDATE object SET name = x'00' WHERE id = 1",
    "no grid": "DELETE FROM environment",
    "a grid of no bits": "UPDATE environment SET bits = 0",
    "a grid of no size": "UPDATE environment SET voxel_size = 0",
    "a grid of text": "UPDATE environment SET bits = 'seven'",
    "an unknown curve": "UPDATE environment SET curve = 'dragon'",
    "bricks without cubes": "UPDATE environment SET curve = 'lexicographic', layout = 'brick'",
    "a view for the rows": VIEW.format("{layout}"),
    "a view for the objects": VIEW.format("object"),
    "a missing table": "DROP TABLE change",
    "a missing column": "DROP INDEX object_digest; ALTER TABLE object DROP COLUMN digest",
    "changes upside down": f"UPDATE change SET ranges = x'{DESCENDING}'",
    "changes cut short": "UPDATE change SET ranges = x'00'",
    "an unknown action": "UPDATE change SET action = 'paint'",
    "statistics cut short": "UPDATE quantile SET bounds = x'0011'",
    "statistics upside down": f"UPDATE quantile SET bounds = x'{DESCENDING}'",
    "statistics of fewer than no rows": "UPDATE quantile SET n_rows = -3",
    "costs that are no JSON": "UPDATE cost SET figures = 'x'",
    "costs that are no numbers": 'UPDATE cost SET figures = \'{"row": "much"}\'',
    "rows without their object": "DELETE FROM object WHERE id = 2",
    "rows of no object": "UPDATE {layout} SET id = 77 WHERE id = 2",
    "rows that are gone": "DELETE FROM {layout} WHERE id = 2 AND z_val % 3 = 0",
    "an object without rows": "DELETE FROM {layout} WHERE id = 2",
    "rows of negative keys": "UPDATE {layout} SET z_val = -z_val - 1 WHERE id = 2",
    "rows outside the grid": "UPDATE {layout} SET z_val = z_val + (1 << 40) WHERE id = 2",
    "rows in another place": (
        "UPDATE {layout} SET z_val = z_val + 1 WHERE id = 2"
        " AND z_val = (SELECT max(z_val) FROM {layout} WHERE id = 2)"
    ),
    "a wrong count": "UPDATE object SET voxels = voxels + 1 WHERE id = 2",
    "a log with a gap": "DELETE FROM change WHERE revision = 1",
    "an object of no change": "UPDATE object SET revision = 1 WHERE id = 2",
    "a removal that was none": "UPDATE change SET action = 'remove' WHERE id = 2",
    "a surface of no object": "INSERT INTO surface VALUES ('x', x'00')",
    "a surface without a name": "INSERT INTO surface VALUES (x'00', x'00')",
    "a surface of text": "UPDATE surface SET geometry = 'x'",
    "a surface cut short": "UPDATE surface SET geometry = x'00'",
    "another surface": f"UPDATE surface SET geometry = x'{BALL}'",
    "an object without a surface": "DELETE FROM surface",
    "a view for the surfaces": VIEW.format("surface"),
    "a pair of one": (
        "INSERT INTO pair VALUES (2, 2, 'apart', 0, 0, 0, 0, 0, 0, 0, 0, 'new', 1, '', NULL, NULL)"
    ),
}
OF_BRICKS = {
    "an empty brick": "UPDATE brick SET occupancy = zeroblob(8) WHERE id = 2",
    "other bricks": f"UPDATE brick SET occupancy = x'{'ff' * 8}{'0f' * 64}' WHERE id = 2",
    "a brick cut short": "UPDATE brick SET occupancy = zeroblob(3) WHERE id = 2",
    "a brick of text": "UPDATE brick SET occupancy = 'x' WHERE id = 2",
}


def made(path: Path, layout: Layout) -> Path:
    """An environment of two objects with statistics and costs, closed."""
    with closing(SQLiteStore.create(path, GRID, layout)) as store:
        voxels = floor_voxels(GRID, width=24)
        write_voxels(store, voxels, "a")
        write_voxels(store, voxels + np.array([0, 0, 40]), "b")
        store.analyze(10_000)
        store.analyze(10)
        store.save_costs("elsewhere", {"row": 1.0})
        store.save_costs(machine_name(), CostModel.of_equal_parts().figures())
    return path


def edited(path: Path, statements: str, layout: Layout) -> None:
    """Run statements as an attacker would: without CHECKs."""
    with closing(apsw.Connection(str(path))) as connection:
        connection.execute("PRAGMA ignore_check_constraints = ON")
        connection.execute("PRAGMA legacy_alter_table = ON")
        connection.execute("PRAGMA writable_schema = ON")
        connection.execute("UPDATE sqlite_master SET sql = replace(sql, 'STRICT', '')")
        connection.execute(
            "UPDATE sqlite_master SET sql = replace(sql, ', WITHOUT ROWID', 'WITHOUT ROWID')"
        )
    with closing(apsw.Connection(str(path))) as connection:
        connection.execute("PRAGMA ignore_check_constraints = ON")
        connection.execute("PRAGMA legacy_alter_table = ON")
        for statement in statements.replace("{layout}", layout).split("; "):
            connection.execute(statement)
