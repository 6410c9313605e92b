-- The tables of an environment in an SQLite file. Format 1.
--
-- A file is made by running this text as it stands, then filling the row of `environment`; the
-- file is in WAL mode, with pages of 8,192 bytes. The tables of PostgreSQL
-- (store/postgres/schema.sql) have the same names and columns.
-- All tables are there in each file; the layout says which of `voxel` and `brick` has rows.
--
-- BLOBs of numbers are little-endian float64 or int64. What the BLOBs `occupancy`, `distances`
-- and `geometry` hold, and what a key is: docs/format.md.

PRAGMA application_id = 0x68617074;  -- "hapt", bytes 68 to 71 of the file
PRAGMA user_version = 1;             -- the format, bytes 60 to 63

-- ## environment: one row

CREATE TABLE environment (
  id              INTEGER PRIMARY KEY CHECK (id = 1),
  voxel_size      REAL NOT NULL,     -- edge s of a voxel, m; the grid never changes
  origin_x        REAL NOT NULL,     -- lower corner of voxel (0, 0, 0), m, world frame;
  origin_y        REAL NOT NULL,     -- voxel (i, j, k) covers [i s, (i + 1) s) on each axis
  origin_z        REAL NOT NULL,
  bits            INTEGER NOT NULL,  -- for each axis, 1 to 21: 2^bits voxels
  curve           TEXT NOT NULL,     -- order of the keys: z, hilbert or lexicographic
  layout          TEXT NOT NULL,     -- voxel or brick: the table of rows
  wants_distances INTEGER NOT NULL CHECK (wants_distances IN (0, 1))  -- whether parts get some
) STRICT;

-- ## object: a part at its place

CREATE TABLE object (
  id         INTEGER PRIMARY KEY AUTOINCREMENT,  -- never given to another object
  name       TEXT NOT NULL,     -- path of the part inside its file
  link       TEXT NOT NULL,     -- absolute path of that file
  digest     TEXT NOT NULL,     -- of its geometry: the key in `surface`
  transform  BLOB NOT NULL CHECK (length(transform) = 128),  -- world_from_part, by rows, m
  voxels     INTEGER NOT NULL,  -- number of voxels that its surface touches
  bounds     BLOB NOT NULL CHECK (length(bounds) = 48),  -- lower, upper corner, m, world frame
  attributes TEXT NOT NULL,     -- JSON: `unit` and `up` of its file, checksums of its rows
  revision   INTEGER NOT NULL,  -- the `change` that wrote it last
  UNIQUE (link, name)
) STRICT;

CREATE INDEX object_digest ON object (digest);

-- ## voxel: the paper's index table, for the layout `voxel`

CREATE TABLE voxel (
  z_val INTEGER NOT NULL,  -- key of a voxel
  id    INTEGER NOT NULL,  -- of an object that touches it
  PRIMARY KEY (z_val, id)
) STRICT, WITHOUT ROWID;

-- ## brick: 8 x 8 x 8 voxels a row, for the layout `brick`
-- A row for each brick that an object touches; if the object has distances, for each within 2.75
-- voxels of its surface.

CREATE TABLE brick (
  z_val     INTEGER NOT NULL,  -- key of the brick: a voxel's without the last 9 bits
  id        INTEGER NOT NULL,  -- of the object
  occupancy BLOB CHECK (length(occupancy) BETWEEN 9 AND 72),  -- voxels touched; NULL: none
  distances BLOB,  -- of 10 x 10 x 10 voxel centres to the surface, packed, up to 2,048 bytes
  PRIMARY KEY (z_val, id)
) STRICT, WITHOUT ROWID;

-- ## surface: a row for each shape, however many objects place it
-- Written with the first object of the digest, removed with the last.

CREATE TABLE surface (
  digest   TEXT PRIMARY KEY,  -- SHA-256 of the geometry in the part's frame, 64 hex digits
  geometry BLOB NOT NULL      -- triangles or points, colours, chord error, packed
) STRICT;

