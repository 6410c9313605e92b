"""Ways out of scenes made of boxes, whose ways are known by construction."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
from hypothesis import given
from hypothesis import strategies as st

import hapticdb
from extraction_scenes import (
    PITCH,
    box,
    corner,
    drawer,
    enclosed,
    found_in,
    imported,
    is_out,
    ledge,
    lid,
    recessed,
    room_with_a_door,
    shadow_planner,
    threaded,
    walls,
)
from hapticdb import extract
from hapticdb.errors import MissingExtraError, ObjectNotFoundError, UsageError
from hapticdb.exact.sweep import sweep
from hapticdb.exact.swept import Swept
from hapticdb.extraction.planner import Planner
from hapticdb.extraction.problem import Exit
from hapticdb.extraction.pulls import shifted
from hapticdb.extraction.verdict import extraction_line

# --- straight pulls ------------------------------------------------------------------------------


def test_extract_lid_above_pot_gap(tmp_path: Path) -> None:
    url = lid(tmp_path, 0.03)
    found = found_in(url, "lid", motions=0)
    assert found.path is not None
    assert (found.verdict, found.path.how, found.near) == ("comes out", "pull", ())
    assert is_out(found, url)
    assert found.path.gap == pytest.approx(0.03, rel=0.01)
    assert extraction_line(found).startswith("comes out straight, ")


def test_extract_lid_touching_pot(tmp_path: Path) -> None:
    url = lid(tmp_path, 0.0)
    found = found_in(url, "lid", motions=0)
    assert found.path is not None
    assert found.verdict == "comes out"
    assert [obj.name for obj in found.near] == ["pot"]
    assert [one.object.name for one in found.path.swept.touching] == ["pot"]
    assert found.path.poses[-1][2, 3] >= 0.0  # not through the pot
    assert is_out(found, url)
    assert "; touches pot until " in extraction_line(found)


def test_extract_touching_at_end_slides(tmp_path: Path) -> None:
    """A plate under a ledge can only slide along the floor and the ledge for a short way."""
    found = found_in(ledge(tmp_path), "plate", motions=0, out=0.01)
    assert (found.verdict, found.is_free) == ("slides", True)
    assert extraction_line(found).startswith("slides straight, 10 mm")


@pytest.mark.parametrize("tilt", [0.0, 0.4])
def test_extract_bolt_from_tight_bore(tmp_path: Path, tilt: float) -> None:
    """By voxels it is in contact all around; tilted, no axis of the world is its own."""
    found = found_in(recessed(tmp_path, tilt), "bolt", motions=0)
    assert found.path is not None
    assert (found.verdict, found.path.how) == ("comes out", "pull")
    way = found.path.poses[-1][:3, 3]
    assert way @ [np.sin(tilt), 0.0, np.cos(tilt)] == pytest.approx(np.linalg.norm(way))
    assert found.path.swept.verdict == "clear"


def test_extract_nut_by_screw_motion(tmp_path: Path) -> None:
    url = threaded(tmp_path)
    assert found_in(url, "nut", motions=0).path is None
    found = found_in(url, "nut", motions=0, screw=PITCH)
    assert found.path is not None
    assert (found.verdict, found.path.how) == ("comes out", "screw")
    assert found.path.gap is not None
    assert 0.0005 < found.path.gap < 0.002
    assert extraction_line(found).startswith("comes out by a screw motion, ")
    assert found_in(url, "nut", motions=0, screw=2.0 * PITCH).path is None


def test_extract_open_surfaces_in_contact(tmp_path: Path) -> None:
    """Neither has an inside: that they cut nothing is told by what goes through them."""
    open_pot = walls((0.0, 0.0, 0.0), (0.2, 0.2, 0.1), 0.02, "+z")
    open_pot.update_faces(np.arange(len(open_pot.faces)) > 1)
    cap = box((-0.02, -0.02, 0.1), (0.22, 0.22, 0.12))
    cap.update_faces(np.arange(len(cap.faces)) > 1)
    found = found_in(imported(tmp_path, 0.01, pot=open_pot, lid=cap), "lid", motions=0)
    assert found.path is not None
    assert found.verdict == "comes out"
    assert [one.object.name for one in found.path.swept.touching] == ["pot"]


def test_extract_drawer_open_side_only(tmp_path: Path) -> None:
    url = drawer(tmp_path)
    found = found_in(url, "drawer", motions=0)
    assert found.path is not None
    assert (found.verdict, found.path.how) == ("comes out", "pull")
    way = found.path.poses[-1][:3, 3]
    assert way[1] > 0.9 * np.linalg.norm(way)
    assert is_out(found, url)
    assert [(one.object.name, one.pulls > 0) for one in found.blockers] == [("shaft", True)]


def test_extract_block_through_door_without_planner(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By straight legs along the axes."""
    monkeypatch.delattr(Planner, "_plan")
    found = found_in(room_with_a_door(tmp_path), "block")
    assert (found.verdict, found.is_planned) == ("comes out", True)
    assert found.path is not None
    up, along, out = np.diff(found.path.poses[:, :3, 3], axis=0)
    assert up[2] > 0.02
    assert (along != 0.0).tolist() == [True, False, False]
    assert 0.27 < up[0] + along[0] < 0.37  # the block is 0.06 m wide, the door 0.14 m
    assert out[1] > 0.1


