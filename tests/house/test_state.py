"""State has named fields: no number is used as the index of a position, wrench or count."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent.parent / "src" / "hapticdb"
ROOMS = (
    "kernels/hand",
    "kernels/resident",
    "realtime",
    "recording",
    "resident",
    "sweeps",
    "devices",
)
STATE = {
    "body", "control", "desk", "felt", "figures", "frame", "hand", "missed", "next_frame", "offset",
    "servo", "session", "sessions", "signal", "state", "told", "tool",
}  # fmt: skip
"""Names of arrays of state. Their fields, like ``hand.position``, may be indexed by numbers."""


def sources() -> list[Path]:
    return sorted(path for room in ROOMS for path in (PACKAGE / room).rglob("*.py"))


def name_of(node: ast.expr) -> str:
    """Last part of a dotted name."""
    return node.attr if isinstance(node, ast.Attribute) else getattr(node, "id", "")


def literals_in(index: ast.expr) -> Iterator[int]:
    """Plain numbers in an index; in ``WRENCH + 1`` the 1 does not count."""
    if isinstance(index, ast.Constant):
        if isinstance(index.value, int):
            yield index.value
    elif isinstance(index, ast.UnaryOp):
        yield from literals_in(index.operand)
    elif isinstance(index, ast.Tuple):
        for part in index.elts:
            yield from literals_in(part)
    elif isinstance(index, ast.Slice):
        for bound in (index.lower, index.upper):
            if bound is not None:
                yield from literals_in(bound)


def numbered(source: str) -> list[int]:
    """Line numbers of a source at which a number indexes state."""
    return [
        node.lineno
        for node in ast.walk(ast.parse(source))
        if isinstance(node, ast.Subscript)
        and name_of(node.value) in STATE
        and any(True for _ in literals_in(node.slice))
    ]


@pytest.mark.parametrize(
    "line",
    ["state[41]", "self.hand[:3]", "told[0, 4:7] = 0.0", "desk.figures[-1]", "x = frame[2] + 1"],
)
def test_a_number_that_indexes_state_is_found(line: str) -> None:
    assert numbered(line) == [1]


@pytest.mark.parametrize(
    "line", ["hand.position[2]", 'told["radius"]', "felt[WRENCH + n]", "state[LEAST]", "tool[()]"]
)
def test_a_name_that_indexes_state_is_no_number(line: str) -> None:
    assert numbered(line) == []


def test_no_number_indexes_state() -> None:
    """`kernels.records` defines the fields of state; other modules use the fields' names."""
    assert len(sources()) > 30
    found = {path.relative_to(PACKAGE).as_posix(): numbered(path.read_text()) for path in sources()}
    assert {name: lines for name, lines in found.items() if lines} == {}
