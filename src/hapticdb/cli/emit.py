"""Results in words, as JSON and as CSV, from the same records.

A record has the keys of docs/results.md, in SI units.
"""

import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hapticdb.cli import render
from hapticdb.errors import UsageError
from hapticdb.tabular.tables import CsvWriter, new_file

STDOUT = "-"


@dataclass(frozen=True)
class Output:
    """Standard output of a verb's result: words, or JSON in their place."""

    json: bool = False

    def emit(
        self, result: object, words: str | Callable[[], object], status: int | None = None
    ) -> None:
        """Write a result as JSON, or its words: a line or a function; status : as `render.say`."""
        if self.json:
            render.say_json(result)
        elif isinstance(words, str):
            render.say(words, status)
        else:
            words()


@dataclass(frozen=True)
class TableOutput(Output):
    """Output of a result with many rows: also as CSV."""

    csv: str | None = None

    def __post_init__(self) -> None:
        if self.csv == STDOUT and self.json:
            raise UsageError("--csv - and --json: only one may be standard output")

    def add(self, table: CsvWriter | None, *records: Mapping[str, Any]) -> None:
        """Write records as lines of JSON, and as rows of an open table."""
        if table is not None:
            table.add(*records)
        for one in records if self.json else ():
            render.say_json(one)

    @property
    def has_words(self) -> bool:
        """Whether standard output is for people."""
        return not self.json and self.csv != STDOUT


@contextmanager
def open_csv(
    target: str | None, keys: Sequence[str], option: str = "--csv"
) -> Iterator[CsvWriter | None]:
    """Open a new CSV file for writing; None without a target. After an error no file remains."""
    if target is None:
        yield None
        return
    with ExitStack() as stack:
        stream = sys.stdout
        if target != STDOUT:
            part = stack.enter_context(new_file(Path(target), option))
            stream = stack.enter_context(part.open("w", encoding="utf-8", newline=""))
        made = CsvWriter(stream, keys)
        yield made
        made.add()


@contextmanager
def new_files(**named: str | None) -> Iterator[dict[str, Path]]:
    """Temporary paths of `new_file` for the given files, by option."""
    with ExitStack() as stack:
        yield {
            name: stack.enter_context(new_file(Path(file), f"--{name}"))
            for name, file in named.items()
            if file is not None
        }
