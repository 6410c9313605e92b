"""The kernels of sampling, compared with slow, plain versions."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hapticdb.kernels.surfaces import sampling


@given(seed=st.integers(0, 2**32), n_keep=st.integers(20, 50))
@settings(max_examples=15, deadline=None)
def test_elimination_drops_the_most_crowded_every_time(seed: int, n_keep: int) -> None:
    rng = np.random.default_rng(seed)
    points = np.concatenate((rng.random((80, 2)), np.zeros((80, 1))), axis=1)
    face_of = rng.integers(0, 2, 80).astype(np.int32)
    normals = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    reach = 0.6  # each point has many neighbours: two with only each other would have equal weights
    nearest = reach * (1.0 - (n_keep / 80) ** 1.5) * 0.65
    scale = np.where(face_of[:, None] == face_of, 1.0, 0.35)
    distances = np.linalg.norm(points[:, None] - points, axis=2)
    weights = np.maximum(1.0 - np.maximum(distances, nearest * scale) / (reach * scale), 0.0) ** 8
    np.fill_diagonal(weights, 0.0)
    alive = np.ones(80, dtype=bool)
    while alive.sum() > n_keep:
        load = np.where(alive, weights @ alive, -1.0)
        if load.max() < 1e-12:
            return  # no candidate is crowded: any of them may be dropped
        alive[np.argmax(load)] = False
    chosen = sampling.spread_points(points, face_of, normals, n_keep, reach)
    assert np.array_equal(chosen, np.flatnonzero(alive))


def test_points_piled_upon_one_another_are_still_thinned_in_time() -> None:
    points = np.random.default_rng(0).random((4000, 3)) * 1e-3
    chosen = sampling.spread_points(
        points, np.zeros(4000, dtype=np.int32), np.array([[0.0, 0.0, 1.0]]), 400, 1.0
    )
    assert len(np.unique(chosen)) == 400
