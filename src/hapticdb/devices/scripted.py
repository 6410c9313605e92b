"""Scripted devices, without hardware; `hapticdb.devices.protocol` defines a device.

They read the time from a clock and start at their first read. Every read writes into the same
arrays, so a reading is valid only until the next read.
"""

import math
import os
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.devices.profiles import SCRIPTED
from hapticdb.devices.protocol import Reading
from hapticdb.errors import UsageError
from hapticdb.kernels.hand_motion import play, survey, sway
from hapticdb.poses import quaternion_of, read_timed_poses

Clock = Callable[[], float]
"""Seconds since some fixed instant, monotonic."""

CYCLE = 20.0
"""Period of `RandomHand`, s; its frequencies are multiples of 1 / CYCLE."""

SLOWEST, FASTEST = 0.3, 8.0
"""Lowest and highest frequency, Hz, of the motion of a `RandomHand`."""


def capped(wrench: NDArray[np.float64], force: float, torque: float) -> NDArray[np.float64]:
    """Copy of a wrench (6,) with force and torque shortened to the caps (N, N m).

    Directions are preserved. A force or torque that is not finite becomes zero, so no motor
    receives it.
    """
    fx, fy, fz, tx, ty, tz = wrench.tolist()
    f, t = math.hypot(fx, fy, fz), math.hypot(tx, ty, tz)
    out = wrench.copy()
    if not f <= force:
        out[:3] = out[:3] * (force / f) if math.isfinite(f) else 0.0
    if not t <= torque:
        out[3:] = out[3:] * (torque / t) if math.isfinite(t) else 0.0
    return out


def pose_at(place: ArrayLike) -> NDArray[np.float64]:
    """Pose (4, 4): a pose unchanged, or the hand upright at a point (3,)."""
    given = np.array(place, dtype=np.float64)
    if given.shape not in {(3,), (4, 4)} or not np.isfinite(given).all():
        raise UsageError(
            f"a place is a point (3,) or a pose (4, 4) of finite numbers, not {given.tolist()}"
        )
    if given.shape == (4, 4):
        return given
    pose = np.eye(4)
    pose[:3, 3] = given
    return pose


def _positive(name: str, value: float) -> float:
    if not (value > 0.0 and math.isfinite(value)):
        raise UsageError(f"{name} must be a positive number, not {value}")
    return float(value)


class _Scripted:
    """A device that needs no hardware and ignores the wrench."""

    is_over = False
    profile = SCRIPTED

    def __init__(self, clock: Clock) -> None:
        self.clock = clock
        self._start: float | None = None
        self._pose = np.eye(4)
        self._velocity = np.zeros(6)
        self._reading = Reading(self._pose, self._velocity, 0)

    def rewind(self) -> None:
        """Restart the script at the next read."""
        self._start = None

    def _elapsed(self) -> float:
        """Seconds since the first read."""
        now = self.clock()
        if self._start is None:
            self._start = now
        return now - self._start

    def apply(self, wrench: NDArray[np.float64]) -> None:
        """Ignore the wrench: the hand follows its script."""


class Player(_Scripted):
    """A hand that follows timed poses, interpolated linearly, rotations by slerp.

    times (M,) : seconds, increasing; the first is the instant of the first read; poses (M, 4, 4) :
    rigid, metres; their differences give the velocity; loops : start again at the end, smoothly if
    the path ends at its start, instead of a rest there; clock : seconds, picklable.
    """

    def __init__(
        self, times: ArrayLike, poses: ArrayLike, *, loops: bool = False,
        clock: Clock = time.perf_counter,
    ) -> None:  # fmt: skip
        super().__init__(clock)
        when = np.array(times, dtype=np.float64)
        where = np.array(poses, dtype=np.float64)
        if where.ndim != 3 or where.shape[1:] != (4, 4) or when.shape != where.shape[:1]:
            raise UsageError(f"times (M,) and poses (M, 4, 4), not {when.shape} and {where.shape}")
        if not len(when) or not np.isfinite(when).all() or not np.isfinite(where).all():
            raise UsageError("a path needs a pose at least, and finite numbers")
        if (np.diff(when) <= 0.0).any():
            raise UsageError("the times of a path must increase")
        if len(when) == 1:
            when, where = np.array([0.0, 1e-9]), np.concatenate([where, where])
        self.duration = float(when[-1] - when[0])
        self.loops = loops
        self._knots = np.column_stack(
            [when - when[0], where[:, :3, 3], quaternion_of(where[:, :3, :3])]
        )

    def read(self) -> Reading:
        """Return pose and velocity now."""
        elapsed = self._elapsed()
        if self.loops:
            elapsed %= self.duration
        else:
            self.is_over = elapsed >= self.duration
        play(elapsed, self._knots, self._pose, self._velocity)
        return self._reading


