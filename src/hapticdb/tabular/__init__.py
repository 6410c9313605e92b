"""Results as records and as tables: keys, columns, units, files."""
