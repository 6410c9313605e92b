"""What sweeps prove of L- and U-shaped parts, against coal's exact distance of the triangles."""

import os
from pathlib import Path

import numpy as np
import pytest

if "CI" not in os.environ:
    pytest.importorskip("coal", reason="make peers installs it")

from mesh_proofs import ExactMeshes, box_beside, bracket, clamp, sweep_meshes, windings
from moving_boxes import Boxes, apart
from tight_scenes import frame_of


def test_the_shapes_are_closed() -> None:
    rng = np.random.default_rng(0)
    for shape in (bracket, clamp):
        for slim in (False, True):
            made = shape(rng, slim=slim)
            assert made.is_watertight
            assert made.volume > 0.0


def test_what_lies_between_the_legs_of_a_clamp_is_not_inside() -> None:
    made = clamp(np.random.default_rng(1))
    legs = made.bounds[0] + 0.002
    assert windings(made.triangles, np.array([np.zeros(3), legs])) == pytest.approx([0.0, 1.0])


def test_coal_agrees_with_the_closed_form_of_boxes() -> None:
    rng = np.random.default_rng(3)
    tool, others = box_beside(rng), [box_beside(rng) for _ in range(4)]
    poses = np.tile(np.eye(4), (60, 1, 1))
    poses[:, :3, 3] = rng.uniform(-0.12, 0.12, (60, 3))
    for n, one in enumerate(others):
        one.apply_transform(poses[n])
    frames = [frame_of(one) for one in others]
    boxes = Boxes(*(np.stack(arrays) for arrays in zip(*frames, strict=True)))
    exact, holds = ExactMeshes(tool, others)(poses)
    expected, held = apart(frame_of(tool)[1], poses, boxes)
    assert (exact == 0.0).any()
    assert np.allclose(exact, expected.min(axis=1), atol=1e-9)
    is_apart = expected.min(axis=1) > 0.0
    assert np.array_equal(holds[is_apart], np.asarray(held.any(axis=1))[is_apart])


@pytest.mark.parametrize("seed", range(6))
def test_meshes_never_come_out_or_hit_falsely(tmp_path: Path, seed: int) -> None:
    """Forty tight trials; half of the scenes have stored distances."""
    told = sweep_meshes(tmp_path, seed, 40, stored=seed % 2 == 0)
    assert min(told["comes out"], told["hits"]) >= 2
