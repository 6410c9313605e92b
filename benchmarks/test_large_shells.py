"""The benchmark of large tools runs on a tiny scene."""

from pathlib import Path

import numpy as np
import pytest

import large_shells
from large_shells import compare, sheet


def test_every_way_feels_the_same_and_few_points_are_near(tmp_path: Path) -> None:
    """`measure` compares every bit itself; this test asserts that something was felt."""
    plane, smooth = compare(tmp_path, [4096], [0.25], 12, 7)
    for line in (plane, smooth):
        assert 0.0 < line["near_share"] < 0.7
        assert set(line["us"]) == {"flat", "tested", "sleeping"}
    assert smooth["contacts"] > 0


def test_frames_within_a_budget_are_timed_beside_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(large_shells, "BUDGET", 512)
    for line in compare(tmp_path, [4096], [0.25], 12, 7):
        assert set(line["us"]) == {"flat", "tested", "sleeping", "budget"}
        assert line["budget"]["left_out_frames"] > 0
        assert 0 < line["budget"]["looked_at"] <= 512
        assert 0.0 <= line["budget"]["most_off"] <= 1.0


def test_a_sheet_has_its_neighbours_by_index_near_in_space() -> None:
    points = sheet(4096).points
    assert np.ptp(points[:64], axis=0).max() <= 8 / 64
