"""Placements taken apart give the placement again, and equal stretches for turned parts."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hapticdb.page.scene.contents import motion
from hapticdb.page.scene.rigid import taken_apart

SEEDS = st.integers(0, 2**32)


def placement(rng: np.random.Generator) -> np.ndarray:
    found = np.eye(4)
    found[:3] = rng.normal(size=(3, 4))
    return found


def rigid(rng: np.random.Generator) -> np.ndarray:
    found = np.eye(4)
    found[:3, :3] = Rotation.random(random_state=rng).as_matrix()
    found[:3, 3] = rng.normal(size=3)
    return found


@given(SEEDS)
def test_pose_and_stretch_give_the_placement(seed: int) -> None:
    placed = placement(np.random.default_rng(seed))
    pose, stretch = taken_apart(placed)
    assert np.allclose(pose[:3, :3] @ stretch, placed[:3, :3])
    assert np.allclose(pose[:3, 3], placed[:3, 3])
    assert np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3))
    assert np.linalg.det(pose[:3, :3]) > 0


@given(SEEDS)
def test_a_part_that_is_only_moved_keeps_its_stretch(seed: int) -> None:
    rng = np.random.default_rng(seed)
    placed = placement(rng)
    moved = rigid(rng) @ placed
    assert taken_apart(placed).key == taken_apart(moved).key
    assert np.allclose(motion(placed, moved) @ placed, moved)


def test_a_scaled_part_has_another_stretch() -> None:
    placed = np.eye(4)
    larger, mirrored = np.diag([1.001, 1.001, 1.001, 1.0]), np.diag([1.0, -1.0, 1.0, 1.0])
    keys = {taken_apart(p).key for p in (placed, larger, mirrored)}
    assert len(keys) == 3
