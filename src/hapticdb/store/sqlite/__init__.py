"""SQLite's engine: one file, its log, its checksums, its copies."""
