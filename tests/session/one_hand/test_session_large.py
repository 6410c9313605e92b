"""Sessions of large tools, whose clusters sleep by themselves."""

from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from children import TIMEOUT
from hapticdb import Environment, PointShell
from hapticdb.devices.scripted import Player
from hapticdb.query.law import PLANE, LawName
from hapticdb.recording.file import Recording, State
from hapticdb.session.prefetch.resident_cells import ResidentCells
from hapticdb.session.replay import replay
from hapticdb.session.report import Report
from hapticdb.session.session import Session
from session.hands import at
from session.sessions import NEVER_STALE, felt_at, recorded, standing_plate
from session.worlds import SIZE

RATE = 100.0
"""Frames a second: periods so long that a busy machine keeps them."""


class Ground(NamedTuple):
    """An environment with a floor, its cells, and the height at which a tool begins to touch."""

    env: Environment
    cells: ResidentCells
    height: float
    law: LawName


@pytest.fixture(scope="module", params=["plane", "distance"])
def ground(
    request: pytest.FixtureRequest, voxel_floor: Environment, distance_floor: Environment
) -> Iterator[Ground]:
    made, height = {"plane": (voxel_floor, 0.0), "distance": (distance_floor, SIZE)}[request.param]
    with ResidentCells(made.url, budget_bytes=4 << 20) as cells:
        yield Ground(made, cells, height, request.param)


def pressing(low: float) -> Player:
    """A hand that comes down, slides, and leaves, in a second and a half."""
    places = [(0.0, 0.02), (0.0, low), (0.008, low), (-0.008, low), (-0.008, 0.02)]
    return Player(np.linspace(0.0, 1.5, 5), [at(x, 0.0, z) for x, z in places])


def felt(ground: Ground, shell: PointShell, path: Path) -> Report:
    hand = pressing(ground.height - 0.003)
    with Session(
        ground.cells, shell, hand, law=ground.law, rate=RATE, record=path, staleness=NEVER_STALE,
        has_baseline=False,
    ) as session:  # fmt: skip
        report = session.wait(TIMEOUT)
    assert report is not None
    return report


def test_session_large_tool_clusters_same_bits(ground: Ground, tmp_path: Path) -> None:
    plate = standing_plate()
    report = felt(ground, plate, tmp_path / "s.hdbrec")
    assert report.contact_frames > 0
    frames = recorded(tmp_path / "s.hdbrec")
    assert frames["applied"].any()
    if ground.law == "plane":  # of which the device gets the force of a touch, once it has risen
        known = frames[(frames["time"] > 0.1) & (frames["state"] & State.HELD == 0)]
        flat = felt_at(ground.env, plate, known, PLANE)
        np.testing.assert_array_equal(flat[:, :3], known["applied"][:, :3])
    found = replay(Recording(tmp_path / "s.hdbrec"), ground.env)
    assert found.is_equal, found.describe()
