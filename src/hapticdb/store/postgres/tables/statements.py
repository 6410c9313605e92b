"""The SQL of the haptic query on PostgreSQL: one statement, which returns one row of packed arrays.

Every statement also returns its revision, so a reader notices an edit without another round trip.
Rows come in the order of the index; `PostgresStore` checks that.
"""

from typing import NamedTuple, get_args

from hapticdb.store.base import BRICK_BYTES, LAYOUTS, Layout, Table

TABLES: tuple[Table, ...] = get_args(Table)
# the LEFT JOIN of `band` and `brick` as a subquery in the list of columns: so the planner can only
# look up each brick by its key, and the rows keep the order of `band`
OCCUPANCY = f"""
       string_agg(coalesce((SELECT occupancy FROM brick
                             WHERE brick.z_val = band.z_val AND brick.id = band.id),
                           decode(repeat('00', {BRICK_BYTES}), 'hex')), '')"""
PACKED: dict[Table, str] = {
    "voxel": "array_agg(z_val), array_agg(id)",
    "brick": "array_agg(z_val), array_agg(id), string_agg(occupancy, '')",
    "band": f"array_agg(z_val), array_agg(id), {OCCUPANCY}, string_agg(distances, ''),"
    " array_agg(octet_length(distances)::bigint)",
}
SEEN = "(SELECT revision FROM environment WHERE environment.id = 1)"


def _by_table(source: str) -> dict[Table, str]:
    """Packed rows of each table, and the revision."""
    return {
        table: f"\nSELECT {PACKED[table]}, {SEEN}\n{source.replace('TABLE', table)}"
        for table in TABLES
    }


# PostgreSQL 17 and later read each leaf page once for all of the sorted keys on it
LOOKUP = _by_table("  FROM TABLE\n WHERE z_val = ANY ($1)")
LOOKUP_ONE = _by_table("  FROM TABLE\n WHERE z_val = $1")
SCAN = _by_table("""  FROM unnest($1, $2) AS range(low, high) JOIN TABLE
    ON z_val BETWEEN range.low AND range.high""")
AFTER = _by_table("""  FROM (SELECT * FROM TABLE
         WHERE z_val >= $1 AND (z_val, id) > ($1, $2)
         ORDER BY z_val, id LIMIT $3) AS TABLE""")
# LATERAL and OFFSET 0 force a scan of each range: the planner expects wide ranges, and would read
# the whole index to find the id
ROWS_OF = _by_table("""  FROM unnest($1, $2) AS range(low, high),
       LATERAL (SELECT *
                  FROM TABLE
                 WHERE z_val BETWEEN range.low AND range.high AND id = $3
                 ORDER BY z_val OFFSET 0) AS TABLE""")
