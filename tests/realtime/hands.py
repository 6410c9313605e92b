"""Hands that misbehave, for the loop's process to import, and those of the tests of sessions."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import cast

import numpy as np
from numpy.typing import NDArray

from hapticdb.devices.scripted import Player, Reading
from hapticdb.errors import DeviceError

Floats = NDArray[np.float64]


def at(x: float, y: float, z: float) -> Floats:
    """A pose (4, 4), upright."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


def still(z: float) -> Player:
    """A hand that rests there for ever."""
    return Player([0.0, 3600.0], [at(0.0, 0.0, z)] * 2)


def stroking(low: float, seconds: float = 1.0, loops: bool = False) -> Player:
    """A hand that comes down from 20 mm, strokes along x, and leaves."""
    places = [(0.0, 0.02), (0.0, low), (0.02, low), (-0.02, low), (-0.02, 0.02), (0.0, 0.02)]
    times = np.linspace(0.0, seconds, len(places))
    return Player(times, [at(x, 0.0, z) for x, z in places], loops=loops)


class Slow:
    """A hand whose read takes long, now and then."""

    def __init__(self, hand: Player, every: int, seconds: float) -> None:
        self.hand, self.every, self.seconds = hand, every, seconds
        self.reads = 0

    def read(self) -> Reading:
        self.reads += 1
        if self.reads % self.every == 0:
            time.sleep(self.seconds)
        return self.hand.read()

    def apply(self, wrench: Floats) -> None:
        """Feel nothing."""


class Clutched(Slow):
    """A hand that moves to and fro, its first button down every other 100 reads."""

    def read(self) -> Reading:
        reading = super().read()
        return reading._replace(buttons=(self.reads // 100) & 1)


class Lost(Slow):
    """A hand whose first reads, so many, are no place."""

    def read(self) -> Reading:
        reading = super().read()
        if self.reads <= self.every:
            return reading._replace(pose=np.full((4, 4), np.nan), velocity=np.full(6, np.nan))
        return reading


class Unplugged(Slow):
    """A hand whose cable is pulled at its n-th read, with an error of some kind."""

    def __init__(self, hand: Player, every: int, kind: type[Exception] = DeviceError) -> None:
        super().__init__(hand, 1 << 30, 0.0)
        self.n_reads, self.kind = every, kind

    def read(self) -> Reading:
        reading = super().read()
        if self.reads == self.n_reads:
            raise self.kind("the hand was unplugged: plug it in")
        return reading


class Noted(Slow):
    """A hand whose driver keeps the latest wrench in a file."""

    def __init__(self, hand: Player, path: Path) -> None:
        super().__init__(hand, 1 << 30, 0.0)
        self.path = path

    def apply(self, wrench: Floats) -> None:
        self.path.write_bytes(wrench.tobytes())


class Talking(Slow):
    """A hand whose driver prints to standard output."""

    def read(self) -> Reading:
        print("driver: hello", flush=True)  # noqa: T201 - that is the test
        return super().read()


class Beckoned(Slow):
    """A hand that rests where its path begins until there is such a file."""

    def __init__(self, hand: Player, path: Path) -> None:
        super().__init__(hand, 1 << 30, 0.0)
        self.path = path
        self.is_called = False

    @property
    def is_over(self) -> bool:
        return self.is_called and self.hand.is_over

    def read(self) -> Reading:
        if not self.is_called:
            self.is_called = self.path.exists()
            self.hand.rewind()
        reading = super().read()
        return reading if self.is_called else reading._replace(velocity=np.zeros(6))


class Odd(Slow):
    """A hand whose reads from the n-th on, so many, are changed."""

    def __init__(
        self,
        hand: Player,
        change: Callable[[Reading], object],
        first: int = 0,
        n_reads: int = 1 << 30,
    ) -> None:
        super().__init__(hand, 1 << 30, 0.0)
        self.change, self.first, self.last = change, first, first + n_reads
        self.pushed: list[Floats] = []

    def read(self) -> Reading:
        reading = super().read()
        if not self.first <= self.reads < self.last:
            return reading
        return cast("Reading", self.change(reading))

    def apply(self, wrench: Floats) -> None:
        self.pushed.append(wrench.copy())
