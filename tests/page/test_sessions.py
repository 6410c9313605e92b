"""A browser's session begins, is lost, fails and ends: nothing of it stays in the host."""

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from children import TIMEOUT, until
from hapticdb.errors import HapticDBError, UsageError
from hapticdb.page.browser import Browser
from hapticdb.page.connection import Visitor


class FakeSession:
    """A session that has ended, died, or runs."""

    def __init__(self, start: Any) -> None:  # noqa: ANN401 - a pose
        self.start = np.array(start)
        self.is_over, self.n_ends, self.lost_frames, self.lost_at_end = False, 0, 0, 0

    def move(self, _: object) -> None: ...

    def latest(self) -> None:
        """There is no frame yet."""
        if self.is_over:
            raise UsageError("the session is over")

    def end(self) -> None:
        self.n_ends, self.is_over, self.lost_frames = self.n_ends + 1, True, self.lost_at_end


class FakeHost:
    """A host that begins sessions when `may_begin`, or fails with `error`."""

    def __init__(self) -> None:
        self.begun: list[FakeSession] = []
        self.n_asked, self.error = 0, HapticDBError("no seat is free")
        self.is_failing, self.may_begin = False, threading.Event()
        self.may_begin.set()

    def begin(self, _: object, start: object, **__: object) -> FakeSession:
        self.n_asked += 1
        assert self.may_begin.wait(TIMEOUT)
        if self.is_failing:
            raise self.error
        self.begun.append(FakeSession(start))
        return self.begun[-1]


class Person(Browser):
    """A browser without viser that keeps what it would tell and show its person."""

    def __init__(self, host: FakeHost, workers: ThreadPoolExecutor) -> None:
        self.visitor, self.number, self.dragged_part = Visitor("Ada", "toucher"), 0, None
        self.told: list[str] = []
        self.said: list[str] = []
        self.client, self.site = MagicMock(client_id=0), MagicMock(host=host, workers=workers)
        self.client.add_notification = lambda *words, **_: self.told.append(": ".join(words))
        self.site.objects, self.site.edits, self.site.error_text = {}, None, str
        self.site.facts = SimpleNamespace(has_distances=False, diagonal=1.0)
        self.scene = SimpleNamespace(hidden=())  # type: ignore[assignment]
        self.tool, self.scale = SimpleNamespace(shell=None), 1.0  # type: ignore[assignment]
        self.stiffness = 1000.0
        self.hand, self.session = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]), None
        self.drawing = SimpleNamespace(rest=lambda: self.said.append("rest"))  # type: ignore[assignment]
        self._excluded_ids, self._keeps_tool, self._over, self._is_closed = [], None, [], False
        self._beginning, self._swapping = threading.Lock(), threading.Lock()
        self._zeroing, self.colour = threading.Lock(), (0, 0, 0)
        self.touch, self.parts, self.record = MagicMock(), MagicMock(), MagicMock()
        self.record.session_ended = lambda: self.said.append("session_ended")

    def _share(self) -> None:
        self.said.append("share")

    def _unshare(self) -> None:
        self.said.append("unshare")

    @property
    def is_idle(self) -> bool:
        """Whether no worker is at its sessions, and none is asked to be."""
        return self._keeps_tool is None and not self._beginning.locked()


@pytest.fixture
def host() -> FakeHost:
    return FakeHost()


@pytest.fixture
def person(host: FakeHost) -> Iterator[Person]:
    with ThreadPoolExecutor(4) as workers:
        made = Person(host, workers)
        made.begin_anew()
        until(lambda: made.session is not None)
        until(lambda: made.is_idle)
        made.said.clear()
        yield made
        host.may_begin.set()


def test_browser_lost_session_restarts(host: FakeHost, person: Person) -> None:
    host.begun[0].is_over = True
    for n in range(3):
        person.tick(float(n))
    until(lambda: len(host.begun) == 2 and person.is_idle)
    assert host.begun[0].n_ends == 1
    assert person.session is host.begun[1]  # type: ignore[comparison-overlap]
    assert person.said.count("session_ended") == person.said.count("rest") == 1
    assert person.told == ["Tool lost: its process ended; it begins again"]


def test_begin_anew_concurrent_clicks_serialised(host: FakeHost, person: Person) -> None:
    """As by the button "Back to the start": viser calls each click in a thread of its own."""
    n_inside, together, pressed = 0, [], threading.Barrier(6)

    def show_ghost(*_: object) -> None:
        nonlocal n_inside
        n_inside += 1
        threading.Event().wait(0.002)  # lets the other threads come
        together.append(n_inside)
        n_inside -= 1

    def press(_: int) -> None:
        pressed.wait(TIMEOUT)
        person.use_tool(person.tool, person.hand)

    person.drawing = SimpleNamespace(show_ghost=show_ghost, rest=lambda: None)  # type: ignore[assignment]
    with ThreadPoolExecutor(6) as viser:
        list(viser.map(press, range(6)))
    until(lambda: person.is_idle)
    assert together == [1] * 6
    assert sum(not session.is_over for session in host.begun) == 1


def test_browser_lost_session_ended_on_close(host: FakeHost, person: Person) -> None:
    host.may_begin.clear()
    host.begun[0].is_over = True
    person.tick(0.0)
    until(lambda: host.n_asked == 2)
    person.close()
    host.may_begin.set()
    until(lambda: person.is_idle and len(host.begun) == 2)
    assert [one.n_ends for one in host.begun] == [1, 1]
    assert person.session is None
    assert person.said[-2:] == ["unshare", "rest"]


def test_begin_anew_failure_hides_force_and_tool(host: FakeHost, person: Person) -> None:
    host.is_failing = True
    person.begin_anew()
    until(lambda: person.told)
    assert person.told == ["Not done: no seat is free"]
    assert person.said == ["session_ended", "unshare", "rest"]
    assert person.session is None
    assert host.begun[0].n_ends == 1


def test_begin_anew_many_requests_newest_wins(host: FakeHost, person: Person) -> None:
    host.may_begin.clear()
    person.begin_anew()
    until(lambda: host.n_asked == 2)
    for _ in range(8):
        person.begin_anew()
    person.hand = np.array([0.0, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0])
    free = person.site.workers.submit(lambda: "free")
    assert free.result(TIMEOUT) == "free"  # other browsers' workers
    host.may_begin.set()
    until(lambda: person.is_idle)
    assert len(host.begun) == 3  # the first, the slow one, and one for the eight
    assert host.begun[-1].start[2, 3] == 0.5
    assert [one.n_ends for one in host.begun] == [1, 1, 0]
    assert person.session is host.begun[-1]  # type: ignore[comparison-overlap]


def test_browser_recording_lost_frames_reported(host: FakeHost, person: Person) -> None:
    host.begun[0].lost_frames = 1200  # its person pressed Stop
    person.tick(0.0)
    person.tick(0.1)
    host.begun[0].lost_at_end = 7
    person.begin_anew()
    until(lambda: len(host.begun) == 2 and person.is_idle)
    assert [one.partition(" were lost")[0] for one in person.told] == [
        "Recording incomplete: 1,200 frames", "Recording incomplete: 7 frames"
    ]  # fmt: skip
