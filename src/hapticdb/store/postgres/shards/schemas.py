"""The tables of an environment on several servers: at the coordinator, and on the shards.

The coordinator has all tables of `hapticdb.store.postgres.migrations`; those for rows stay empty
there. Rows of an object count if their version is the one that the table `live` names.
"""

from psycopg import sql

from hapticdb.store.base import Layout, Table
from hapticdb.store.postgres.migrations import AUTOVACUUM
from hapticdb.store.postgres.tables.loading import TABLES

COORDINATOR = (
    """
CREATE TABLE distribution (
  id    integer PRIMARY KEY CHECK (id = 1),
  token uuid NOT NULL,
  epoch bigint NOT NULL,
  rebalance bigint NOT NULL DEFAULT 0
)""",
    """
CREATE TABLE shard (
  number    integer PRIMARY KEY CHECK (number >= 1),
  host      text NOT NULL,
  first_key bigint NOT NULL,
  writes    bigint NOT NULL
)""",
    """
CREATE TABLE live (
  id       bigint PRIMARY KEY,
  version  bigint,
  ranges   bigint[] NOT NULL,
  revision bigint NOT NULL
)""",
    "CREATE INDEX live_revision ON live (revision)",
)
SHARD = (
    """
CREATE TABLE mark (
  id     integer PRIMARY KEY CHECK (id = 1),
  token  uuid NOT NULL,
  writes bigint NOT NULL,
  swept  bigint NOT NULL,
  moved  bigint NOT NULL,
  rebalance bigint NOT NULL DEFAULT 0
)""",
    """
CREATE TABLE written (
  id      bigint NOT NULL,
  version bigint NOT NULL,
  ranges  bigint[] NOT NULL,
  PRIMARY KEY (id, version)
)""",
)
ROWS: dict[Layout, tuple[str, ...]] = {
    "voxel": (
        f"""
CREATE TABLE voxel (
  z_val   bigint NOT NULL,
  id      bigint NOT NULL,
  version bigint NOT NULL
) WITH ({AUTOVACUUM})""",
        (
            "ALTER TABLE voxel ALTER z_val SET STATISTICS 10000, ALTER id SET STATISTICS 0,"
            " ALTER version SET STATISTICS 0"
        ),
    ),
    "brick": (
        f"""
CREATE TABLE brick (
  z_val     bigint NOT NULL,
  id        bigint NOT NULL,
  version   bigint NOT NULL,
  occupancy bytea NOT NULL CHECK (octet_length(occupancy) = 64)
) WITH ({AUTOVACUUM})""",
        "ALTER TABLE brick ALTER occupancy SET STORAGE PLAIN",
        (
            "ALTER TABLE brick ALTER z_val SET STATISTICS 10000, ALTER id SET STATISTICS 0,"
            " ALTER version SET STATISTICS 0, ALTER occupancy SET STATISTICS 0"
        ),
        f"""
CREATE TABLE band (
  z_val     bigint NOT NULL,
  id        bigint NOT NULL,
  version   bigint NOT NULL,
  distances bytea NOT NULL
) WITH ({AUTOVACUUM})""",
        "ALTER TABLE band ALTER distances SET STORAGE EXTERNAL",
        (
            "ALTER TABLE band ALTER id SET STATISTICS 0, ALTER version SET STATISTICS 0,"
            " ALTER distances SET STATISTICS 0"
        ),
    ),
}
# as on one server: an editor may renew statistics, and nobody else but the owner
REFRESH: dict[Layout, str] = {
    layout: f"""
CREATE FUNCTION refresh_statistics() RETURNS void
LANGUAGE sql SECURITY DEFINER SET search_path = {{schema}}, pg_temp AS $$ ANALYZE {layout} $$"""
    for layout in ("voxel", "brick")
}
KEY = "z_val, id, version"
"""Columns of the index of each table of rows on a shard."""
COLUMNS: dict[Table, str] = {
    "voxel": "z_val, id, version",
    "brick": "z_val, id, version, occupancy",
    "band": "z_val, id, version, distances",
}


def shard_statements(schema: sql.Identifier, layout: Layout) -> list[sql.Composed]:
    """Statements that make a shard's tables in its schema."""
    texts = (
        *SHARD,
        *ROWS[layout],
        *(f"CREATE UNIQUE INDEX {t}_key ON {t} ({KEY})" for t in TABLES[layout]),
    )
    made = [sql.SQL(text).format() for text in texts]
    return [*made, sql.SQL(REFRESH[layout]).format(schema=schema)]
