"""Text in columns, as wide as a terminal or as it needs.

Of 4,000 objects a general table library laid out the columns in 9.8 of 11 s, under a profiler.
"""

import textwrap
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass

GAP = 3
"""Blanks between two columns of a table."""
FACTS_GAP = 2
"""Blanks between a name and its value."""
LEAST = 12
"""Width, in characters, below which no column of texts is narrowed."""
BOLD, DIM, PLAIN = "\x1b[1m", "\x1b[2m", "\x1b[0m"
"""What switches a terminal's style."""


@dataclass(frozen=True)
class Columns:
    """Rows of printable text in columns.

    headings : of a table, which has a rule below them; without any, names and values
    numbers : indices of the columns that are aligned to the right and never folded
    """

    rows: Sequence[Sequence[str]]
    headings: Sequence[str] = ()
    numbers: frozenset[int] = frozenset()

    def lines(self, width: int | None, *, is_styled: bool) -> list[str]:
        """Lines of at most `width` characters, if texts can be folded to it; None: of any width."""
        grid = [*([self.headings] if self.headings else []), *self.rows]
        if not grid:
            return []
        gap = GAP if self.headings else FACTS_GAP
        widths = [max(map(width_of, column)) for column in zip(*grid, strict=True)]
        if width is not None:
            self._narrow(widths, width - gap * (len(widths) - 1) - 2 * bool(self.headings))
        left, between = " " * bool(self.headings), " " * gap
        laid: list[str] = []
        for n, row in enumerate(grid):
            style = self._style(n) if is_styled else ""
            cells = [
                [text] if width_of(text) <= most else folded(text, most)
                for text, most in zip(row, widths, strict=True)
            ]
            for k in range(max(map(len, cells))):
                line = between.join(
                    _padded(cell[k] if k < len(cell) else "", widths[i], i in self.numbers)
                    for i, cell in enumerate(cells)
                )
                laid.append(_styled((left + line).rstrip(), style, len(left) + widths[0]))
            if n == 0 and self.headings:
                laid.append("─" * (sum(widths) + gap * (len(widths) - 1) + 2))
        return laid

    def _narrow(self, widths: list[int], room: int) -> None:
        """Narrow the widest columns of texts until all columns fit, or none can be narrowed."""
        while (over := sum(widths) - room) > 0:
            texts = [i for i in range(len(widths)) if i not in self.numbers and widths[i] > LEAST]
            if not texts:
                return
            widest = max(texts, key=lambda i: widths[i])
            others = [widths[i] for i in texts if widths[i] < widths[widest]]
            widths[widest] = max(widths[widest] - over, max(others, default=LEAST) - 1, LEAST)

    def _style(self, n: int) -> str:
        if self.headings:
            return BOLD if n == 0 else ""
        return DIM


def _styled(line: str, style: str, name_ends: int) -> str:
    """Style a line of headings as a whole, and of a fact its name alone."""
    if not style:
        return line
    end = name_ends if style == DIM else len(line)
    return f"{style}{line[:end]}{PLAIN}{line[end:]}"


def width_of(text: str) -> int:
    """Columns that a text takes on a terminal."""
    if text.isascii():
        return len(text)
    return sum(map(_columns_of, text))


def _columns_of(character: str) -> int:
    if unicodedata.combining(character) or unicodedata.category(character) in {"Mn", "Me", "Cf"}:
        return 0
    return 2 if unicodedata.east_asian_width(character) in "WF" else 1


def folded(text: str, width: int) -> list[str]:
    """Lines of at most `width` columns, broken between words if the text is ASCII."""
    if text.isascii():
        return textwrap.wrap(text, width, break_on_hyphens=False) or [""]
    lines, used = [""], 0
    for character in text:
        columns = _columns_of(character)
        if used + columns > width:
            lines.append("")
            used = 0
        lines[-1] += character
        used += columns
    return lines


def _padded(text: str, width: int, is_number: bool) -> str:  # noqa: FBT001 - private
    blanks = " " * (width - width_of(text))
    return blanks + text if is_number else text + blanks
