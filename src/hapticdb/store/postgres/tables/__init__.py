"""Tables of an environment on a server: statements, writes, bulk loading, statistics."""