# --- the planner ---------------------------------------------------------------------------------


def test_extract_corner_plan_confirmed(tmp_path: Path) -> None:
    url = corner(tmp_path)
    found = found_in(url, "block", seed=3)
    assert found.path is not None
    assert (found.verdict, found.path.how) == ("comes out", "plan")
    assert is_out(found, url)
    assert len(found.path.poses) > 2
    assert [one.object.name for one in found.blockers] == ["channel"]
    assert f"<td>channel</td><td>stops {found.pulls} pulls</td>" in found._repr_html_()
    assert found.blockers[0].pulls == found.pulls  # none leads out straight


@pytest.mark.long
def test_extract_same_seed_same_path(tmp_path: Path) -> None:
    url = corner(tmp_path)
    found = found_in(url, "block", seed=3)
    assert found.path is not None
    again = found_in(url, "block", seed=3)
    assert again.path is not None
    assert np.array_equal(found.path.poses, again.path.poses)
    assert again.motions == found.motions


@pytest.mark.parametrize("to", [None, shifted(np.array([0.2, 0.0, 0.0]))])
def test_extract_enclosed_names_blocker(tmp_path: Path, to: Any) -> None:  # noqa: ANN401
    found = found_in(enclosed(tmp_path), "block", motions=60, to=to)
    assert (found.verdict, found.path, found.is_planned) == ("no path found", None, True)
    assert [one.object.name for one in found.blockers] == ["cage"]
    assert found.blockers[0].pulls == found.pulls  # with the straight way to a pose
    assert "cage blocks" in extraction_line(found)
    assert found.motions <= 2 * 60


def test_extract_time_limit_of_planner(tmp_path: Path) -> None:
    """Without its end, ten million motions would take hours."""
    found = found_in(enclosed(tmp_path), "block", motions=10_000_000, seconds=1.0)
    assert found.path is None
    assert (found.verdict, found.verdict.exit_status) == ("not decided", 3)
    assert extraction_line(found).startswith("not decided: the time was over; no path found in")
    assert "give more --seconds" in extraction_line(found)


