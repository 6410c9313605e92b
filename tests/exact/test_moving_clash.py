"""Parts that move: when they meet others, against closed forms."""

from pathlib import Path

import numpy as np
import pytest

import hapticdb
from assemblies import row_of_boxes
from hapticdb.errors import UsageError
from hapticdb.exact.moving_clash import find_meetings, hinge

CONTACT = 5e-5
MEETING = 2e-5
"""Metres: how near surfaces are that have met, and how exactly a meeting's end is found."""


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Three cubes of 0.1 m in a row, 0.2 m between two."""
    return row_of_boxes(tmp_path / "row.db", 3, 0.3)


def along_x(*ways: float) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    poses = np.tile(np.eye(4), (len(ways), 1, 1))
    poses[:, 0, 3] = ways
    return poses


def test_find_meetings_translation_closed_form(path: Path) -> None:
    with hapticdb.open(path, read_only=True) as env:
        found = find_meetings(env, ["cube0"], along_x(0.0, 0.9), contact=CONTACT)
        assert [(one.name, one.kind) for one in found] == [
            ("cube1", "overlapping"), ("cube2", "overlapping"),
        ]  # fmt: skip
        for one, begin, end in zip(found, (0.2, 0.5), (0.4, 0.7), strict=True):
            assert 0.9 * one.begin == pytest.approx(begin, abs=MEETING)
            assert 0.9 * one.end == pytest.approx(end + CONTACT, abs=MEETING)
            assert 0.0 < one.at_least <= 0.05
        there_and_back = find_meetings(env, [1], along_x(0.0, 0.25, 0.0), against=["cube1"])
        (one,) = there_and_back
        assert (one.begin, one.end) == pytest.approx((0.8, 1.2), abs=1e-3)
        assert find_meetings(env, [1], along_x(0.0, 0.19)) == []


def are_apart(turn: float) -> bool:
    """Whether squares of 0.1 m are apart, one turned by degrees about a point 0.15 m from both."""
    angle = np.radians(turn)
    axes = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    signs = 0.05 * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]])
    one, other = 0.15 * axes[0] + signs @ axes, signs - [0.15, 0.0]
    for way in (*axes, *np.eye(2)):
        if (one @ way).min() > (other @ way).max() or (other @ way).min() > (one @ way).max():
            return True
    return False


def test_find_meetings_hinge_closed_form(path: Path) -> None:
    with hapticdb.open(path, read_only=True) as env:
        about = (0.15, 0.0, 0.0)
        poses = hinge(2, about, 0.0, 360.0)
        (one,) = find_meetings(env, ["cube1"], poses, about=about, against=["cube0"])
        begin, end = 360.0 / (len(poses) - 1) * np.array([one.begin, one.end])
        assert (one.kind, are_apart(begin - 0.05), are_apart(begin + 0.05)) == (
            "overlapping", True, False,
        )  # fmt: skip
        assert begin + end == pytest.approx(360.0, abs=0.05)
        half = hinge(2, about, 0.0, 90.0)
        assert find_meetings(env, ["cube1"], half, about=about, against=["cube0"]) == []


def test_find_meetings_sliding_contact_is_touching(tmp_path: Path) -> None:
    """A cube slides along the flush face of another: no meeting is deeper than the tolerance."""
    with hapticdb.open(row_of_boxes(tmp_path / "flush.db", 2), read_only=True) as env:
        poses = np.tile(np.eye(4), (2, 1, 1))
        poses[1, 1, 3] = 0.2
        (one,) = find_meetings(env, ["cube0"], poses)
        assert (one.kind, one.begin, one.at_least) == ("touching", 0.0, 0.0)
        assert 0.2 * one.end == pytest.approx(0.1 + CONTACT, abs=MEETING)


@pytest.mark.parametrize(("begin", "end"), [(0.0, 0.0), (0.0, 361.0), (np.nan, 1.0)])
def test_hinge_bad_angles(begin: float, end: float) -> None:
    with pytest.raises(UsageError, match="degrees"):
        hinge(0, (0.0, 0.0, 0.0), begin, end)
