"""SQL of the haptic query on PostgreSQL: one statement, with one result row of packed arrays.

Every statement also returns its revision, so a reader notices an edit without another round trip.
Rows are in index order; `PostgresStore` verifies the order.
"""

from typing import NamedTuple

from hapticdb.store.base import LAYOUTS, Columns, Layout
from hapticdb.store.parsing import NO_VOXEL
from hapticdb.store.tables import HELD, TABLES

PACKED: dict[Columns, str] = {
    "voxel": "array_agg(z_val), array_agg(id)",
    "brick": "array_agg(z_val), array_agg(id), string_agg(occupancy, '')",
    "distances": f"""array_agg(z_val), array_agg(id),
       string_agg(coalesce(occupancy, '\\x{NO_VOXEL.hex()}'), ''), string_agg(distances, ''),
       array_agg(coalesce(octet_length(distances), 0)::bigint)""",
}
SEEN = "(SELECT revision FROM environment WHERE environment.id = 1)"


def _packed(source: str) -> dict[Columns, str]:
    """Statement of packed rows and the revision, for each choice of columns."""
    return {
        columns: f"\nSELECT {PACKED[columns]}, {SEEN}\n"
        + source.replace("TABLE", table).replace("HELD", HELD[columns])
        for columns, table in TABLES.items()
    }


# PostgreSQL 17 and later read each leaf page once for all of its sorted keys
LOOKUP = _packed("  FROM TABLE\n WHERE z_val = ANY ($1) AND HELD")
LOOKUP_ONE = _packed("  FROM TABLE\n WHERE z_val = $1 AND HELD")
SCAN = _packed("""  FROM unnest($1, $2) AS range(low, high) JOIN TABLE
    ON z_val BETWEEN range.low AND range.high AND HELD""")
AFTER = _packed("""  FROM (SELECT * FROM TABLE
         WHERE z_val >= $1 AND (z_val, id) > ($1, $2)
         ORDER BY z_val, id LIMIT $3) AS TABLE""")
# LATERAL and OFFSET 0 force a scan of each range: the planner expects wide ranges, and would read
# the whole index to find the id
ROWS_OF = _packed("""  FROM unnest($1, $2) AS range(low, high),
       LATERAL (SELECT *
                  FROM TABLE
                 WHERE z_val BETWEEN range.low AND range.high AND id = $3 AND HELD
                 ORDER BY z_val OFFSET 0) AS TABLE""")
DELETE_ROWS: dict[Layout, str] = {
    table: f"""
WITH gone AS (
  DELETE FROM {table}
   WHERE id = $3 AND ctid = ANY (ARRAY(
           SELECT place
             FROM unnest($1, $2) AS range(low, high),
                  LATERAL (SELECT ctid AS place
                             FROM {table}
                            WHERE z_val BETWEEN range.low AND range.high AND id = $3
                           OFFSET 0) AS found))
  RETURNING z_val)
SELECT array_agg(z_val) FROM gone"""
    for table in LAYOUTS
}
COUNT: dict[Layout, str] = {
    layout: f"""
SELECT count(*)
  FROM unnest($1, $2) AS range(low, high) JOIN {layout}
    ON z_val BETWEEN range.low AND range.high"""
    for layout in LAYOUTS
}

# The conditions of the paper's Figure 3 on a row: its key, and on bricks the voxel's bit
KEY_TEST: dict[Layout, str] = {"voxel": "z_val = shell.key", "brick": "z_val = shell.key >> 9"}
BIT_TEST: dict[Layout, str] = {
    "voxel": "",
    "brick": " AND has_voxel(occupancy, shell.key & 511)",
}
# Only hits fetch their point, by its ordinal: unnesting all seven arrays of the shell takes half as
# long again.
WRENCH: dict[Layout, str] = {
    layout: f"""
SELECT force(ROW(($2)[n], ($3)[n], ($4)[n], ($5)[n], ($6)[n], ($7)[n],
                 $8, $9, $10, $11, shell.key)::hit ORDER BY n)
  FROM unnest($1) WITH ORDINALITY AS shell(key, n)
 WHERE EXISTS (SELECT 1 FROM {layout}
                WHERE {KEY_TEST[layout]}{BIT_TEST[layout]})"""
    for layout in LAYOUTS
}
HITS: dict[Layout, str] = {
    layout: f"""
SELECT array_agg(n), array_agg(id), {SEEN}
  FROM unnest($1) WITH ORDINALITY AS shell(key, n) JOIN {layout}
    ON {KEY_TEST[layout]}{BIT_TEST[layout]}"""
    for layout in LAYOUTS
}


