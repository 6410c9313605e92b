"""Hands for the tests of sessions, some of them faulty; the loop's process imports them."""

import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from hapticdb.devices.protocol import Reading
from hapticdb.devices.scripted import Player
from hapticdb.errors import DeviceError
from hapticdb.session.processes.process import MessageSender

Floats = NDArray[np.float64]


def at(x: float, y: float, z: float) -> Floats:
    """A pose (4, 4), upright."""
    pose = np.eye(4)
    pose[:3, 3] = x, y, z
    return pose


class Steady:
    """A clock that goes on by at most 4 ms a call: a hand waits for a loop that stands still."""

    def __init__(self) -> None:
        self._now = self._seen = 0.0

    def __call__(self) -> float:
        seen = time.perf_counter()
        self._now += min(seen - self._seen, 0.004)
        self._seen = seen
        return self._now


def still(z: float) -> Player:
    """A hand that rests at a pose for ever."""
    return Player([0.0, 3600.0], [at(0.0, 0.0, z)] * 2)


def stroking(low: float, seconds: float = 1.0, loops: bool = False) -> Player:
    """A hand that comes down from a height of 20 mm, moves along x, and leaves."""
    places = [(0.0, 0.02), (0.0, low), (0.02, low), (-0.02, low), (-0.02, 0.02), (0.0, 0.02)]
    times = np.linspace(0.0, seconds, len(places))
    return Player(times, [at(x, 0.0, z) for x, z in places], loops=loops)


class Heard(MessageSender):
    """Keeps what a loop's process sends."""

    def __init__(self) -> None:
        self.said: list[tuple[str, Any]] = []

    def send(self, word: str, content: object = None) -> None:
        self.said.append((word, content))


class Slow:
    """A hand whose every n-th read takes so many seconds."""

    def __init__(self, hand: Player, every: int, seconds: float) -> None:
        self.hand, self.every, self.seconds = hand, every, seconds
        self.reads, self.over_after = 0, 1 << 30

    @property
    def is_over(self) -> bool:
        """Whether it was read so often that it ends, however long that took."""
        return self.reads >= self.over_after

    def read(self) -> Reading:
        self.reads += 1
        if self.reads % self.every == 0:
            time.sleep(self.seconds)
        return self.hand.read()

    def apply(self, wrench: Floats) -> None:
        """Ignore the wrench."""


class Clutched(Slow):
    """A hand whose first button changes between down and up every 100 reads; it ends after 500."""

    def __init__(self, hand: Player) -> None:
        super().__init__(hand, 1 << 30, 0.0)
        self.over_after = 500

    def rewind(self) -> None:
        """Begin path and reads again, however often the loop read before its first frame."""
        self.hand.rewind()
        self.reads = 0

    def read(self) -> Reading:
        reading = super().read()
        return reading._replace(buttons=(self.reads // 100) & 1)


class Lost(Slow):
    """A hand whose first `every` readings are NaN."""

    def read(self) -> Reading:
        reading = super().read()
        if self.reads <= self.every:
            return reading._replace(pose=np.full((4, 4), np.nan), velocity=np.full(6, np.nan))
        return reading


class Unplugged(Slow):
    """A hand that raises an error at its n-th read, as when its cable is pulled."""

    def __init__(self, hand: Player, every: int, kind: type[Exception] = DeviceError) -> None:
        super().__init__(hand, 1 << 30, 0.0)
        self.n_reads, self.kind = every, kind

    def read(self) -> Reading:
        reading = super().read()
        if self.reads == self.n_reads:
            raise self.kind("the hand was unplugged: plug it in")
        return reading


class Noted(Slow):
    """A hand whose driver adds each wrench that it receives to a file."""

    def __init__(self, hand: Player, path: Path) -> None:
        super().__init__(hand, 1 << 30, 0.0)
        self.path = path

    def apply(self, wrench: Floats) -> None:
        with self.path.open("ab") as file:
            file.write(wrench.tobytes())


class NotedClutched(Noted):
    """One whose first button is down between 5 and 12 mm along x."""

    @property
    def is_over(self) -> bool:
        return self.hand.is_over

    def read(self) -> Reading:
        reading = super().read()
        return reading._replace(buttons=int(0.005 < reading.pose[0, 3] < 0.012))


class Beckoned(Slow):
    """A hand that rests at the start of its path until a file exists."""

    profile = Player.profile

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
    """A hand whose readings `first` to `first + n_reads - 1` are changed by a function."""

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
