"""Text for people: tables, facts and notes; progress bars on a terminal only."""

import codecs
import json
import os
import re
import shlex
import shutil
import sys
import textwrap
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING
from unicodedata import category, east_asian_width

from hapticdb.tabular.schema import plain
from hapticdb.tabular.tables import one_line, printable
from hapticdb.units import place_text

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hapticdb.ingest.files import ImportCallback

COLOURS = {0: 32, 1: 31}
"""Green and red of a terminal, by a verdict's exit code; others are yellow, 33."""
ASCII = {"─": "-", "…": "...", "µ": "u", "±": "+-", "³": "3"}
"""Replacements of our own characters, for encodings without them."""
NARROW = 12
"""Least width of a shortened text, columns."""
MOST_ROWS = 20
"""Rows of a long table; further ones are counted below it."""
GAP = 3
"""Blanks between two columns of a table; 1 of a shortened one."""


def note(text: str) -> None:
    """Print one line on standard error."""
    print(f"hapticdb: {printable(' '.join(text.splitlines()))}", file=sys.stderr)


@contextmanager
def noting_warnings() -> Iterator[None]:
    """Print warnings of the library as notes, a line each."""
    with warnings.catch_warnings():
        warnings.showwarning = lambda message, *_, **__: note(str(message))
        yield


def program() -> str:
    """Command of this program for a shell: its name if the PATH leads here, else its path."""
    run = sys.argv[0]
    return "hapticdb" if shutil.which("hapticdb") == str(Path(run).absolute()) else shlex.quote(run)


def say(text: str = "", status: int | None = None) -> None:
    """Print a line of a result; the first clause of a verdict in the colour of its exit code."""
    shown, plain_one = one_line(text), os.environ.get("NO_COLOR") or not sys.stdout.isatty()
    if status is not None and not plain_one:
        clause = re.split("[:;,]", shown, maxsplit=1)[0]
        colour = COLOURS.get(status, 33)
        shown = f"\x1b[{colour}m{clause}\x1b[0m{shown.removeprefix(clause)}"
    print(shown)


def as_ascii(error: UnicodeError) -> tuple[str, int]:
    """Handler of encoding errors: replacement of `ASCII`, or an escape."""
    assert isinstance(error, UnicodeEncodeError)  # noqa: S101 - of a stream that is written
    lacking = error.object[error.start : error.end]
    escaped = (ASCII.get(one) or one.encode("unicode_escape").decode() for one in lacking)
    return "".join(escaped), error.end


codecs.register_error("as_ascii", as_ascii)


def say_json(result: object) -> None:
    """Print a result as one JSON object on a line; numbers round-trip and are finite."""
    print(json.dumps(plain(result), allow_nan=False))


def table(
    headings: Sequence[str], rows: Iterable[Sequence[object]], of: int = 0, nouns: str = "rows"
) -> None:
    """Print rows under headings, or each row as facts on a terminal too narrow for columns.

    ``>`` at a heading's end marks a column of numbers, ``?`` one omitted first. of : number of all
    rows, if only `MOST_ROWS` are shown. Without rows nothing is printed.
    """
    shown = [[*map(str, row)] for row in islice(rows, MOST_ROWS if of else None)]
    if shown:
        _print_table(headings, shown)
    if of > MOST_ROWS:
        say(f"{MOST_ROWS} of {of:,} {nouns}")


