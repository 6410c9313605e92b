"""Orders of disassembly of boxes, known by construction; exact boxes say that paths are free."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hapticdb
from disassembly_scenes import CHAIN, STACK, WINDOW, Scene, held_by_a_head, least_gap, made
from extraction_scenes import corner, lid, shadow_planner
from hapticdb import Disassembly, disassemble
from hapticdb.errors import MissingExtraError
from hapticdb.extraction.verdict import disassembly_line, failed_line


def found_in(url: Path, *parts: str, motions: int = 0, **options: Any) -> Disassembly:  # noqa: ANN401
    with hapticdb.open(url, read_only=True) as env:
        return disassemble(env, *parts, motions=motions, **options)


def order(found: Disassembly) -> list[str]:
    return [obj.name for step in found.steps for obj in step.found.parts]


def assert_free(scene: Scene, found: Disassembly, gone: tuple[str, ...] = ()) -> None:
    """Each step's boxes meet no box of what stands, and the steps leave the right things out."""
    left = {name: boxes for name, boxes in scene.items() if name not in gone}
    ids = {name: n for n, name in enumerate(sorted(scene))}
    assert len(ids) == len(scene)
    for step in found.steps:
        way, (part,) = step.found.path, step.found.parts
        assert way is not None
        assert step.found.verdict == "comes out"
        assert np.allclose(way.poses[:, :3, :3], np.eye(3))
        boxes = left.pop(part.name)
        shifts = np.concatenate(
            [np.linspace(a, b, 300) for a, b in zip(way.poses, way.poses[1:], strict=False)]
        )[:, :3, 3]
        assert least_gap(boxes, [one for some in left.values() for one in some], shifts) > 0.0
        assert len(step.excluded) == len(scene) - len(left)


def test_disassemble_stack_top_first(tmp_path: Path) -> None:
    found = found_in(made(tmp_path, STACK), "content", keep=["pot"])
    assert order(found) == ["weight", "lid", "content"]
    assert (found.is_found, found.verdict, found.is_out_of_time) == (True, "comes out", False)
    assert_free(STACK, found)
    assert disassembly_line(found).startswith("after weight, lid: comes out straight, ")


@pytest.mark.long
def test_disassemble_excluded_objects_stay(tmp_path: Path) -> None:
    found = found_in(made(tmp_path, STACK), "content", exclude=["weight"], keep=["pot"])
    assert order(found) == ["lid", "content"]
    assert_free(STACK, found, gone=("weight",))


def test_disassemble_chain_links_no_order(tmp_path: Path) -> None:
    found = found_in(made(tmp_path, CHAIN), "left")
    assert (found.is_found, found.verdict, found.steps) == (False, "no order found", ())
    assert [one.object.name for one in found.blockers] == ["right"]
    assert [[obj.name for obj in one.parts] for one in found.failed] == [["left"], ["right"]]
    assert disassembly_line(found) == "no order found in 2 searches: blocked by right"
    assert failed_line(found.failed[1]) == "no path found: blocked by left"


def test_disassemble_free_part_no_steps(tmp_path: Path) -> None:
    found = found_in(made(tmp_path, STACK), "weight")
    assert (order(found), found.failed) == (["weight"], ())
    assert disassembly_line(found).startswith("nothing goes before: comes out straight")


@pytest.mark.long
def test_disassemble_drops_useless_step(tmp_path: Path) -> None:
    found = found_in(made(tmp_path, WINDOW), "content", keep=["pot"])
    assert max(one.n_gone for one in found.failed) == 1  # the rod was off, and that did not help
    assert order(found) == ["lid", "content"]
    assert_free(WINDOW, found)


@pytest.mark.long
def test_disassemble_depth_limit(tmp_path: Path) -> None:
    found = found_in(made(tmp_path, STACK), "content", depth=1, keep=["pot"])
    assert not found.is_found
    assert "weight" not in {obj.name for one in found.failed for obj in one.parts}


def test_disassemble_time_limit(tmp_path: Path) -> None:
    found = found_in(made(tmp_path, STACK), "content", seconds=1e-6)
    assert (found.is_found, found.is_out_of_time) == (False, True)
    assert found.verdict == "not decided"
    assert len(found.failed) == 1
    assert "the time is over" in disassembly_line(found)


def test_disassemble_sliding_part(tmp_path: Path) -> None:
    found = found_in(lid(tmp_path, 0.0), "lid")
    assert (found.is_found, found.verdict) == (True, "comes out")


def test_disassemble_last_object_stays(tmp_path: Path) -> None:
    """Of two bodies, each comes out of the other, or neither does."""
    found = found_in(corner(tmp_path), "block")
    assert not found.is_found
    assert found.failed[1].verdict is None
    assert "last object" in failed_line(found.failed[1])


@pytest.mark.long
def test_disassemble_without_planner(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shadow_planner(tmp_path, monkeypatch, "raise ImportError('no planner')")
    url = made(tmp_path, STACK)
    assert order(found_in(url, "lid", motions=100, keep=["pot"])) == ["weight", "lid"]
    (tmp_path / "chain").mkdir()
    with pytest.raises(MissingExtraError, match=r"pip install .*ompl"):
        found_in(made(tmp_path / "chain", CHAIN), "left", motions=100)


@pytest.mark.long
def test_disassemble_bolt_before_plate(tmp_path: Path) -> None:
    """A small bolt's head is a tenth of the contacts: the pull alone would cut through it."""
    found = found_in(made(tmp_path, held_by_a_head()), "plate", keep=["base"])
    assert order(found) == ["bolt", "plate"]
    assert (found.verdict, len(found.failed)) == ("comes out", 1)
    assert [one.object.name for one in found.failed[0].blockers][:1] == ["bolt"]
