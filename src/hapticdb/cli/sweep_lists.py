"""Requests for sweeps, and CSV files of many requests."""

import csv
import io
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from hapticdb.errors import FileError, ObjectNotFoundError, UsageError
from hapticdb.units import length_of

COLUMNS = ("part", "tool", "path", "where", "exclude", "contact")
BETWEEN = ";"
"""Separator of words in a cell."""
_HINT = "give a header with part or tool, and path; and if wanted where, exclude, contact"


class ListedSweep(NamedTuple):
    """Request for a sweep; contact : metres; line : of a file of sweeps, or empty."""

    tool: str | None
    part: list[str]
    path: str
    where: list[str]
    exclude: list[str]
    contact: float
    line: str

    @property
    def name(self) -> str:
        """File of the tool, or words of the parts, as given."""
        return self.tool or f"{BETWEEN} ".join(self.part)


@contextmanager
def naming(line: str) -> Iterator[None]:
    """Prefix errors of the block with the line of a file of sweeps."""
    try:
        yield
    except (FileError, ObjectNotFoundError, UsageError) as error:
        if not line:
            raise
        raise UsageError(f"{line}: {error}") from error


def read_sweeps(path: str, given: ListedSweep) -> list[ListedSweep]:
    """Sweeps of a CSV file, at least one; empty or missing cells have the values of `given`."""
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is no text"
        raise FileError(f"--batch: cannot read {path}: {why}") from error
    reader = csv.DictReader(io.StringIO(text, newline=""), skipinitialspace=True, strict=True)
    try:
        unknown = [name for name in reader.fieldnames or () if name not in COLUMNS]
        if unknown or "path" not in (reader.fieldnames or ()):
            which = f"no column {unknown[0][:40]!r} is known; " if unknown else ""
            raise FileError(f"--batch {path}: {which}{_HINT}")
        requests = [_request_of(row, given, f"{path}, line {reader.line_num}") for row in reader]
    except csv.Error as error:
        raise FileError(f"--batch {path}, line {reader.line_num}: {error}; {_HINT}") from error
    if not requests:
        raise FileError(f"--batch {path}: no sweep after its header; {_HINT}")
    return requests


def _request_of(row: dict[str, str | None], given: ListedSweep, line: str) -> ListedSweep:
    """Sweep of a row."""
    if None in row or None in row.values():
        raise FileError(f"--batch {line}: it has more or fewer cells than the header")
    cells = {name: (text or "").strip() for name, text in row.items()}
    tool, part, path = (cells.get(name, "") for name in ("tool", "part", "path"))
    if not path or bool(tool) == bool(part):
        raise FileError(f"--batch {line}: give a path, and one of tool and part")
    return ListedSweep(
        tool or None, _words(part), path, _words(cells.get("where")) or given.where,
        _words(cells.get("exclude")) or given.exclude,
        _contact(cells.get("contact"), given.contact, line), line,
    )  # fmt: skip


def _words(cell: str | None) -> list[str]:
    return [word.strip() for word in (cell or "").split(BETWEEN) if word.strip()]


def _contact(cell: str | None, given: float, line: str) -> float:
    with naming(f"--batch {line}: contact"):
        return length_of(cell, "mm") if cell else given
