"""The kernels of sampling end in time."""

import numpy as np

from hapticdb.kernels.surfaces import blue_noise


def test_spread_points_coincident_points_terminate() -> None:
    points = np.random.default_rng(0).random((4000, 3)) * 1e-3
    chosen = blue_noise.spread_points(
        points, np.zeros(4000, dtype=np.int32), np.array([[0.0, 0.0, 1.0]]), 400, 1.0
    )
    assert len(np.unique(chosen)) == 400
