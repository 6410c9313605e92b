"""Trouble of one session stays its own: a failed or slow begin, a dead worker, a full machine."""

import errno
import os
import signal
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import NoReturn

import pytest

from children import TIMEOUT, joined, until
from hapticdb import Environment, PointShell
from hapticdb.errors import HapticDBError
from hapticdb.recording.file import Recorder
from hapticdb.session.attached import serve_attached
from hapticdb.session.host import SessionHost
from hapticdb.session.hosted import HostedSession
from hapticdb.session.prefetch.resident_cells import ResidentCells
from hapticdb.session.processes.channel import Channel
from hapticdb.session.shared_table import SharedTable
from hapticdb.store.filtering import Filter
from session.hands import at

ABOVE = at(0.0, 0.0, 0.02)
"""A pose of the ball of 12 mm over the floor at z = 0."""


@pytest.fixture(scope="module")
def host(distance_floor: Environment) -> Iterator[SessionHost]:
    with SessionHost(distance_floor.url, rate=500.0, budget_bytes=8 << 20, processes=1) as made:
        yield made


@pytest.fixture
def session(host: SessionHost, sphere: PointShell) -> Iterator[HostedSession]:
    begun = host.begin(sphere, ABOVE)
    yield begun
    begun.end()


def recording_of(host: SessionHost, session: HostedSession) -> Recorder:
    """The recording of a session, in the host."""
    found = host._supervisor.sessions[session.id].recording
    assert found is not None
    return found


def is_recorded_further(host: SessionHost, session: HostedSession) -> None:
    """Wait until frames are added to the recording."""
    recording = recording_of(host, session)
    before = len(recording)
    until(lambda: len(recording) > before)


def full(*_: object, **__: object) -> NoReturn:
    """Fail as a machine that has no more files or memory."""
    raise OSError(errno.EMFILE, "Too many open files", "/secret/path")


def test_host_machine_error_ends_each_session(
    caplog: pytest.LogCaptureFixture,
) -> None:
    ended: list[int] = []

    def call(_: str, session: int, /, *_content: object) -> object:
        ended.append(session)
        if session == 1:
            full()
        return None

    begun = iter([1, 2])

    def begin(shell: object, _: object) -> SimpleNamespace:
        return full() if shell is None else SimpleNamespace(id=next(begun), slot=0)

    ours, theirs = socket.socketpair()
    shared = SharedTable.create(1)
    thread = threading.Thread(target=serve_attached, args=(ours, shared, begin, call))
    thread.start()
    channel = Channel(theirs)
    try:
        channel.receive()
        with pytest.raises(HapticDBError, match="its log says why") as found:
            channel.call("begin", None, None, {})
        assert "/secret" not in str(found.value)
        assert [channel.call("begin", "a tool", None, {})[1] for _ in range(2)] == [1, 2]
    finally:
        channel.close()
        joined(thread)
        shared.close()
    assert sorted(ended) == [1, 2]
    assert [record.exc_info is not None for record in caplog.records] == [True, True]


def test_shared_table_unfinished_frame() -> None:
    shared = SharedTable.create(1)
    row = shared.take(7)
    shared.slots["contacts_sequence"][row] = 1
    with pytest.raises(HapticDBError, match="stayed unfinished for 1 s"):
        shared.contacts(row)
    shared.close()


def test_supervisor_survives_errors_logged_once(
    host: SessionHost,
    session: HostedSession,
    sphere: PointShell,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    rounds = []

    def fail(*_: object) -> None:
        rounds.append(0)
        full()

    other = host.begin(sphere, ABOVE)
    try:
        other.record(tmp_path / "other.hdbrec")
        with monkeypatch.context() as patch:
            patch.setattr(host.cells[0], "supervise", fail)
            patch.setattr(host._supervisor.sessions[session.id], "take_frames", fail)
            until(lambda: len(rounds) > 10)
            is_recorded_further(host, other)
    finally:
        other.end()
    said = [record.getMessage().partition(" failed")[0] for record in caplog.records]
    assert sorted(said) == ["recording a session", "starting a prefetch process again"]
    assert host.failure is None


def test_host_slow_begin_blocks_no_supervision(
    host: SessionHost,
    session: HostedSession,
    sphere: PointShell,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    is_slow, may_go_on = threading.Event(), threading.Event()
    cells_of = host._cells_of

    def wait(felt: Filter) -> ResidentCells:
        is_slow.set()
        assert may_go_on.wait(TIMEOUT)
        return cells_of(felt)

    session.record(tmp_path / "slow.hdbrec")

    def begin() -> None:
        host.begin(sphere, ABOVE).end()  # in another worker, since the first has died by then

    with monkeypatch.context() as patch:
        patch.setattr(host, "_cells_of", wait)
        thread = threading.Thread(target=begin)
        thread.start()
        try:
            assert is_slow.wait(TIMEOUT)
            is_recorded_further(host, session)
            assert len(host.cells) == 1
            os.kill(host.pids[0], signal.SIGKILL)
            until(lambda: session.is_over)
        finally:
            may_go_on.set()
            joined(thread)


def test_hosted_recording_counts_lost_frames(
    host: SessionHost, session: HostedSession, tmp_path: Path
) -> None:
    session.record(tmp_path / "late.hdbrec")
    is_recorded_further(host, session)
    with host._supervisor.sessions[session.id]._taking:
        recording_of(host, session)._n_taken -= 3000  # as if nobody had looked for 6 s
    assert session.stop_recording() > 0
    assert session.lost_frames > 1000
    session.record(tmp_path / "again.hdbrec")
    session.end()
    assert session.lost_frames == 0
