"""Parts that no straight pull frees: out of contact first, then past what blocks."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from extraction_scenes import bayonet, found_in, grounded, is_out, ledge, pocket, solids
from hapticdb import Extraction

Floats = NDArray[np.float64]

DEEP = 1e-4
"""How deep a part may get into what it touches: twice the contact tolerance, metres."""


def poses_of(found: Extraction) -> Floats:
    """Poses (n, 4, 4) all along the path."""
    assert found.path is not None
    path = found.path.swept.path
    return np.asarray(path.at(np.linspace(0.0, path.length, 400)))


def places_in_boxes(found: Extraction, url: Path, part: str, inset: float) -> int:
    """Number of places in the part, `inset` from its surface or more, that are in a box on the way.

    The part is a box itself, so its places are a grid, and a place is in a box by its coordinates.
    """
    low, high = found.shell.points.min(axis=0) + inset, found.shell.points.max(axis=0) - inset
    axes = [np.linspace(a, b, 7) for a, b in zip(low, high, strict=True)]
    places = np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
    boxes, n = solids(url, part), 0
    for pose in poses_of(found):
        placed = places @ pose[:3, :3].T + pose[:3, 3]
        n += int(((placed[:, None] > boxes[:, 0]) & (placed[:, None] < boxes[:, 1])).all(-1).sum())
    return n


def turn_of(poses: Floats) -> Floats:
    """Angles (n,) of displacements (n, 4, 4), radians."""
    traces = np.trace(poses[:, :3, :3], axis1=1, axis2=2)
    return np.asarray(np.arccos(np.clip(0.5 * (traces - 1.0), -1.0, 1.0)))


# --- scenes whose ways are known by construction --------------------------------------------------


def test_extract_pocket_lift_then_pull(tmp_path: Path) -> None:
    url = pocket(tmp_path)
    found = found_in(url, "block")
    assert (found.verdict, found.pulls) == ("comes out", found.blockers[0].pulls)
    assert is_out(found, url)
    assert places_in_boxes(found, url, "block", DEEP) == 0


@pytest.mark.long
def test_extract_ledge_slide_then_lift(tmp_path: Path) -> None:
    url = ledge(tmp_path)
    found = found_in(url, "plate")
    assert (found.verdict, found.is_planned) == ("comes out", True)
    assert [obj.name for obj in found.near] == ["base"]
    assert is_out(found, url)
    assert places_in_boxes(found, url, "plate", DEEP) == 0
    shifts = poses_of(found)[:, :3, 3]
    lifted = shifts[:, 2] > 0.01
    assert (shifts[lifted, 0] > 0.02).all()  # the ledge covers 0.02 m


@pytest.mark.long
def test_extract_bayonet_turn_then_lift(tmp_path: Path) -> None:
    url = bayonet(tmp_path)
    found = found_in(url, "bar")
    assert found.verdict == "comes out"
    assert is_out(found, url)
    assert places_in_boxes(found, url, "bar", DEEP) == 0
    poses = poses_of(found)
    passing = (poses[:, 2, 3] > 0.01) & (poses[:, 2, 3] < 0.03)
    assert passing.any()
    assert (turn_of(poses[passing]) > 1.0).all()


def test_extract_pull_through_contact_refused(tmp_path: Path) -> None:
    """The part has fewer hits while it passes a thin wall than at its start."""
    found = found_in(ledge(tmp_path), "plate", motions=0)
    assert found.path is None
    assert found.blockers[0].pulls == found.pulls


@pytest.mark.long
def test_extract_block_on_floor_of_closed_box(tmp_path: Path) -> None:
    found = found_in(grounded(tmp_path), "block", motions=200)
    assert (found.verdict, found.is_planned) == ("no path found", True)
    assert [one.object.name for one in found.blockers] == ["cage"]
    assert 0 < found.motions <= 2 * 200
