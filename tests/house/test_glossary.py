"""The glossary names things that exist in the code, and defines each word once."""

import dataclasses
import importlib
import re
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest

import hapticdb

PAGE = (Path(__file__).parent.parent.parent / "docs" / "glossary.md").read_text()


def rows() -> Iterator[tuple[str, str]]:
    """Word and code column of each row of the page's tables."""
    for line in PAGE.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 3 and cells[0] not in {"word", "---"}:
            yield cells[0], cells[2]


def names() -> list[str]:
    """Dotted names that begin with the package or with one of its public classes."""
    found = [name for _, place in rows() for name in re.findall(r"`([A-Za-z_.]+)`", place)]
    return [name for name in found if name.partition(".")[0] in {"hapticdb", *hapticdb.__all__}]


def exists(name: str) -> bool:
    """Whether a dotted name leads to a module, a class, a function or a field of a class."""
    found: object = hapticdb
    for word in name.removeprefix("hapticdb.").split("."):
        if isinstance(found, ModuleType) and not hasattr(found, word):
            try:
                found = importlib.import_module(f"{found.__name__}.{word}")
            except ModuleNotFoundError:
                return False
        elif dataclasses.is_dataclass(found) and word in {
            f.name for f in dataclasses.fields(found)
        }:
            found = None
        elif hasattr(found, word):
            found = getattr(found, word)
        else:
            return False
    return True


@pytest.mark.parametrize("name", names())
def test_what_the_glossary_names_is_in_the_code(name: str) -> None:
    assert exists(name)


def test_a_name_that_is_not_there_is_seen() -> None:
    assert not exists("hapticdb.resident.NoSuchThing")
    assert not exists("Touch.no_such_field")


def test_the_glossary_has_each_word_once() -> None:
    words = [word.strip() for words, _ in rows() for word in words.split(",")]
    assert len(words) > 40
    assert sorted(words) == sorted(set(words))
