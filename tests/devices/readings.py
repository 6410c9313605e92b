"""Readings as faulty and unusual devices return them."""

from collections.abc import Callable
from typing import Any

import numpy as np

from hapticdb.devices.protocol import Reading

Change = Callable[[Any], object]

# changes of a reading, and the error text for each
FAULTS: list[tuple[Change, str]] = [
    (lambda r: r._replace(pose=np.eye(3)), r"a pose that is an array \(3, 3\) of float64"),
    (lambda r: r._replace(pose=np.eye(4)[None]), r"a pose that is an array \(1, 4, 4\) of float64"),
    (lambda r: r._replace(pose=np.eye(4).tolist()), "a pose that is of the type list"),
    (lambda r: r._replace(pose=None), "a pose that is None"),
    (lambda r: r._replace(pose=np.eye(4) + 0j), r"a pose that is an array .* of complex128"),
    (lambda r: r._replace(pose=np.eye(4).astype(object)), "a pose that is an array .* of object"),
    (lambda r: r._replace(pose=np.eye(4).astype(str)), "a pose that is an array .* of <U32"),
    (lambda r: r._replace(pose=np.eye(4) > 0), r"a pose that is an array \(4, 4\) of bool"),
    (lambda r: r._replace(pose=np.ma.array(np.eye(4))), r"a pose that is a masked array \(4, 4\)"),
    (lambda r: r._replace(velocity=np.zeros(3)), r"a velocity that is an array \(3,\) of float64"),
    (lambda r: r._replace(velocity=np.zeros((6, 1))), r"a velocity that is an array \(6, 1\)"),
    (lambda r: r._replace(velocity=0.0), "a velocity that is of the type float"),
    (lambda r: r._replace(velocity=[0.0] * 6), "a velocity that is of the type list"),
    (lambda r: r._replace(buttons=None), "buttons that are None"),
    (lambda r: r._replace(buttons=1.0), "buttons that are of the type float"),
    (lambda r: r._replace(buttons=-1), "buttons that are -1"),
    (lambda r: r._replace(buttons=1 << 31), "buttons that are 2147483648"),
    (lambda _: None, "None"),
    (tuple, "of the type tuple"),
    (lambda r: (*r, 0), "of the type tuple"),
    (lambda r: r.pose, r"an array \(4, 4\) of float64"),
]


def placed(reading: Reading, row: int, column: int, value: float) -> Reading:
    """The reading with one number of its pose replaced."""
    pose = reading.pose.copy()
    pose[row, column] = value
    return reading._replace(pose=pose)


def turned(reading: Reading, factor: float) -> Reading:
    """The reading with its rotation multiplied by a factor."""
    pose = reading.pose.copy()
    pose[:3, :3] *= factor
    return reading._replace(pose=pose)


MOMENTS: list[tuple[Change, str]] = [
    (lambda r: placed(r, 0, 3, np.nan), "numbers that are not finite"),
    (lambda r: placed(r, 1, 1, np.inf), "numbers that are not finite"),
    (lambda r: r._replace(velocity=np.full(6, np.nan)), "numbers that are not finite"),
    (lambda r: placed(r, 2, 3, 1e7), r"numbers beyond 1e\+06"),
    (lambda r: r._replace(velocity=np.full(6, -1e7)), r"numbers beyond 1e\+06"),
    (lambda r: turned(r, 1.01), "a pose that is no rigid transform"),
    (lambda r: turned(r, -1.0), "a pose that is no rigid transform"),
    (lambda r: turned(r, 0.0), "a pose that is no rigid transform"),
    (lambda r: placed(r, 0, 1, 0.1), "a pose that is no rigid transform"),
    (lambda r: placed(r, 3, 0, 1.0), "a pose that is no rigid transform"),
]


def unwritable(reading: Reading) -> Reading:
    """The reading with read-only arrays."""
    pose, velocity = reading.pose.copy(), reading.velocity.copy()
    pose.flags.writeable = velocity.flags.writeable = False
    return reading._replace(pose=pose, velocity=velocity)


FORMS: list[Change] = [
    lambda r: r._replace(pose=np.asfortranarray(r.pose)),
    lambda r: r._replace(pose=np.tile(r.pose, (2, 2))[4:, 4:], velocity=np.zeros(12)[::2]),
    lambda r: r._replace(pose=r.pose.astype(np.float32), velocity=r.velocity.astype(np.float32)),
    lambda r: r._replace(pose=r.pose.astype(">f8")),
    lambda r: r._replace(velocity=np.zeros(6, dtype=np.int64)),
    lambda r: turned(r, 1.0 + 1e-4),
    lambda r: r._replace(buttons=np.int32(0)),
    lambda r: r._replace(buttons=False),
    unwritable,
]