def _print_table(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    columns = [*zip(headings, *rows, strict=True)]
    while True:
        numbers = [one[0].rstrip("?").endswith(">") for one in columns]
        whole = [*zip(*((one[0].rstrip(">?"), *one[1:]) for one in columns), strict=True)]
        lines = _laid(whole, numbers)
        width = max(map(_width_of, lines)) + 2
        omitted = [one for one in columns if one[0].endswith("?")]
        if width <= _room() or not omitted:
            break
        columns.remove(omitted[-1])
    if width > _room():
        for row in whole[1:]:
            facts(pair for pair in zip(whole[0], row, strict=True) if pair[1])
            print()
        return
    print("\n".join([f" {lines[0]}", "─" * width, *(f" {line}" for line in lines[1:])]))


def facts(rows: Iterable[tuple[str, str]]) -> None:
    """Print names and values, a pair a line; on a terminal long values are wrapped."""
    pairs = [(_cut(one_line(name), _room() // 2), one_line(value)) for name, value in rows]
    indent = max(_width_of(name) for name, _ in pairs) + 2
    room = max(_room() - indent, NARROW)
    for name, value in pairs:
        lines = textwrap.wrap(value, room) if len(value) > room else [value]
        blanks = " " * (indent - _width_of(name))
        print(name + blanks + f"\n{'':<{indent}}".join(lines))


def _room() -> int:
    """Width of the terminal, columns; unlimited without a terminal."""
    return shutil.get_terminal_size().columns if sys.stdout.isatty() else sys.maxsize


def _cut(text: str, width: int) -> str:
    """Text of at most a width, columns, with an ellipsis for its middle if it is longer."""
    if _width_of(text) <= width:
        return text
    head = (width - 1) // 3
    return f"{text[:head]}…{text[head + 1 - width :]}"


def _laid(rows: Sequence[Sequence[str]], numbers: Sequence[bool]) -> list[str]:
    """Lines of rows with aligned columns, the widest texts shortened to fit a terminal.

    A general table library took 9.8 of 11 s for the columns of 4,000 objects, under a profiler.
    """
    cells = [[*map(one_line, row)] for row in rows]
    widths = [max(map(_width_of, column)) for column in zip(*cells, strict=True)]
    texts = [n for n, is_number in enumerate(numbers) if not is_number and widths[n] > NARROW]
    gap = GAP if sum(widths) + GAP * (len(widths) - 1) + 2 <= _room() else 1
    room = _room() - 2 - gap * (len(widths) - 1)
    while sum(widths) > room and texts and max(widths[n] for n in texts) > NARROW:
        widths[max(texts, key=widths.__getitem__)] -= 1
    lines = []
    for full in cells:
        row = [_cut(text, width) for text, width in zip(full, widths, strict=True)]
        blanks = [" " * (width - _width_of(text)) for text, width in zip(row, widths, strict=True)]
        padded = (
            blank + text if is_number else text + blank
            for text, blank, is_number in zip(row, blanks, numbers, strict=True)
        )
        lines.append((" " * gap).join(padded).rstrip())
    return lines


def _width_of(text: str) -> int:
    """Width of a text on a terminal, columns."""
    if text.isascii():
        return len(text)
    kinds = [character for character in text if category(character) not in {"Mn", "Me", "Cf"}]
    return sum(2 if east_asian_width(character) in "WF" else 1 for character in kinds)


def counted(n: float, noun: str = "") -> str:
    """Count in words: ``1 object``, ``3,412 rows``, ``14.8 million voxels``."""
    for size, word in ((1e12, "million million"), (1e9, "billion"), (1e6, "million")):
        if n >= size:
            number = f"{n / size:.3g} {word}"
            break
    else:
        number = f"{n:,.0f}"
    plural = noun if n == 1 or not noun else f"{noun}s"
    return f"{number} {plural}".rstrip()


def counts(**numbers: float) -> str:
    """Counts in words, by noun: ``1 object, 3,412 rows``."""
    return ", ".join(counted(n, noun) for noun, n in numbers.items())


def bytes_text(n: float) -> str:
    """Bytes in words: ``13.5 MB``."""
    for size, word in ((1e12, "TB"), (1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if n >= size:
            return f"{n / size:.3g} {word}"
    return f"{n:.0f} bytes"


def box(bounds: "NDArray[np.float64]") -> str:
    """AABB (2, 3), metres, in words: ``4.28 x 1.9 x 1.4 m, from (0, 0, 0) to (4.28, ...)``."""
    step = float((bounds[1] - bounds[0]).max()) / 1e5
    low, high = (place_text(corner, step) for corner in bounds.tolist())
    sides = " x ".join(f"{side:.4g}" for side in (bounds[1] - bounds[0]).tolist())
    return f"{sides} m, from {low} to {high} m"


def box_record(bounds: "NDArray[np.float64] | None") -> dict[str, list[float]] | None:
    """AABB (2, 3), metres, for JSON; null for none."""
    if bounds is None:
        return None
    low, high = bounds.tolist()
    return {"low": low, "high": high, "extent": (bounds[1] - bounds[0]).tolist()}


def shares(counts: Mapping[str, int]) -> str:
    """Counts as shares, largest first: ``array 93 %, cbgroup 7 %``."""
    total = sum(counts.values()) or 1
    ranked = sorted(counts.items(), key=lambda item: (-item[1], item[0]))
    return ", ".join(f"{name} {100 * n / total:.3g} %" for name, n in ranked)


@contextmanager
def import_bar() -> "Iterator[ImportCallback | None]":
    """Progress bar of the imported parts of a file; see `bar`."""
    with bar("importing", "parts") as update:
        yield update and (lambda now: update(now.parts_done + now.share, now.parts_total))


@contextmanager
def bar(doing: str, noun: str, *, of: int = 1) -> "Iterator[Callable[[float, int], None] | None]":
    """Progress bar with counts, divided by `of`, and the remaining time.

    Yields a callback of the library, `store.base.Progress`, with a total of 0 for an unknown one;
    None if standard error is no terminal.
    """
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import BarColumn, Progress, SpinnerColumn, TextColumn, TimeRemainingColumn

    shown = Progress(
        SpinnerColumn(),
        TextColumn("{task.description}", markup=False),
        BarColumn(bar_width=14),
        TextColumn("{task.fields[count]}", markup=False),
        TimeRemainingColumn(compact=True),
        console=Console(file=sys.stderr),
        redirect_stdout=False,  # to the terminal of standard error
        transient=True,
    )
    with shown:
        task = shown.add_task(doing, total=None, count="")

        def advance(done: float, total: int) -> None:
            is_last, end = 0 < total == done, f"/{total // of:,}" if total else ""
            shown.update(
                task,
                description="finishing" if is_last else doing,
                total=None if is_last else total or None,
                completed=done,
                count=f"{int(done // of):,}{end} {noun}",
            )

        yield advance
