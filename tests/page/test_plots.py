"""Plots of the tab Touch always show the same range of time."""

import numpy as np

from hapticdb.page.panels.touch import SECONDS, last_seconds


def test_a_short_history_is_preceded_by_zeros() -> None:
    rows = last_seconds(np.array([[3.0, 1.0, 0.1], [4.0, 2.0, 0.2]]))
    expected = [[-SECONDS, 0.0, 0.0], [-1.0, 0.0, 0.0], [-1.0, 1.0, 0.1], [0.0, 2.0, 0.2]]
    np.testing.assert_allclose(rows, expected)


def test_a_long_history_is_cut() -> None:
    history = np.column_stack([np.arange(0.0, 100.0, 3.0), np.ones(34), np.ones(34)])
    rows = last_seconds(history)
    assert rows[0, 0] == -SECONDS
    assert rows[-1, 0] == 0.0
    assert (np.diff(rows[:, 0]) >= 0.0).all()
    assert rows[1:, 0].min() == -9.0
