"""Sweeps that start in contact, against closed forms; lengths in millimetres."""

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

import hapticdb
from contact_scenes import (
    BLOCK,
    CONTACT,
    LABEL,
    MM,
    PULLS,
    REACH,
    SMALL,
    SUNK,
    TIN,
    Pull,
    box,
    frame_of,
    imported,
    in_frame,
    placed,
    pulls,
    rod,
    swept,
)
from hapticdb import Environment, PointShell
from hapticdb.exact.swept import Swept

FRAMES = (0, 1, 2)
"""Seeds of the frames in which each scene stands; 0: as it is written."""
SCENES = {pull.name: pull for pull in PULLS}
SEATED = [pull.name for pull in PULLS if pull.name != "buried tool"]
"""What stands deep in a plate is freed or not by its box, which a frame changes."""
FREE = {"clear", "slides"}
GPU_QUERY = 0.03
"""Millimetres of the path by which a hit may be told later than it is met."""


def named(pull: Pull, seed: int) -> str:
    return f"{seed}_{PULLS.index(pull)}"


@pytest.fixture(scope="module")
def env(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Environment]:
    """The objects of all scenes, in each frame."""
    surfaces = {
        named(pull, seed): placed(pull.object, frame_of(seed)) for seed in FRAMES for pull in PULLS
    }
    with imported(tmp_path_factory.mktemp("scenes") / "all.db", surfaces) as made:
        yield made


def found_in(env: Environment, pull: Pull, seed: int, **options: Any) -> Swept:  # noqa: ANN401 - of a sweep
    frame = frame_of(seed)
    return swept(
        env, placed(pull.tool, frame), in_frame(pull.poses, frame), [named(pull, seed)],
        contact=pull.contact, **options,
    )  # fmt: skip


def first_hit(found: Swept) -> float:
    """Millimetres of the path before the first hit; 0 where one lies inside the other."""
    if found.enclosed or not found.hits:
        return 0.0
    return found.hits[0].fraction * found.path.length / MM


def outcome(found: Swept) -> str:
    return "free" if found.verdict in FREE else found.verdict


@pytest.mark.parametrize("seed", FRAMES)
@pytest.mark.parametrize("name", SEATED)
def test_sweep_seated_part_closed_forms(env: Environment, name: str, seed: int) -> None:
    """The proved depth is never more than the motion that frees, and both fit the scene."""
    pull = SCENES[name]
    found = found_in(env, pull, seed)
    assert outcome(found) == pull.expected
    assert found.is_free == (pull.expected != "hits")
    touching: tuple[Any, ...] = found.touching
    for one in touching:
        if np.isfinite(one.start):  # infinite where nothing frees
            assert one.start_at_least <= one.start * (1.0 + 1e-6)
            assert one.start / MM <= max(pull.start, REACH + pull.contact - CONTACT)
    if pull.expected == "hits":
        assert pull.after <= first_hit(found) <= pull.by + GPU_QUERY


@pytest.mark.parametrize("seed", FRAMES)
@pytest.mark.parametrize("name", SCENES)
def test_sweep_foreign_tool_overlap_is_hit(env: Environment, name: str, seed: int) -> None:
    """What overlaps at the start by more than the tolerance is hit there; all else is the same."""
    pull = SCENES[name]
    found = found_in(env, pull, seed, seated=False, overlap=MM * 100.0)
    assert outcome(found) == ("hits" if pull.start else pull.expected)
    if pull.start:
        assert first_hit(found) == 0.0
    assert found.gap.at_least == 0.0 or outcome(found) != "hits"


@pytest.mark.parametrize("seed", FRAMES)
@pytest.mark.parametrize("name", [p.name for p in PULLS if p.expected == "overlaps"])
def test_sweep_accepted_overlap_is_clear(env: Environment, name: str, seed: int) -> None:
    pull = SCENES[name]
    told = found_in(env, pull, seed)
    start = told.touching[0].start
    assert CONTACT < start / MM <= pull.start
    assert found_in(env, pull, seed, overlap=1.01 * start).verdict in FREE
    assert found_in(env, pull, seed, overlap=0.9 * start).verdict not in FREE


def test_sweep_hood_seam_depth(env: Environment) -> None:
    """The seam's depth is known from below and from above, where both are closed."""
    seam: Any
    (seam,) = found_in(env, SCENES["hood in its seam, up"], 0).touching
    assert seam.start_at_least == pytest.approx(2.0 * MM, rel=0.03)
    assert seam.start == pytest.approx(2.0 * MM, rel=0.06)


def test_sweep_peg_touches_until_out_of_bore(env: Environment) -> None:
    for seed in FRAMES:
        found = found_in(env, SCENES["coarse peg, out"], seed)
        (one,) = found.touching
        assert found.verdict == "slides"
        assert one.until * 25.0 == pytest.approx(20.1, abs=0.15)


def test_sweep_tool_inside_solid_is_hit(env: Environment) -> None:
    """Its gap to the face is below the tolerance, at it, and far above."""
    solid = [named(SCENES["inside"], 0)]
    for gap in (1e-4, 0.02, 0.05, 0.3, 5.0):
        cube = box((5, 5, 5), (0, 0, 17.5 - gap))
        for seated in (False, True):
            for poses in (pulls(), pulls((0, 0, -1)), pulls((0, 0, 30)), pulls((3, 0, 0))):
                assert swept(env, cube, poses, solid, seated=seated).verdict == "hits", gap


