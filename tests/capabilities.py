"""What each engine lacks of the capabilities that only some engines have.

The contract suites skip the tests of these, and the header of each run lists them.
"""

STORE_LACKS = {
    "SQLite": frozenset({"grouping threshold"}),
    "PostgreSQL": frozenset({"caches"}),
    "PostgreSQL on shards": frozenset({"statement", "caches"}),
    "memory": frozenset({"statement", "caches", "watch", "grouping threshold"}),
}
ENGINE_LACKS = {
    "SQLite": frozenset({"grant"}),
    "PostgreSQL": frozenset({"backup", "first findings"}),
    "PostgreSQL on shards": frozenset({"backup", "first findings"}),
    "memory": frozenset({"grant", "backup", "first findings"}),
}


def header() -> list[str]:
    """A line for each engine."""
    return [
        f"{engine} lacks: {', '.join(sorted(STORE_LACKS[engine] | ENGINE_LACKS[engine]))}"
        for engine in STORE_LACKS
    ]
