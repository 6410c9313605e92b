"""What each engine lacks of the capabilities that only some engines have.

The contract suites skip the tests of these, and the header of each run lists them.
"""

STORE_LACKS: dict[str, frozenset[str]] = {
    "SQLite": frozenset(),
    "PostgreSQL": frozenset({"caches"}),
    "memory": frozenset({"statement", "caches", "watch"}),
}
ENGINE_LACKS = {
    "SQLite": frozenset({"grant"}),
    "PostgreSQL": frozenset({"backup"}),
    "memory": frozenset({"grant", "backup"}),
}


def header() -> list[str]:
    """A line for each engine."""
    return [
        f"{engine} lacks: {', '.join(sorted(STORE_LACKS[engine] | ENGINE_LACKS[engine]))}"
        for engine in STORE_LACKS
    ]