def test_extract_time_limit_of_sweeps(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each sweep takes all the time that it is given, a second at least, and decides nothing."""
    now = [0.0]

    def slow(*args: Any, seconds: float, **options: Any) -> Swept:  # noqa: ANN401
        now[0] += max(seconds, 1.0)
        return sweep(*args, seconds=1e-9, **options)

    monkeypatch.setattr("hapticdb.extraction.proof.sweep", slow)
    for module in ("proof", "pulls", "removal_search"):
        clock = SimpleNamespace(monotonic=lambda: now[0])
        monkeypatch.setattr(f"hapticdb.extraction.{module}.time", clock)
    found = found_in(lid(tmp_path, 0.03), "lid", motions=0, seconds=10.0)
    assert found.verdict == "not decided"
    assert now[0] <= 11.5
    assert (line := extraction_line(found)).startswith("not decided: a path, straight, ")
    assert line.count("not decided") == 1
    assert "give more --seconds: pot blocks" in line
    line = extraction_line(replace(found, path=None, is_planned=True, motions=1))
    assert "and 1 motion; give more" in line


def test_extract_missing_planner(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shadow_planner(tmp_path, monkeypatch, "raise ImportError('no planner')")
    url = enclosed(tmp_path)
    with pytest.raises(MissingExtraError, match=r"cage is in the way.*pip install .*ompl"):
        found_in(url, "block")
    assert found_in(url, "block", motions=0).verdict == "no path found"


def test_extract_planner_process_dies(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shadow_planner(tmp_path, monkeypatch, "import os\nos.kill(os.getpid(), 9)")
    with pytest.raises(hapticdb.errors.HapticDBError, match="planner's process has ended"):
        found_in(enclosed(tmp_path), "block")


# --- to a pose -----------------------------------------------------------------------------------


def test_extract_goal_pose_straight(tmp_path: Path) -> None:
    goal = trimesh.transformations.rotation_matrix(0.3, [0.0, 0.0, 1.0])
    goal[2, 3] = 0.05
    found = found_in(lid(tmp_path, 0.03), "lid", to=goal)
    assert found.path is not None
    assert (found.verdict, found.path.how, found.is_planned) == ("comes out", "pull", False)
    assert np.array_equal(found.path.poses, [np.eye(4), goal])
    assert extraction_line(found).startswith("reaches the pose straight, ")


def test_extract_goal_pose_planned(tmp_path: Path) -> None:
    """In the channel's arm along x, where no straight pull leads."""
    goal = shifted(np.array([0.15, 0.0, 0.265]))
    found = found_in(corner(tmp_path), "block", to=goal)
    assert found.path is not None
    assert (found.verdict, found.path.how) == ("comes out", "plan")
    assert np.allclose(found.path.poses[-1], goal, atol=1e-12)


def test_extract_goal_pose_in_bore(tmp_path: Path) -> None:
    """The pose is not free by voxels: a straight way back from it is."""
    with hapticdb.open(recessed(tmp_path, 0.0)) as env:
        (bolt,) = env.find("bolt")
        aside = shifted(np.array([0.06, 0.0, 0.03]))
        env.move(bolt.id, aside @ bolt.transform)
        found = extract(env, "bolt", to=np.linalg.inv(aside), seconds=500.0)
    assert found.path is not None
    assert (found.verdict, found.path.how) == ("comes out", "plan")
    assert np.allclose(found.path.poses[-1], np.linalg.inv(aside), atol=1e-12)


# --- wrong arguments -----------------------------------------------------------------------------


def test_extract_bad_arguments(tmp_path: Path) -> None:
    url = enclosed(tmp_path)
    with pytest.raises(ObjectNotFoundError, match="no object 'nut'"):
        found_in(url, "nut")
    for options, words in (
        ({"seconds": 0.0}, "seconds"),
        ({"seconds": float("nan")}, "seconds"),
        ({"seed": -1}, "seed -1"),
        ({"motions": -1}, "-1 motions"),
        ({"out": 0.0}, "out at"),
        ({"to": 2.0 * np.eye(4)}, "rigid"),
        ({"to": shifted(np.array([1e6, 0.0, 0.0]))}, "its unit"),
    ):
        with pytest.raises(UsageError, match=words):
            found_in(url, "block", **options)
    with hapticdb.open(url, read_only=True) as env:
        with pytest.raises(UsageError, match="nothing stands"):
            extract(env, "*")
        with pytest.raises(UsageError, match="at least one"):
            extract(env)


# --- geometry ------------------------------------------------------------------------------------

numbers = st.floats(-1.0, 1.0)
units = st.tuples(numbers, numbers, numbers).filter(lambda v: sum(x * x for x in v) > 0.01)


@given(units, units, st.floats(0.01, 1.0))
def test_exit_distances_of_spheres(
    way: tuple[float, float, float], center: tuple[float, float, float], radius: float
) -> None:
    """Out: the sphere is beyond a side of the box, [-1, 1] on each axis."""
    direction = np.array(way) / np.linalg.norm(way)
    leaving = Exit(-np.ones(3), np.ones(3), np.array(center), radius, None)
    length = float(leaving.distances(direction[None])[0])
    for share, is_out_there in ((1.0, True), (0.999, False)):
        middle = np.array(center) + share * length * direction
        gap = float((np.abs(middle) - 1.0).max())
        assert (gap >= radius - 1e-9) == is_out_there
        assert bool(leaving.is_out(share * length * direction[None])[0]) == is_out_there
