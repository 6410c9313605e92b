"""The kernels of sampling end in time."""

import numpy as np

from hapticdb.kernels.surfaces import blue_noise


def test_points_piled_upon_one_another_are_still_thinned_in_time() -> None:
    points = np.random.default_rng(0).random((4000, 3)) * 1e-3
    chosen = blue_noise.spread_points(
        points, np.zeros(4000, dtype=np.int32), np.array([[0.0, 0.0, 1.0]]), 400, 1.0
    )
    assert len(np.unique(chosen)) == 400