class Path(Player):
    """A hand that follows the poses of a file (`hapticdb.read_poses`).

    path : with times in a column ``t``, used unless `speed` is given; speed : metres a second; 0.1
    if the file gives no time. A turn counts as the arc length of a point 0.1 m from the origin;
    successive equal poses count once. loops, clock : as for `Player`.

    Raises `FileError` if the file cannot be read.
    """

    def __init__(
        self, path: str | os.PathLike[str], *, speed: float | None = None, loops: bool = False,
        clock: Clock = time.perf_counter,
    ) -> None:  # fmt: skip
        times, poses = read_timed_poses(path)
        self.assumed_speed = 0.1 if times is None and speed is None else None
        """Assumed speed, m/s, without times in the file and without `speed`; else None."""
        if times is None or speed is not None:
            times, poses = _times_at(poses, _positive("speed", self.assumed_speed or speed or 0.0))
        super().__init__(times, poses, loops=loops, clock=clock)


def _times_at(
    poses: NDArray[np.float64], speed: float
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Times of the poses at a given speed, and the poses without repetitions."""
    q = quaternion_of(poses[:, :3, :3])
    # chord to q or -q, whichever is nearer; exact for small turns, where acos is not
    chord = np.minimum(
        np.linalg.norm(q[1:] - q[:-1], axis=1), np.linalg.norm(q[1:] + q[:-1], axis=1)
    )
    turns = 4.0 * np.arcsin(np.minimum(0.5 * chord, 1.0))
    moves = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    lengths = np.maximum(moves, 0.1 * turns)  # lever of 0.1 m
    kept = np.concatenate([[True], lengths > 1e-12])
    return np.concatenate([[0.0], np.cumsum(lengths[kept[1:]])]) / speed, poses[kept]


class RandomHand(_Scripted):
    """Smooth random motion about a center, like a hand's; equal seeds give equal motions.

    Each axis is a sum of sines between 0.3 and 8 Hz with amplitudes proportional to 1 / f^2. All
    frequencies are multiples of one, and the motion repeats after 20 s. It starts at the center.
    Slow waves that would carry the hand beyond its reach are omitted.

    center : point (3,) or pose (4, 4), metres; speed, angular_speed : greatest ones in a cycle, m/s
    and rad/s, exact to 0.1 %; reach : greatest distance from the center, metres; clock : as for
    `Player`.

    Raises `UsageError` if no motion below 8 Hz is that fast within the reach.
    """

    def __init__(
        self, center: ArrayLike, seed: int = 0, speed: float = 0.3, angular_speed: float = 1.5,
        reach: float = 0.3, *, clock: Clock = time.perf_counter,
    ) -> None:  # fmt: skip
        super().__init__(clock)
        self._center = pose_at(center)
        given = {"speed": speed, "angular_speed": angular_speed, "reach": reach}
        self._waves = _random_waves(seed, *(_positive(name, n) for name, n in given.items()))

    def read(self) -> Reading:
        """Pose and velocity now."""
        sway(self._elapsed(), self._waves, self._center, self._pose, self._velocity)
        return self._reading


N_WAVES = 8
"""Sines on each axis of a `RandomHand`. Larger: a more irregular motion, slower reads."""
N_SAMPLES = 16384
"""Samples of a cycle for its speed and reach. Larger: more exact, slower to make."""


def _random_waves(
    seed: int, speed: float, angular_speed: float, reach: float
) -> NDArray[np.float64]:
    """Waves (6, 8, 4) for the kernel `sway`."""
    slowest = SLOWEST
    while slowest < FASTEST:
        waves = _waves_above(slowest, seed)
        farthest, fastest, _ = survey(waves, CYCLE, N_SAMPLES)
        if farthest * speed <= reach * fastest:
            waves[:3, :, 0] *= speed / fastest
            # rotations do not add: doubled waves do not give exactly twice the angular velocity
            for _ in range(20):
                turning = survey(waves, CYCLE, N_SAMPLES)[2]
                waves[3:, :, 0] *= angular_speed / turning
                if abs(turning / angular_speed - 1.0) < 1e-4:
                    break
            return waves
        slowest *= 1.2
    raise UsageError(
        f"no hand reaches {speed:g} m/s within {reach:g} m of its place; lower the speed or widen"
        " the reach"
    )


def _waves_above(slowest: float, seed: int) -> NDArray[np.float64]:
    """Waves (6, 8, 4) above `slowest` Hz: amplitude 1 / f^2, angular frequency, phase, its sine."""
    random = np.random.default_rng(seed)
    steps = np.linspace(0.0, 1.0, N_WAVES)
    spread = np.clip(steps + random.uniform(-0.5, 0.5, (6, N_WAVES)) / N_WAVES, 0.0, 1.0)
    hertz = np.round(slowest * (FASTEST / slowest) ** spread * CYCLE) / CYCLE
    phases = random.uniform(0.0, 2.0 * np.pi, (6, N_WAVES))
    return np.stack([hertz**-2.0, 2.0 * np.pi * hertz, phases, np.sin(phases)], axis=2)
