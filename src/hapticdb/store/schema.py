"""Steps that led to the present format, with the same version numbers for all engines.

The format of an environment is the number of steps that it has gone through. Each engine has the
statements of a step in its own dialect, under the step's name (`store/sqlite/migrations.py`,
`store/postgres/migrations.py`), and stores the number in its own way. An engine without tables has
no step to run. docs/format.md explains the tables.
"""

from collections.abc import Mapping

STEPS = (
    "tables",
    # a mark of each commit, and of the commit before: store/sqlite/log.py
    "lineage",
    "removed parts",
    "distances",
    # changes no table; earlier versions could place rows on several servers
    "shards",
    "surfaces",
    "pairs",
)
"""Steps by name. A reader, who cannot run steps, needs only the first one: without the others
no object has distances or a surface, and no pair is kept."""
FORMAT_VERSION = len(STEPS)
Dialect = Mapping[str, tuple[str, ...]]
"""Statements of each step of `STEPS` by its name; empty where an engine needs none."""


def migrations_after(version: int, dialect: Dialect) -> list[tuple[int, tuple[str, ...]]]:
    """Steps that an environment of that format lacks: the version of each, and its statements."""
    return [(n, dialect[step]) for n, step in enumerate(STEPS[version:], start=version + 1)]
