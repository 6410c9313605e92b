"""No module outside store/ depends on a particular engine; it checks for a protocol."""

import ast
import re
from collections.abc import Iterator

from house.test_house import imported
from sources import PACKAGE, modules, tree

DRIVERS = {"apsw", "sqlite3", "psycopg"}
ASKS_OF_TEXT = {"startswith", "endswith", "partition", "removeprefix", "match", "search"}


def test_modules_engine_independent_outside_store() -> None:
    """No other module imports an engine's driver or modules, or branches on an engine's name."""
    folders = {f"hapticdb.store.{path.parent.name}" for path in PACKAGE.glob("store/*/*_store.py")}
    assert len(folders) == 2
    for path in modules():
        if path.is_relative_to(PACKAGE / "store"):
            continue
        names = imported(path)
        assert not {name.split(".")[0] for name in names} & DRIVERS, path
        assert not {".".join(name.split(".")[:3]) for name in names} & folders, path
        assert list(branches_on_engines(tree(path))) == [], path


def branches_on_engines(source: ast.Module) -> Iterator[str]:
    """Comparisons with an engine's name, and methods of `ASKS_OF_TEXT` called with one."""
    engine = re.compile("sqlite|postgres", re.IGNORECASE)
    for node in ast.walk(source):
        asked: list[ast.expr] = []
        if isinstance(node, ast.Compare):
            asked = [node.left, *node.comparators]
        elif isinstance(node, ast.MatchValue):
            asked = [node.value]
        elif isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute):
            asked = node.args if node.func.attr in ASKS_OF_TEXT else []
        parts = [part for one in asked for part in ast.walk(one) if isinstance(part, ast.Constant)]
        if any(isinstance(part.value, str) and engine.search(part.value) for part in parts):
            yield ast.unparse(node)
