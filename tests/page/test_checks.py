"""Values that a browser sends are taken only if they are what the page asked for."""

import math

import numpy as np
import pytest

from hapticdb.errors import UsageError
from hapticdb.page import checks
from hapticdb.poses import pose_of_row


@pytest.mark.parametrize(
    "value", [-0.1, 10.1, math.nan, math.inf, -math.inf, True, "5", None, [5.0], {"a": 1}]
)
def test_number_of_bad_values(value: object) -> None:
    assert checks.number_of(np.float64(10.0), 0.0, 10.0, "a length") == 10.0
    with pytest.raises(UsageError, match="a length"):
        checks.number_of(value, 0.0, 10.0, "a length")


def test_choice_of_text_of_flag_of_bad_values() -> None:
    assert checks.choice_of("a", ("a", "b"), "a tool") == "a"
    assert checks.text_of("wheel\x00\n\x1b left", 20, "a search") == "wheel left"
    assert checks.flag_of(True, "voxels")
    for value in ("x" * 21, 1, None, b"wheel", ["a"]):
        with pytest.raises(UsageError):
            checks.choice_of(value, ("a", "b"), "a tool")
        with pytest.raises(UsageError):
            checks.text_of(value, 20, "a search")
        with pytest.raises(UsageError):
            checks.flag_of(value, "voxels")


def test_row_of_normalises_quaternion() -> None:
    row = checks.row_of((1.0, 2.0, 3.0), (2.0, 0.0, 0.0, 2.0))
    pose = pose_of_row(row[:3], row[3:])
    quarter = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    assert np.allclose(pose[:3, :3], quarter)
    assert np.allclose(pose[:3, 3], (1.0, 2.0, 3.0))


@pytest.mark.parametrize(
    ("place", "turn"),
    [
        ((math.nan, 0, 0), (1, 0, 0, 0)),
        ((0, 0, 2e9), (1, 0, 0, 0)),
        ((0, 0), (1, 0, 0, 0)),
        ((0, 0, 0), (0, 0, 0, 0)),
        ((0, 0, 0), (1, math.inf, 0, 0)),
        ("abc", (1, 0, 0, 0)),
        (None, None),
    ],
)
def test_row_of_bad_pose(place: object, turn: object) -> None:
    with pytest.raises(UsageError):
        checks.row_of(place, turn)
