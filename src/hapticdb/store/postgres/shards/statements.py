"""The SQL of a shard: that of one server, with a version for each row and the shard's mark.

Each statement reads tables of one server only. It returns one row of packed arrays: those of
`hapticdb.store.postgres.tables.statements`, then the versions of the rows, then the mark: how many
writes the shard has committed, the latest revision whose dead rows it has swept, and the latest
epoch whose moved rows it has deleted.
"""

from typing import get_args

from hapticdb.store.base import Layout, Table
from hapticdb.store.postgres.tables import statements as plain

TABLES: tuple[Table, ...] = get_args(Table)
MARK = "(SELECT ARRAY[writes, swept, moved] FROM mark)"
SAME_ROW = "brick.z_val = band.z_val AND brick.id = band.id"
PACKED: dict[Table, str] = {
    table: packed.replace(SAME_ROW, f"{SAME_ROW} AND brick.version = band.version")
    + ", array_agg(version)"
    for table, packed in plain.PACKED.items()
}


def _of_shard(texts: dict[Table, str]) -> dict[Table, str]:
    """Statements of one server in the form of a shard."""
    return {
        table: text.replace(plain.PACKED[table], PACKED[table]).replace(plain.SEEN, MARK)
        for table, text in texts.items()
    }


LOOKUP = _of_shard(plain.LOOKUP)
LOOKUP_ONE = _of_shard(plain.LOOKUP_ONE)
SCAN = _of_shard(plain.SCAN)
ROWS_OF = _of_shard(plain.ROWS_OF)
AFTER: dict[Table, str] = {
    table: f"""
SELECT {PACKED[table]}, {MARK}
  FROM (SELECT * FROM {table}
         WHERE (z_val, id, version) > ($1, $2, $3)
         ORDER BY z_val, id, version LIMIT $4) AS {table}"""
    for table in TABLES
}
COUNT: dict[Layout, str] = {
    layout: f"""
SELECT array_agg(id), array_agg(version), array_agg(n), {MARK}
  FROM (SELECT id, version, count(*) AS n
          FROM unnest($1, $2) AS range(low, high) JOIN {layout}
            ON z_val BETWEEN range.low AND range.high
         GROUP BY id, version) AS counted"""
    for layout in ("voxel", "brick")
}
DELETE_VERSION: dict[Table, str] = {
    table: f"""
DELETE FROM {table}
 WHERE ctid = ANY (ARRAY(
         SELECT place
           FROM unnest($1, $2) AS range(low, high),
                LATERAL (SELECT ctid AS place
                           FROM {table}
                          WHERE z_val BETWEEN range.low AND range.high
                            AND id = $3 AND version = $4
                         OFFSET 0) AS found))"""
    for table in TABLES
}
