"""SQLite as an engine: one file with its write-ahead log, checksums, copies."""
