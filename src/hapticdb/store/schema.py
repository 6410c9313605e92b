"""The tables of an environment and how older ones become newer ones: docs/format.md explains them.

A migration has a name and the statements that lead from the version before it, run in one
transaction. `FORMAT_VERSION` is their number; what an engine stores it in is the engine's own.
"""

from typing import NamedTuple

SQLITE_APPLICATION_ID = 0x48415054  # "HAPT"


class Migration(NamedTuple):
    """One step of the format: a name and its statements for SQLite."""

    name: str
    sqlite: tuple[str, ...]


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

CHANGE = """
CREATE TABLE change (
  revision INTEGER PRIMARY KEY,
  action   TEXT NOT NULL,
  id       INTEGER NOT NULL,
  ranges   BLOB NOT NULL
) STRICT"""

QUANTILE = """
CREATE TABLE quantile (
  resolution INTEGER PRIMARY KEY,
  revision   INTEGER NOT NULL,
  n_rows     INTEGER NOT NULL,
  bounds     BLOB NOT NULL
) STRICT"""

COST = """
CREATE TABLE cost (
  machine TEXT PRIMARY KEY,
  figures TEXT NOT NULL
) STRICT"""

MIGRATIONS = (Migration("tables", (ENVIRONMENT, OBJECT, VOXEL, BRICK, CHANGE, QUANTILE, COST)),)
FORMAT_VERSION = len(MIGRATIONS)
