"""Rules of the project, checked on the sources: sizes of files, functions, folders; names."""

import ast
import re
from collections import Counter
from collections.abc import Iterator

from sources import modules, named, python_files, tree


def test_sizes_files_at_most_500_lines() -> None:
    lengths = {named(path): len(path.read_text().splitlines()) for path in python_files()}
    assert {name: n for name, n in lengths.items() if n > 500} == {}


MOST_LINES = 60
"""Longest function in lines, with signature and docstring."""


def lengths(source: ast.Module) -> Iterator[tuple[str, int]]:
    """Name and lines of each function of a source."""
    for node in ast.walk(source):
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
            assert node.end_lineno is not None
            yield node.name, node.end_lineno - node.lineno + 1


def test_sizes_functions_at_most_60_lines() -> None:
    long = {
        f"{named(path)}:{name}": n_lines
        for path in modules()
        for name, n_lines in lengths(tree(path))
        if n_lines > MOST_LINES
    }
    assert long == {}


MOST_FILES = 15
"""Most Python files in a folder, without ``__init__``."""


def test_sizes_folders_at_most_15_files() -> None:
    counts = Counter(named(path.parent) for path in modules() if path.stem != "__init__")
    assert {folder: n for folder, n in counts.items() if n > MOST_FILES} == {}


def public_classes(source: ast.Module) -> list[str]:
    """Names of the classes at the top of a source, private ones left out."""
    names = [node.name for node in source.body if isinstance(node, ast.ClassDef)]
    return [name for name in names if not name.startswith("_")]


def test_names_public_classes_unique() -> None:
    homes: dict[str, list[str]] = {}
    for path in modules():
        for name in public_classes(tree(path)):
            homes.setdefault(name, []).append(named(path))
    assert {n: paths for n, paths in homes.items() if len(paths) > 1} == {}


def test_names_files_not_vague() -> None:
    vague = re.compile(r"util|helper|manager|(^|_)data(_|$)|common|misc")
    assert [named(p) for p in python_files() if vague.search(p.stem)] == []