-- ## change: a row for each committed write of an object

CREATE TABLE change (
  revision INTEGER PRIMARY KEY,  -- 1, 2, ...; the highest is the environment's
  action   TEXT NOT NULL,        -- add, move or remove
  id       INTEGER NOT NULL,     -- of the object
  ranges   BLOB NOT NULL         -- voxel keys written or removed: pairs of int64, low and high
) STRICT;

-- ## removed: parts that were removed and not imported again
-- Triggers keep it, so that it is right whichever program writes.

CREATE TABLE removed (
  link TEXT NOT NULL,
  name TEXT NOT NULL,
  PRIMARY KEY (link, name)
) STRICT, WITHOUT ROWID;

CREATE TRIGGER part_removed AFTER DELETE ON object BEGIN
  INSERT OR IGNORE INTO removed VALUES (old.link, old.name);
END;

CREATE TRIGGER part_added AFTER INSERT ON object BEGIN
  DELETE FROM removed WHERE link = new.link AND name = new.name;
END;

-- ## pair: what the last searches for clashes found (docs/clashes.md)
-- A row for each pair of near bounds, stale once either object has a later revision. The row
-- (0, 1) is no pair: after a search of everything it has that search's setting and revision, and
-- in at_least the number of the other rows.

CREATE TABLE pair (
  a        INTEGER NOT NULL,  -- ids of the objects, the lesser one first
  b        INTEGER NOT NULL,
  kind     TEXT NOT NULL,     -- overlapping, inside, touching, apart, not known or far
  at_least REAL NOT NULL,     -- bounds of the gap, or of the overlap's depth, m
  at_most  REAL,              -- NULL: no bound is known
  a_x      REAL NOT NULL,     -- nearest or deepest places on a and on b, m, world frame
  a_y      REAL NOT NULL,
  a_z      REAL NOT NULL,
  b_x      REAL NOT NULL,
  b_y      REAL NOT NULL,
  b_z      REAL NOT NULL,
  status   TEXT NOT NULL,     -- new, gone, changed or same since the search before
  revision INTEGER NOT NULL,  -- of the environment that was searched
  setting  TEXT NOT NULL,     -- lengths of the search: within 0.001 contact 5e-05 by motions, holes
  because  TEXT,              -- why the pair is accepted; NULL if it is not
  shapes   TEXT,              -- both digests when it was accepted, a blank between
  PRIMARY KEY (a, b)
) STRICT, WITHOUT ROWID;

-- ## rule: what is decided about pairs by the words of their objects (docs/clashes.md)

CREATE TABLE rule (
  number  INTEGER PRIMARY KEY,  -- 1, 2, ...: the first rule that reaches a pair decides
  one     TEXT NOT NULL,        -- words of `hapticdb objects` for one object of the pair
  other   TEXT NOT NULL,        -- and for the other one
  says    TEXT NOT NULL,        -- meant, apart or ignore
  kinds   TEXT NOT NULL,        -- kinds that are meant, a comma between; else empty
  length  REAL,                 -- greatest depth that is meant, or the clearance, m; NULL: none
  because TEXT NOT NULL         -- why; may be empty
) STRICT;

-- ## quantile: equi-count histograms of the keys in `voxel` or `brick`
-- SQLite's own statistics (sqlite_stat4) hold only 24 samples of an index.

CREATE TABLE quantile (
  resolution INTEGER PRIMARY KEY,  -- number R of buckets
  revision   INTEGER NOT NULL,     -- of the environment that was counted
  n_rows     INTEGER NOT NULL,     -- N
  bounds     BLOB NOT NULL         -- R + 1 keys: the lowest, then those of the ranks ceil(i N / R)
) STRICT;

-- ## cost: figures of `hapticdb info --calibrate`

CREATE TABLE cost (
  machine TEXT PRIMARY KEY,  -- name of the machine on which they were measured
  figures TEXT NOT NULL      -- JSON
) STRICT;
