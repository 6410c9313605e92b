"""Pulls that press against contacts: the last resort of the straight ones."""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

import hapticdb
from extraction_scenes import SIZE, box, grounded, imported, joined, ledge
from hapticdb import GridOptions, ImportOptions, extract
from hapticdb.extraction.free_space import ContactSpace, FreeSpace
from hapticdb.extraction.leaving import Exit
from hapticdb.extraction.problem import problem_of
from hapticdb.extraction.pulls import Pulls, shifted
from hapticdb.resident.table import DEFAULT_BUDGET
from hapticdb.sample import write_sample

RECESS = 0.0005
"""Room around the bolt of `recessed`, metres: a tenth of a voxel."""


def recessed(folder: Path) -> Path:
    """A bolt whose head stands in a recess of a block, with a tenth of a voxel of room around it.

    The recess and the bore below it are open at the top, +z, where head and block end.
    """
    head, shaft = 0.008, 0.003
    block = []
    for low, high, hole in ((0.0, 0.02, shaft + RECESS), (0.02, 0.03, head + RECESS)):
        block += [
            box((-0.04, -0.04, low), (-hole, 0.04, high)),
            box((hole, -0.04, low), (0.04, 0.04, high)),
            box((-hole, -0.04, low), (hole, -hole, high)),
            box((-hole, hole, low), (hole, 0.04, high)),
        ]
    bolt = joined(
        box((-shaft, -shaft, 0.0), (shaft, shaft, 0.021)),
        box((-head, -head, 0.02), (head, head, 0.03)),
    )
    return imported(folder, block=joined(*block), bolt=bolt)


@contextmanager
def pulls_of(url: Path, part: str) -> Iterator[tuple[Pulls, ContactSpace]]:
    with hapticdb.open(url, read_only=True) as env:
        problem = problem_of(env, (part,), (), (), seed=0)
        reach = problem.radius + problem.voxel_size
        leaving = Exit(problem.box[0], problem.box[1], problem.center, reach, None)
        with (
            FreeSpace(problem, DEFAULT_BUDGET) as space,
            ContactSpace(problem, space, DEFAULT_BUDGET) as contact,
        ):
            yield Pulls(problem, space, contact, leaving, 0), contact


def test_a_part_stays_where_it_slides_along_its_bore_and_not_across(tmp_path: Path) -> None:
    with pulls_of(recessed(tmp_path), "bolt") as (_, contact):
        ways = np.arange(0.0, 0.035, 0.5 * SIZE)
        for direction, stays in (((0, 0, 1), True), ((1, 0, 0), False), ((0, 0, -1), False)):
            poses = np.array([shifted(way * np.array(direction, dtype=float)) for way in ways])
            assert contact.stays(poses) is stays


@pytest.mark.parametrize(("scene", "part"), [(ledge, "plate"), (grounded, "block")])
def test_no_pull_against_contacts_passes_through_a_wall(
    tmp_path: Path, scene: object, part: str
) -> None:
    with pulls_of(scene(tmp_path), part) as (pulls, _):  # type: ignore[operator]
        assert pulls.opposed_out(time.monotonic() + 500.0) == []


@pytest.mark.long
def test_a_wheel_bolt_comes_out_along_its_bore(tmp_path: Path) -> None:
    """At 10 bits its head presses against a third of the contacts, which are in its recess."""
    url = tmp_path / "car.db"
    options = ImportOptions(grid=GridOptions(bits=10))
    hapticdb.import_files(url, [write_sample(tmp_path / "sample").car], options)
    with hapticdb.open(url, read_only=True) as env:
        found = extract(env, "wheels/wheel_bolt_front_left_1", motions=0, seconds=500.0)
    assert found.verdict in {"slides out", "comes out of contact"}
    assert found.way is not None
    way = found.way.poses[-1][:3, 3]
    assert way[1] > 0.9 * np.linalg.norm(way)  # +y is out of the left wheels