DELETE_ROWS: dict[Table, str] = {
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
    for table in TABLES
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
    "brick": " AND get_bit(occupancy, shell.key & 511) = 1",
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
    """Exclude objects from a statement.

    Its parameters from that number on: least and greatest excluded id, and a bytea with a bit for
    each in between. The server would compare each row with each element of an array of ids.
    """
    test = KEY_TEST[layout]
    low, high, bits = f"${number}", f"${number + 1}", f"${number + 2}"
    is_felt = f"CASE WHEN id BETWEEN {low} AND {high} THEN get_bit({bits}, id - {low}) = 0"
    return sql.replace(test, f"{test} AND {is_felt} ELSE true END")


def without_few(sql: str, layout: Layout, number: int) -> str:
    """Exclude objects whose ids, the parameter of that number, are too far apart for bits."""
    test = KEY_TEST[layout]
    return sql.replace(test, f"{test} AND id <> ALL (${number})")


class Texts(NamedTuple):
    """Statements by table or layout, as the constants above have them."""

    lookup: dict[Table, str]
    lookup_one: dict[Table, str]
    scan: dict[Table, str]
    after: dict[Table, str]
    rows_of: dict[Table, str]
    counts: dict[Layout, str]
    wrench: dict[Layout, str]
    hits: dict[Layout, str]


ONE_SERVER = Texts(LOOKUP, LOOKUP_ONE, SCAN, AFTER, ROWS_OF, COUNT, WRENCH, HITS)


# Rows on partitions (docs/postgresql.md): the same questions, so that a condition on keys reaches
# the partitions. OFFSET 0 makes the planner ask them for each range or key, by its value; a join
# would fetch all of their rows. Rows of no object, which a crash has left, are passed over.
HELD = "EXISTS (SELECT 1 FROM object WHERE object.id = {0}.id)"


def _spread(table: Table, where: str) -> str:
    """Rows of a table with a condition on `z_val`, as a subquery; those of `band` with bricks."""
    if table != "band":
        return f"(SELECT * FROM {table} WHERE {where} AND {HELD.format(table)} OFFSET 0) AS {table}"
    return f"""(
       SELECT z_val, id, occupancy, distances
         FROM (SELECT * FROM band WHERE {where} AND {HELD.format(table)} OFFSET 0) AS near
         LEFT JOIN (SELECT * FROM brick WHERE {where} OFFSET 0) AS held USING (z_val, id)
        ORDER BY z_val, id OFFSET 0) AS band"""


SPREAD_PACKED = PACKED | {
    "band": f"""array_agg(z_val), array_agg(id),
       string_agg(coalesce(occupancy, decode(repeat('00', {BRICK_BYTES}), 'hex')), ''),
       string_agg(distances, ''), array_agg(octet_length(distances)::bigint)"""
}
_RANGES = "unnest($1, $2) AS range(low, high), LATERAL "
_IN_RANGE = "z_val BETWEEN range.low AND range.high"
_NEXT = "SELECT * FROM {0} WHERE z_val >= $1 AND (z_val, id) > ($1, $2) ORDER BY z_val, id LIMIT $3"


def _spread_after(table: Table) -> str:
    if table != "band":
        return f"SELECT {SPREAD_PACKED[table]}, {SEEN} FROM ({_NEXT.format(table)}) AS {table}"
    return f"""
  WITH near AS MATERIALIZED ({_NEXT.format("band")})
SELECT {SPREAD_PACKED["band"]}, {SEEN}
  FROM (SELECT z_val, id, occupancy, distances
          FROM near LEFT JOIN (SELECT * FROM brick
                                WHERE z_val BETWEEN $1 AND (SELECT max(z_val) FROM near)
                               OFFSET 0) AS held USING (z_val, id)
         ORDER BY z_val, id) AS band"""


def _spread_rows(source: str, where: str) -> dict[Table, str]:
    return {
        table: f"SELECT {SPREAD_PACKED[table]}, {SEEN} FROM {source}{_spread(table, where)}"
        for table in TABLES
    }


SPREAD = Texts(
    _spread_rows("", "z_val = ANY ($1)"),
    _spread_rows("", "z_val = $1"),
    _spread_rows(_RANGES, _IN_RANGE),
    {table: _spread_after(table) for table in TABLES},
    _spread_rows(_RANGES, f"{_IN_RANGE} AND id = $3"),
    {layout: f"SELECT count(*) FROM {_RANGES}{_spread(layout, _IN_RANGE)}" for layout in LAYOUTS},
    {
        layout: text.removesuffix(")") + f" AND {HELD.format(layout)} OFFSET 0)"
        for layout, text in WRENCH.items()
    },
    {
        layout: f"""
SELECT array_agg(n), array_agg(id), {SEEN}
  FROM unnest($1) WITH ORDINALITY AS shell(key, n),
       LATERAL (SELECT id FROM {layout}
                 WHERE {KEY_TEST[layout]}{bit} AND {HELD.format(layout)} OFFSET 0) AS found"""
        for layout, bit in BIT_TEST.items()
    },
)
