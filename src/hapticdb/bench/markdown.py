"""Markdown of numbers: tables, times, ratios, lists in words."""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from hapticdb.bench.cells import WHERE, Cell, frame_us, is_cut_short, named
from hapticdb.errors import FileError

NONE = "-"
"""Stands where nothing was measured."""


def us_text(value: float | None) -> str:
    """Microseconds to two or three digits."""
    if value is None:
        return NONE
    if value >= 99.5:
        return f"{value:,.0f}"
    return f"{value:.1f}" if value >= 9.95 else f"{value:.2g}"


def time_text(cell: Cell, measure: str = "typical") -> str:
    """Time of a cell, with a star where the time limit ended it."""
    us = frame_us(cell, measure)
    return us_text(us) + ("*" if us is not None and is_cut_short(cell) else "")


def ratio_text(value: float | None) -> str:
    """Multiple to two places."""
    return NONE if value is None else f"{value:,.2f}"


def count_text(value: float | None) -> str:
    """Whole number with commas; a number below 100 that is not whole keeps one decimal."""
    if value is None:
        return NONE
    return f"{value:,.1f}" if value < 100 and value != round(value) else f"{value:,.0f}"


def bytes_text(value: float | None) -> str:
    """Bytes in the largest unit below it, three digits."""
    if value is None:
        return NONE
    for size, unit in ((1e9, "GB"), (1e6, "MB"), (1e3, "kB")):
        if value >= size:
            return f"{value / size:,.3g} {unit}"
    return f"{value:.0f} bytes"


def table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Markdown table; columns of numbers are aligned to the right. Empty without rows."""
    body = [[_escaped(text) for text in row] for row in rows]
    if not body:
        return ""
    columns = list(zip(*body, strict=True))
    rules = ["---:" if all(_is_number(text) for text in column) else "---" for column in columns]
    lines = [[_escaped(text) for text in head], rules, *body]
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def _escaped(text: str) -> str:
    return " ".join(text.split()).replace("|", "\\|")


def _is_number(text: str) -> bool:
    return text == NONE or text[:1].isdigit()


def fact_table(facts: Mapping[str, object]) -> str:
    """Table of names and what each says; lists and mappings in words."""
    return table(["", ""], [[str(name), _in_words(value)] for name, value in facts.items()])


def _in_words(value: object) -> str:
    if isinstance(value, list | tuple):
        return ", ".join(_in_words(each) for each in value)
    if isinstance(value, Mapping):
        return "; ".join(f"{name}: {_in_words(each)}" for name, each in value.items())
    if isinstance(value, bool) or value is None:
        return json.dumps(value)
    return f"{value:,}" if isinstance(value, int) else str(value)


def section(title: str, text: str) -> str:
    """Text under a heading of the third level; empty without text."""
    return f"### {title}\n\n{text}" if text.strip() else ""


def image(caption: str, target: str) -> str:
    """Image with the text that stands for it where it is not seen; brackets would end that."""
    return f"![{caption.replace('[', '(').replace(']', ')')}]({target})"


def versions_of(result: Mapping[str, Any]) -> dict[str, Any]:
    """Commit of hapticdb, then the versions of what it ran with; empty when none is named."""
    commit = result.get("commit")
    return ({"hapticdb": f"commit {commit}"} if commit else {}) | dict(result.get("versions") or {})


def notes_of(result: Mapping[str, Any]) -> list[str]:
    """Notes of a result, each on one line."""
    return [" ".join(str(note).split()) for note in result.get("notes") or ()]


def write_page(path: Path, parts: Iterable[str]) -> None:
    """Write a Markdown file; its folder is made when it does not exist.

    Raises
    ------
    FileError
        A file that cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(paragraphs(*parts) + "\n", encoding="utf-8")
    except OSError as error:
        raise FileError(f"cannot write {path}: {error.strerror}") from error


def listed(words: Iterable[str]) -> str:
    """Words joined by commas, the last by `and`."""
    every = list(words)
    return " and ".join(filter(None, [", ".join(every[:-1]), *every[-1:]]))


def paragraphs(*parts: str) -> str:
    """Parts set apart by an empty line; empty ones are left out."""
    return "\n\n".join(part.strip("\n") for part in parts if part.strip())


def bullets(sentences: Iterable[str]) -> str:
    """Each sentence as an item of a list."""
    return "\n".join(f"- {sentence}" for sentence in sentences)


def place_of(where: Mapping[str, Any], among: Iterable[Mapping[str, Any]]) -> str:
    """Conditions in words: engine, layout, and whatever differs among all that are listed."""
    listed_too = list(among)
    said = []
    for key in WHERE:
        differs = len({str(other.get(key)) for other in listed_too}) > 1
        if where.get(key) is not None and (differs or key in {"engine", "layout"}):
            said.append(_spoken(key, where[key]))
    return ", ".join(said) or "all cells"


def _spoken(key: str, value: object) -> str:
    text = named(value)
    if key == "points" and isinstance(value, int | float):
        return f"{value:,.0f} points"
    words = {
        "region": f"{text} density",
        "cache": f"cache {text}",
        "file": f"file {text}",
        "poses": f"{text} poses",
    }
    return words.get(key, text)
