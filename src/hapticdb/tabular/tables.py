"""Tables of results: columns with units, as CSV, Parquet, .npz or a DataFrame.

Numbers round-trip bit for bit. A name like a spreadsheet's formula gets an apostrophe in front, the
spreadsheets' own mark of text.
"""

import csv
import os
import re
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager, suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TextIO

from hapticdb.errors import FileError, HapticDBError, MissingExtraError, UsageError, pip_line
from hapticdb.tabular.schema import COLUMNS

Columns = Mapping[str, Any]
"""Equally long arrays (N,), or lists of numbers, texts and None, by name."""
FORMULAS = ("=", "+", "-", "@")
"""First characters of a cell with a formula."""
SUFFIXES = (".csv", ".parquet", ".npz")
_UNPRINTABLE = re.compile(
    "[\x00-\x09\x0b-\x1f\x7f-\x9f\u061c\u200e\u200f\u2028-\u202e\u2066-\u2069]"
)
"""Control characters of terminals and of the direction of writing, without the line feed."""


def printable(text: str) -> str:
    r"""Text safe for a terminal; names of parts and files may contain any character.

    Characters for cursor movements, colours or the direction of writing become escapes, such as
    ``\x1b``.
    """
    return _UNPRINTABLE.sub(lambda found: found[0].encode("unicode_escape").decode(), text)


def one_line(text: str) -> str:
    """Printable text with escaped line feeds."""
    return printable(text).replace("\n", "\\n")


def text_cell(text: str) -> str:
    """A name as a cell: printable, and no formula."""
    shown = one_line(text)
    return f"'{shown}" if shown.startswith(FORMULAS) else shown


def columns_of(keys: Iterable[str], records: Iterable[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Columns of records by their keys; None in columns of missing keys."""
    rows = [*records]
    found: dict[str, list[Any]] = {}
    for key in keys:
        names = COLUMNS.get(key, (key,))
        cells = [_numbers(key, one.get(key), len(names)) for one in rows]
        found |= {name: [row[n] for row in cells] for n, name in enumerate(names)}
    return found


def _numbers(key: str, value: Any, count: int) -> Any:  # noqa: ANN401 - of JSON
    if value is None:
        return [None] * count
    if key in {"touched", "obstacles"}:
        return [" ".join(str(o["id"]) for o in value), "; ".join(str(o["name"]) for o in value)]
    return value if count > 1 else [value]


class Tabular(ABC):
    """A result with a table of its entries."""

    @abstractmethod
    def columns(self) -> Columns:
        """Columns by name; docs/results.md has their meanings and units."""

    def to_pandas(self) -> Any:  # noqa: ANN401 - an optional package
        """Table as a `pandas.DataFrame`; MissingExtraError without pandas."""
        try:
            pandas = import_module("pandas")
        except ImportError:
            raise MissingExtraError("to_pandas() needs pandas: pip install pandas") from None
        return pandas.DataFrame(self.columns())

    def write(self, path: str | os.PathLike[str]) -> None:
        """Write the table, whole or not at all, as .csv, .parquet or .npz; replaces a file."""
        with open_table(Path(path), "write", replaces=True) as add:
            add(self.columns())


class CsvWriter:
    """CSV rows below a header, on a stream without translation of line ends."""

    def __init__(self, stream: TextIO, keys: Sequence[str] = ()) -> None:
        self._writer, self._keys = csv.writer(stream, lineterminator="\n"), keys
        self._is_begun = False

    def add(self, *records: Mapping[str, Any]) -> None:
        """Add a row for each record, or the header alone; columns of missing keys stay empty."""
        self.write(columns_of(self._keys, records))

    def write(self, columns: Columns) -> None:
        """Add rows; a float as the shortest text of the same float64, or float32."""
        if not self._is_begun:  # an error before the first row prints no header
            self._writer.writerow(columns)
            self._is_begun = True
        self._writer.writerows(zip(*map(_cells, columns.values()), strict=True))


def _cells(column: Any) -> list[object]:  # noqa: ANN401 - one of `Columns`
    if hasattr(column, "dtype"):
        return [*map(str, column)] if column.dtype == "f4" else column.tolist()
    return [text_cell(one) if isinstance(one, str) else one for one in column]


@contextmanager
def new_file(target: Path, option: str, *, replaces: bool = False) -> Iterator[Path]:
    """Temporary path, renamed to the target at the end. After an error no file remains."""
    if not target.name or (os.path.lexists(target) and not replaces):
        raise UsageError(f"{option} '{target}': give the name of a file that is not there yet")
    part = target.with_name(f".{target.name}.{os.getpid()}.part")
    if part.exists():
        raise UsageError(f"{option} '{target}': another option names this file, too")
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
def open_table(
    target: Path, option: str, *, replaces: bool = False,
    plot: Callable[[Columns], str] | None = None,
) -> Iterator[Callable[[Columns], None]]:  # fmt: skip
    """Open a file of a table by its suffix; yields the function for adding rows, piece by piece.

    plot : draws all rows as SVG, for a name that ends with .svg.
    """
    suffixes = (*SUFFIXES, ".svg") if plot else SUFFIXES
    if target.suffix not in suffixes:
        raise UsageError(f"{option} '{target}': give a name that ends with {', '.join(suffixes)}")
    if target.suffix == ".parquet" and find_spec("pyarrow") is None:
        raise MissingExtraError(
            f"{option} '{target}' needs pyarrow: install it with {pip_line('parquet')}, or give a "
            "name that ends with .npz or .csv"
        )
    with new_file(target, option, replaces=replaces) as part:
        if plot and target.suffix == ".svg":

            def draw(columns: Columns) -> None:
                part.write_text(plot(columns), encoding="utf-8")

            yield draw
        elif target.suffix == ".csv":
            with part.open("w", encoding="utf-8", newline="") as file:
                yield CsvWriter(file).write
        else:
            yield from _row_groups(part) if target.suffix == ".parquet" else _arrays(part)


def _row_groups(path: Path) -> Iterator[Callable[[Columns], None]]:
    """Function for adding rows to a Parquet file: each piece is written at once."""
    import pyarrow as pa  # noqa: PLC0415 - an extra
    from pyarrow import parquet  # noqa: PLC0415

    with ExitStack() as opened:
        writer = None

        def write(columns: Columns) -> None:
            nonlocal writer
            table = pa.table(dict(columns))
            writer = writer or opened.enter_context(parquet.ParquetWriter(path, table.schema))
            writer.write_table(table)

        yield write


def _arrays(path: Path) -> Iterator[Callable[[Columns], None]]:
    """Function for adding rows to a .npz file: pieces stay in memory until the end.

    In a column of numbers None is NaN, in one of texts it is empty.
    """
    import numpy as np  # noqa: PLC0415 - verbs without tables load no numpy

    def array(column: Any) -> Any:  # noqa: ANN401 - one of `Columns`
        if hasattr(column, "dtype"):
            return column
        none = "" if any(isinstance(one, str) for one in column) else np.nan
        return np.array([none if one is None else one for one in column])

    pieces: list[Columns] = []
    yield pieces.append
    whole = {name: np.concatenate([array(one[name]) for one in pieces]) for name in pieces[0]}
    with path.open("wb") as file:
        np.savez(file, **whole)  # type: ignore[arg-type]