def test_sweep_object_inside_tool_is_hit(env: Environment) -> None:
    """The object is inside the tool, near its face."""
    label = named(SCENES["sunk plate, rests"], 0)
    for gap in (0.02, 2.0):
        around = box((40, 40, 2 + gap), (0, 0, 0.5 - 0.5 * gap))
        assert swept(env, around, pulls((0, 0, -0.2)), [label]).verdict == "hits", gap


def test_sweep_contacts_judged_per_object(env: Environment) -> None:
    """Each is judged by itself: one free contact does not excuse another."""
    groove, base = named(SCENES["cube in a groove"], 0), named(SCENES["sunk plate, in"], 0)
    cube = box((5, 5, 5), (12.0, 0, 3.0))  # 0.5 above the floor, flush with the wall and the plate
    found = swept(env, cube, pulls((0, 20, 0)), [groove, base])
    assert outcome(found) == "free"
    found = swept(env, cube, pulls((3, 0, 0)), [groove, base])
    assert [hit.object.name for hit in found.hits] == [groove]
    found = swept(env, cube, pulls((0, 0, -0.3)), [groove, base])
    assert [hit.object.name for hit in found.hits] == [base]


def test_sweep_reentry_is_hit(env: Environment) -> None:
    """A label that is lifted from the floor of its tin, and pushed down beside."""
    tin = [named(SCENES["label, down"], 0)]
    found = swept(env, LABEL, pulls((0, 0, 5), (5, 0, 5), (5, 0, -6)), tin)
    assert found.verdict == "hits"
    assert 14.9 <= first_hit(found) <= 15.1
    found = swept(env, LABEL, pulls((0, 0, 5), (5, 0, 5), (5, 0, 0.1)), tin)
    assert outcome(found) == "free"


def test_sweep_sheet_hit_for_any_path_length(env: Environment) -> None:
    """Looks at shares of the path may find it apart on the other side, by less than the reach."""
    sheet = [named(SCENES["sheet through sheet"], 0)]
    for length in np.geomspace(0.1, 40.0, 20):
        found = swept(env, SMALL, pulls((0, 0, -length)), sheet)
        assert found.verdict == "hits", length
        assert first_hit(found) <= 0.1


def test_sweep_ball_tool_contact(env: Environment) -> None:
    """A ball tool of radius 3 that stands on the block, or 0.03 or 1 in it."""
    block = [named(SCENES["shim"], 0)]
    cases = ((0.0, False, "free"), (0.03, False, "free"), (1.0, False, "hits"),
             (0.01, True, "free"), (0.03, True, "free"), (1.0, True, "overlaps"))  # fmt: skip
    for sunk, seated, expected in cases:
        ball = PointShell.sphere(3.0 * MM)
        up = pulls((0, 0, 10)) + np.array([[0, 0, 0, 1], [0, 0, 0, 2], [0, 0, 0, 3.0 - sunk],
                                           [0, 0, 0, 0]])  # fmt: skip
        assert outcome(swept(env, ball, up, block, seated=seated)) == expected, (sunk, seated)
        down = up.copy()
        down[1, 2, 3] = up[0, 2, 3] - 2.0
        found = swept(env, ball, down, block, seated=seated)
        assert found.verdict == "hits", (sunk, seated)
        assert first_hit(found) <= 0.2


def test_sweep_two_body_tool(env: Environment) -> None:
    """One rests flush on the block, the other stands free: off, along, and in."""
    both = np.concatenate([box((5, 5, 5), (0, 0, 2.5)), rod(1, 4, 12, (8, 0, 3.0))])
    block = [named(SCENES["shim"], 0)]
    for to, expected in (((0, 0, 9), "free"), ((4, 4, 0), "free"), ((0, 0, -1), "hits")):
        assert outcome(swept(env, both, pulls(to), block)) == expected


def test_extract_closed_tin_no_path(tmp_path_factory: pytest.TempPathFactory) -> None:
    folder = tmp_path_factory.mktemp("tin")
    with imported(folder / "tin.db", {"tin": TIN, "label": LABEL}) as env:
        found = hapticdb.extract(env, "label", seconds=5.0, motions=100)
    assert found.path is None or not found.is_free
    assert found.verdict != "comes out"


def test_extract_part_overlapping_its_support(
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    """A plate that stands 0.3 in the block, at its rim as in its middle."""
    folder = tmp_path_factory.mktemp("seat")
    plate = box((10, 10, 1), (0, 0, 0.2))
    with imported(folder / "seat.db", {"block": BLOCK, "plate": plate}) as env:
        found = hapticdb.extract(env, "plate", seconds=20.0)
        assert found.is_free
        assert str(found.verdict) == "overlaps"
    with imported(folder / "sunk.db", {"block": BLOCK, "plate": SUNK - [0, 0, 0.5]}) as env:
        found = hapticdb.extract(env, "plate", seconds=20.0)
        assert found.is_free
        assert str(found.verdict) != "overlaps"
