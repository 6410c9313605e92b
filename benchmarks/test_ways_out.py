"""Parts of the sample car come out, or are held, as they were built; exact meshes agree."""

import os
from pathlib import Path
from typing import Any

import pytest

if "CI" not in os.environ:
    pytest.importorskip("coal", reason="make peers installs it")

from ways_out import BITS, SAMPLE, WHEEL, measure

MOTIONS = 300
"""After so many a search ends in vain, so that it is the same on a busy machine."""
PATIENCE = 600.0
"""Seconds in which each search must end by itself."""


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    folder: Path = tmp_path_factory.mktemp("ways")
    return measure(folder, None, BITS, SAMPLE, PATIENCE, MOTIONS, os.cpu_count() or 1)


@pytest.fixture(scope="module")
def rows(found: dict[str, Any]) -> dict[str, dict[str, object]]:
    return {row["parts"]: row for row in found["rows"]}


SEAT, PLUG = SAMPLE[-2].name, SAMPLE[-1].name
OUT = {"wheels/wheel_bolt_front_left_1", "body/hood", *(SAMPLE[n].name for n in (1, 7, 8, 9, 10))}
HELD_BY = {
    "body/door_front_left": "body/pillar_a",
    "seats/seat_*_left": "cabin/floor_pan",
    "wheels/tyre_front_left, wheels/rim_front_left": "wheels/wheel_bolt",
    "supply/battery": "supply/wiring_harness",
}


def test_what_is_free_comes_out_and_what_is_held_does_not(
    rows: dict[str, dict[str, object]],
) -> None:
    verdicts = {name: row["verdict"] for name, row in rows.items()}
    assert {name for name, said in verdicts.items() if said != "no way found"} == OUT
    for name in OUT:
        assert verdicts[name] in {"comes out", "slides out", "comes out of contact"}


def test_what_holds_a_part_is_named_first(rows: dict[str, dict]) -> None:  # type: ignore[type-arg]
    for name, holder in HELD_BY.items():
        assert rows[name]["blockers"][0][0].startswith(holder)


def test_exact_meshes_keep_the_proved_distance(rows: dict[str, dict]) -> None:  # type: ignore[type-arg]
    for name in OUT:
        row = rows[name]
        assert row["clearance_m"] > 0.0
        assert row["mesh_distance_m"] >= row["clearance_m"]
        assert row["mesh_poses"] > 20


def test_the_spark_plug_comes_out_along_its_bore(rows: dict[str, dict[str, Any]]) -> None:
    """The bore is 3.6 voxels wider than the plug: nothing is touched, all of the way is proved."""
    row = rows[PLUG]
    x, y, z = row["end_m"]
    assert (row["verdict"], row["how"]) == ("comes out", "pull")
    assert z > 0.0
    assert max(abs(x), abs(y)) < 0.5 * z  # the bore's rim lets it lean so far, no farther


def test_the_seat_comes_out_by_the_door_in_three_legs(rows: dict[str, dict[str, Any]]) -> None:
    """No straight pull leads out. It touches nothing at its start, so all of the way is proved."""
    row = rows[SEAT]
    _, y, z = row["end_m"]
    assert (row["verdict"], row["how"], row["motions"]) == ("comes out", "plan", 0)
    assert y > 1.0  # to the left
    assert 0.03 < z < 0.1  # over the sill, below the roof


def test_the_wheel_comes_out_after_its_bolts_by_itself(found: dict[str, Any]) -> None:
    order = found["order"]
    *bolts, wheel = order["steps"]
    names = {f"wheels/wheel_bolt_front_left_{n}" for n in range(1, 6)}
    assert {step["parts"] for step in bolts} == names
    assert wheel["parts"] == ", ".join(WHEEL)
    for step in order["steps"]:
        assert step["verdict"] in {"comes out", "slides out", "comes out of contact"}
        assert step["clearance_m"] > 0.0
        assert step["mesh_distance_m"] >= step["clearance_m"]
