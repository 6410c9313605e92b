"""Results as JSON and CSV from the same records, to standard output or atomically to a file.

A record has the keys of docs/results.md, in SI units; a column of CSV has its key and its unit.
Numbers round-trip bit for bit. A name like a spreadsheet's formula gets an apostrophe in front, the
spreadsheets' own mark of text.
"""

import csv
import os
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TextIO

from hapticdb.cli import render
from hapticdb.cli.schema import COLUMNS
from hapticdb.errors import FileError, HapticDBError, UsageError

STDOUT = "-"
FORMULAS = ("=", "+", "-", "@")
"""First characters of a cell with a formula."""


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

    def add(self, table: "CsvWriter | None", *records: Mapping[str, Any]) -> None:
        """Write records as lines of JSON, and as rows of an open table."""
        if table is not None:
            table.add(*records)
        for one in records if self.json else ():
            render.say_json(one)

    @property
    def has_words(self) -> bool:
        """Whether standard output is for people."""
        return not self.json and self.csv != STDOUT


class CsvWriter:
    """CSV rows below a header, on a stream without translation of line ends."""

    def __init__(self, stream: TextIO, keys: Sequence[str]) -> None:
        self._writer, self._keys = csv.writer(stream, lineterminator="\n"), keys
        self._is_begun = False

    def add(self, *records: Mapping[str, Any]) -> None:
        """Add a row for each record; columns of missing keys stay empty."""
        self.write([cell for key in self._keys for cell in _cells(key, one)] for one in records)

    def write(self, rows: Iterable[Sequence[object]] = ()) -> None:
        """Add rows; a float as the shortest text of the same float64."""
        if not self._is_begun:  # an error before the first row prints no header
            self._writer.writerow([name for key in self._keys for name in COLUMNS.get(key, (key,))])
            self._is_begun = True
        self._writer.writerows(rows)


def _cells(key: str, record: Mapping[str, Any]) -> Sequence[object]:
    value, count = record.get(key), len(COLUMNS.get(key, (key,)))
    if value is None:
        return [""] * count
    if key == "touched":
        names = "; ".join(one["name"] for one in value)
        return [" ".join(str(one["id"]) for one in value), text_cell(names)]
    return value if count > 1 else [text_cell(value) if isinstance(value, str) else value]


@contextmanager
def open_csv(
    target: str | None, keys: Sequence[str], option: str = "--csv"
) -> Iterator[CsvWriter | None]:
    """Open a new CSV file for writing; None without a target. After an error no file remains."""
    with ExitStack() as stack:
        made = None
        if target == STDOUT:
            made = CsvWriter(sys.stdout, keys)
        elif target is not None:
            part = stack.enter_context(new_file(Path(target), option))
            opened = part.open("w", encoding="utf-8", newline="")
            made = CsvWriter(stack.enter_context(opened), keys)
        yield made
        if made is not None:
            made.write()


@contextmanager
def new_file(target: Path, option: str) -> Iterator[Path]:
    """Temporary path, renamed to the target at the end. After an error no file remains."""
    if not target.name or os.path.lexists(target):
        raise UsageError(f"{option} '{target}': give the name of a file that is not there yet")
    part = target.with_name(f".{target.name}.{os.getpid()}.part")
    try:
        part.touch(exist_ok=False)  # before the work: a folder may be missing
        yield part
        part.replace(target)
    except (BrokenPipeError, HapticDBError):  # of standard output, or of no file
        raise
    except OSError as error:
        if error.filename not in {None, str(part)}:
            raise
        raise FileError(f"{option}: cannot write {target}: {error.strerror}") from error
    finally:
        with suppress(OSError):
            part.unlink(missing_ok=True)


@contextmanager
def new_files(**named: str | None) -> Iterator[dict[str, Path]]:
    """Temporary paths of `new_file` for the given files, by option."""
    with ExitStack() as stack:
        yield {
            name: stack.enter_context(new_file(Path(file), f"--{name}"))
            for name, file in named.items()
            if file is not None
        }


def text_cell(text: str) -> str:
    """A name as a cell: printable, and no formula."""
    shown = render.one_line(text)
    return f"'{shown}" if shown.startswith(FORMULAS) else shown