def without_excluded(sql: str, layout: Layout, number: int) -> str:
    """Statement without excluded objects.

    Its parameters from `number` on: least and greatest excluded id, and a bytea bitmap of the ids
    between them. An array of ids would be compared element by element with each row.
    """
    test = KEY_TEST[layout]
    low, high, bits = f"${number}", f"${number + 1}", f"${number + 2}"
    is_included = f"CASE WHEN id BETWEEN {low} AND {high} THEN get_bit({bits}, id - {low}) = 0"
    return sql.replace(test, f"{test} AND {is_included} ELSE true END")


def without_few(sql: str, layout: Layout, number: int) -> str:
    """Statement without objects of sparse ids, an array as the parameter of this number."""
    test = KEY_TEST[layout]
    return sql.replace(test, f"{test} AND id <> ALL (${number})")


class Texts(NamedTuple):
    """Statements by columns or layout, from the constants above."""

    lookup: dict[Columns, str]
    lookup_one: dict[Columns, str]
    scan: dict[Columns, str]
    after: dict[Columns, str]
    rows_of: dict[Columns, str]
    counts: dict[Layout, str]
    wrench: dict[Layout, str]
    hits: dict[Layout, str]


ONE_SERVER = Texts(LOOKUP, LOOKUP_ONE, SCAN, AFTER, ROWS_OF, COUNT, WRENCH, HITS)


# Rows on partitions (docs/postgresql.md): the same queries, in a form whose condition on keys
# reaches the partitions. OFFSET 0 forces a remote scan for each range or key, by its value; a join
# would fetch all of their rows. Orphan rows of a crash are skipped.
KNOWN = "EXISTS (SELECT 1 FROM object WHERE object.id = {0}.id)"


def _known(table: str, where: str) -> str:
    """Subquery of a table's rows with a condition on `z_val`, without orphan rows."""
    return f"(SELECT * FROM {table} WHERE {where} AND {KNOWN.format(table)} OFFSET 0) AS {table}"


def _partitioned(source: str, where: str) -> dict[Columns, str]:
    return _packed(f"  FROM {source}" + _known("TABLE", f"{where} AND HELD"))


_RANGES = "unnest($1, $2) AS range(low, high), LATERAL "
_IN_RANGE = "z_val BETWEEN range.low AND range.high"
PARTITIONED = Texts(
    _partitioned("", "z_val = ANY ($1)"),
    _partitioned("", "z_val = $1"),
    _partitioned(_RANGES, _IN_RANGE),
    AFTER,
    _partitioned(_RANGES, f"{_IN_RANGE} AND id = $3"),
    {layout: f"SELECT count(*) FROM {_RANGES}{_known(layout, _IN_RANGE)}" for layout in LAYOUTS},
    {
        layout: text.removesuffix(")") + f" AND {KNOWN.format(layout)} OFFSET 0)"
        for layout, text in WRENCH.items()
    },
    {
        layout: f"""
SELECT array_agg(n), array_agg(id), {SEEN}
  FROM unnest($1) WITH ORDINALITY AS shell(key, n),
       LATERAL (SELECT id FROM {layout}
                 WHERE {KEY_TEST[layout]}{bit} AND {KNOWN.format(layout)} OFFSET 0) AS found"""
        for layout, bit in BIT_TEST.items()
    },
)
