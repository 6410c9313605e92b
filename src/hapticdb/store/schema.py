"""Steps that led to the present format, with the same version numbers for all engines.

The format of an environment is the number of steps that it has gone through. Each engine has the
statements of a step in its own dialect, under the step's name (`store/sqlite/migrations.py`,
`store/postgres/migrations.py`), and stores the number in its own way. An engine without tables has
no step to run. docs/format.md explains the tables.
"""

from collections.abc import Mapping
from typing import NamedTuple


class Step(NamedTuple):
    """One step of the format, by name.

    readers_need_it : whether a reader, who cannot run the step, refuses an environment without it.
    """

    name: str
    readers_need_it: bool = True


STEPS = (
    Step("tables"),
    # a mark of each commit, and of the commit before: store/sqlite/log.py
    Step("lineage", readers_need_it=False),
    Step("removed parts", readers_need_it=False),
    # without it no object has distances
    Step("distances", readers_need_it=False),
    # changes no table; earlier versions could place rows on several servers
    Step("shards", readers_need_it=False),
    # without it no object has a surface
    Step("surfaces", readers_need_it=False),
    # without it no pair is kept
    Step("pairs", readers_need_it=False),
)
FORMAT_VERSION = len(STEPS)
Dialect = Mapping[str, tuple[str, ...]]
"""Statements of each step of `STEPS` by its name; empty where an engine needs none."""


class _Migration(NamedTuple):
    """A step in the words of one engine: the version that it leads to, and its statements."""

    version: int
    statements: tuple[str, ...]
    readers_need_it: bool


def migrations_after(version: int, dialect: Dialect) -> list[_Migration]:
    """Steps that an environment of that format lacks, in their order."""
    return [
        _Migration(number, dialect[step.name], step.readers_need_it)
        for number, step in enumerate(STEPS[version:], start=version + 1)
    ]
