"""The rooms and floors that ARCHITECTURE.md draws are those of the sources."""

import re
from pathlib import PurePosixPath

from house.test_house import FLOORS, LEVELS
from sources import PACKAGE, ROOT, modules

PAGE = (ROOT / "ARCHITECTURE.md").read_text()
BY_ITS_FILES = {"sample", "mesh/formats", "devices/vendors", "cli/verbs"}
"""Rooms whose modules are not listed: each is named after its part, format, device or verb."""


def drawn_floors() -> list[set[str]]:
    """Names of rooms on each line of the drawing, from the top."""
    block = PAGE.partition("## Rooms and floors")[2].split("```")[1]
    lines = [{word.rstrip("/") for word in line.split()} for line in block.splitlines()]
    return [found for words in lines if (found := words & set(LEVELS))]


def rooms() -> dict[str, set[str]]:
    """Names of modules and folders in the table's row of each room."""
    rows = re.findall(r"^\| `([a-z/]+)/` \| (.*) \|$", PAGE, re.MULTILINE)
    return {room: set(re.findall(r"`([a-z_]+)/?`", text)) for room, text in rows}


def room_of(path: PurePosixPath) -> str:
    """The innermost room with a row of its own that holds a source."""
    return next(str(p) for p in path.parents if str(p) in rooms() or str(p) in BY_ITS_FILES)


def test_the_floors_are_drawn_as_they_are_tested() -> None:
    assert drawn_floors() == FLOORS


def test_every_module_is_named_in_the_row_of_its_room() -> None:
    sources = [PurePosixPath(path.relative_to(PACKAGE).as_posix()) for path in modules()]
    inside = [path for path in sources if len(path.parts) > 1 and path.stem != "__init__"]
    missing = [
        str(path)
        for path in inside
        if (room := room_of(path)) not in BY_ITS_FILES and path.stem not in rooms()[room]
    ]
    assert len(inside) > 150
    assert missing == []


def test_every_name_in_a_row_is_a_module_or_a_folder() -> None:
    sources = [PurePosixPath(path.relative_to(PACKAGE).as_posix()) for path in modules()]
    known = {path.stem for path in sources} | {part for p in sources for part in p.parts[:-1]}
    found = {room: names - known for room, names in rooms().items()}
    assert {room: names for room, names in found.items() if names} == {}
