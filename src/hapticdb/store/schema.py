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

# tables that are the same in all dialects, but for the names of the types
CHANGE = """
CREATE TABLE change (
  revision {count} PRIMARY KEY,
  action   {text} NOT NULL,
  id       {count} NOT NULL,
  ranges   {keys} NOT NULL
)"""
COST = """
CREATE TABLE cost (
  machine {text} PRIMARY KEY,
  figures {json} NOT NULL
)"""
PAIR = """
CREATE TABLE pair (
  a        {count} NOT NULL,
  b        {count} NOT NULL,
  kind     {text} NOT NULL,
  at_least {number} NOT NULL,
  at_most  {number},
  a_x      {number} NOT NULL,
  a_y      {number} NOT NULL,
  a_z      {number} NOT NULL,
  b_x      {number} NOT NULL,
  b_y      {number} NOT NULL,
  b_z      {number} NOT NULL,
  status   {text} NOT NULL,
  revision {count} NOT NULL,
  setting  {text} NOT NULL,
  because  {text},
  shapes   {text},
  PRIMARY KEY (a, b)
)"""


def migrations_after(version: int, dialect: Dialect) -> list[tuple[int, tuple[str, ...]]]:
    """Steps that an environment of that format lacks: the version of each, and its statements."""
    return [(n, dialect[step]) for n, step in enumerate(STEPS[version:], start=version + 1)]
