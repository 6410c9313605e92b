"""The tables of an environment in SQLite, and how older ones become newer ones.

Each step runs in one transaction with the number that it leads to (`hapticdb.store.schema`).
"""

from hapticdb.store.schema import CHANGE, COST, PAIR, Dialect

APPLICATION_ID = 0x48415054  # "HAPT"
"""Number in the header of each hapticdb file. Another program's database does not have it."""
VERSION_UNIT = 1000
"""The version of a file's tables is its `user_version` modulo this. The thousands tell of the
checksums of pages that earlier programs wrote: 1, all pages have theirs; 2, some are written
without, so that those programs refuse the file as newer."""

ENVIRONMENT = """
CREATE TABLE environment (
  id         INTEGER PRIMARY KEY CHECK (id = 1),
  voxel_size REAL NOT NULL,
  origin_x   REAL NOT NULL,
  origin_y   REAL NOT NULL,
  origin_z   REAL NOT NULL,
  bits       INTEGER NOT NULL,
  curve      TEXT NOT NULL,
  layout     TEXT NOT NULL
) STRICT"""

# AUTOINCREMENT: the id of a removed object is never given to another
OBJECT = """
CREATE TABLE object (
  id         INTEGER PRIMARY KEY AUTOINCREMENT,
  name       TEXT NOT NULL,
  link       TEXT NOT NULL,
  digest     TEXT NOT NULL,
  transform  BLOB NOT NULL CHECK (length(transform) = 128),
  voxels     INTEGER NOT NULL,
  bounds     BLOB NOT NULL CHECK (length(bounds) = 48),
  attributes TEXT NOT NULL,
  revision   INTEGER NOT NULL,
  UNIQUE (link, name)
) STRICT"""

VOXEL = """
CREATE TABLE voxel (
  z_val INTEGER NOT NULL,
  id    INTEGER NOT NULL,
  PRIMARY KEY (z_val, id)
) STRICT, WITHOUT ROWID"""

BRICK = """
CREATE TABLE brick (
  z_val     INTEGER NOT NULL,
  id        INTEGER NOT NULL,
  occupancy BLOB NOT NULL CHECK (length(occupancy) = 64),
  PRIMARY KEY (z_val, id)
) STRICT, WITHOUT ROWID"""

QUANTILE = """
CREATE TABLE quantile (
  resolution INTEGER PRIMARY KEY,
  revision   INTEGER NOT NULL,
  n_rows     INTEGER NOT NULL,
  bounds     BLOB NOT NULL
) STRICT"""

LINEAGE = (
    "ALTER TABLE environment ADD COLUMN lineage BLOB CHECK (length(lineage) = 32)",
    "UPDATE environment SET lineage = CAST(randomblob(16) || zeroblob(16) AS BLOB)",
)

# names of removed parts, for the next import of their file; triggers keep them, for any program
REMOVED = (
    """
CREATE TABLE removed (
  link TEXT NOT NULL,
  name TEXT NOT NULL,
  PRIMARY KEY (link, name)
) STRICT, WITHOUT ROWID""",
    """
CREATE TRIGGER part_removed AFTER DELETE ON object BEGIN
  INSERT OR IGNORE INTO removed VALUES (old.link, old.name);
END""",
    """
CREATE TRIGGER part_added AFTER INSERT ON object BEGIN
  DELETE FROM removed WHERE link = new.link AND name = new.name;
END""",
)

DISTANCES = (
    """
CREATE TABLE band (
  z_val     INTEGER NOT NULL,
  id        INTEGER NOT NULL,
  distances BLOB NOT NULL,
  PRIMARY KEY (z_val, id)
) STRICT, WITHOUT ROWID""",
    """
ALTER TABLE environment
  ADD COLUMN wants_distances INTEGER NOT NULL DEFAULT 0 CHECK (wants_distances IN (0, 1))""",
)

SURFACES = (
    """
CREATE TABLE surface (
  digest   TEXT PRIMARY KEY,
  geometry BLOB NOT NULL
) STRICT""",
    "CREATE INDEX object_digest ON object (digest)",
)

TYPES = {"count": "INTEGER", "number": "REAL", "text": "TEXT", "json": "TEXT", "keys": "BLOB"}
SHARED = tuple(f"{table.format(**TYPES)} STRICT" for table in (CHANGE, COST))

MIGRATIONS: Dialect = {
    "tables": (ENVIRONMENT, OBJECT, VOXEL, BRICK, QUANTILE, *SHARED),
    "lineage": LINEAGE,
    "removed parts": REMOVED,
    "distances": DISTANCES,
    "shards": (),
    "surfaces": SURFACES,
    "pairs": (f"{PAIR.format(**TYPES)} STRICT, WITHOUT ROWID",),
}
