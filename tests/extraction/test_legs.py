"""Ways of straight legs along the axes: found without a planner."""

from pathlib import Path

import numpy as np
import pytest

import hapticdb
from extraction_scenes import room_with_a_door
from hapticdb import extract
from hapticdb.extraction.planner import Planner


@pytest.fixture
def no_planner(monkeypatch: pytest.MonkeyPatch) -> None:
    def asked(*_: object, **__: object) -> None:
        raise AssertionError("the planner's process was asked")

    monkeypatch.setattr(Planner, "_ask", asked)


@pytest.mark.usefixtures("no_planner")
def test_a_block_leaves_a_room_by_its_door(tmp_path: Path) -> None:
    with hapticdb.open(room_with_a_door(tmp_path), read_only=True) as env:
        found = extract(env, "block", seconds=500.0)
    assert (found.verdict, found.is_planned) == ("comes out", True)
    assert found.way is not None
    up, along, out = np.diff(found.way.poses[:, :3, 3], axis=0)
    assert up[2] > 0.02
    assert (along != 0.0).tolist() == [True, False, False]
    assert 0.27 < up[0] + along[0] < 0.37  # the block is 0.06 m wide, the door 0.14 m
    assert out[1] > 0.1
