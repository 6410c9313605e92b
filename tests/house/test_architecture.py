"""The floors that ARCHITECTURE.md draws are those of the sources."""

from house.test_house import FLOORS, LEVELS
from sources import ROOT

PAGE = (ROOT / "ARCHITECTURE.md").read_text()


def drawn_floors() -> list[set[str]]:
    """Names of rooms on each line of the drawing, from the top."""
    block = PAGE.partition("## Rooms and floors")[2].split("```")[1]
    lines = [{word.rstrip("/") for word in line.split()} for line in block.splitlines()]
    return [found for words in lines if (found := words & set(LEVELS))]


def test_the_floors_are_drawn_as_they_are_tested() -> None:
    assert drawn_floors() == FLOORS
