"""Tables of an environment in a file: statements, writes, statistics."""
