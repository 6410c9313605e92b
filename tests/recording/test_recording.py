"""Recordings: frames are read as they were written, and a file that is cut off up to its end."""

import io
import json
import os
import resource
import signal
import time
import zlib
from dataclasses import asdict, fields
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from children import TIMEOUT, exit_code, until
from draws import drawn
from hapticdb import Coupling, PointShell
from hapticdb.devices.profiles import PROFILES
from hapticdb.errors import FileError, UsageError
from hapticdb.poses import rotation_of
from hapticdb.query.law import DistanceField
from hapticdb.recording import file as module
from hapticdb.recording.file import FRAME, LEFT_FREE, Frames, Recorder, Recording, State
from hapticdb.recording.header import OLDER, Start
from hapticdb.session.session import Session
from recordings import HEADER, begun, header, motion, write
from session.hands import still
from session.sessions import RATE, floored, recorded
from session.worlds import make

repeatedly = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)


# --- what is written is read --------------------------------------------------------------------


@repeatedly
@given(frames=arrays(FRAME, st.integers(1, 6)), n=st.integers(1, 6))
def test_recorder_frames_round_trip_bits(tmp_path: Path, frames: Frames, n: int) -> None:
    """Also infinities, signed zeros and NaN."""
    path = tmp_path / "s.hdbrec"
    with begun(path, replace=True) as recorder:
        recorder.append(frames[:n])
        recorder.append(frames[n:])
    assert recorded(path).tobytes() == frames.tobytes()
    assert len(Recording(path)) == len(frames) == len(recorder)


def test_recording_header_round_trip(tmp_path: Path, sphere: PointShell) -> None:
    head = header(
        sphere,
        law=DistanceField(800.0),
        coupling=asdict(Coupling().settled(PROFILES["omni"], 1000.0, 2.0, 0.1)),
        where=["wheel*", 3],
        exclude=["material=steel"],
        rendering="coupled",
        frames_on="cuda",
        start=Start(b"\n\0", b"", b"1" * 300, b"2"),
    )
    found = Recording(write(tmp_path / "s.hdbrec", motion(2), head)).header
    for name in (field.name for field in fields(head) if field.name != "shell"):
        assert getattr(found, name) == getattr(head, name)
    for name in ("points", "normals", "center"):
        assert getattr(found.shell, name).tobytes() == getattr(sphere, name).tobytes()


def test_recording_without_frames(tmp_path: Path) -> None:
    found = Recording(write(tmp_path / "s.hdbrec", motion(0)))
    assert (len(found), len(found.frames()), found.n_torn) == (0, 0, 0)
    times, poses = found.poses()
    assert (times.shape, poses.shape) == ((0,), (0, 4, 4))


def test_recording_poses_of_hand(tmp_path: Path) -> None:
    frames = motion(500)
    times, poses = Recording(write(tmp_path / "s.hdbrec", frames)).poses()
    np.testing.assert_array_equal(times, frames["time"])
    np.testing.assert_array_equal(poses[:, :3, 3], frames["hand"][:, :3])
    np.testing.assert_array_equal(poses[:, :3, :3], rotation_of(frames["hand"][:, 3:]))


def test_recording_format_as_documented(tmp_path: Path) -> None:
    """The file is read as docs/format.md describes, with NumPy alone."""
    frames = motion(9)
    path = write(tmp_path / "s.hdbrec", frames)
    content = path.read_bytes()
    first, text, rest = content.split(b"\n", 2)
    words = first.split()
    number, rows_at, crc = int(words[2]), int(words[3]), int(words[4], 16)
    assert (words[:2], number, rows_at % 64) == ([b"hapticdb", b"recording"], 1, 0)
    assert zlib.crc32(content[len(first) + 1 : rows_at]) == crc
    told = json.loads(text)
    assert (told["grid"]["curve"], told["stiffness"], told["exclude"]) == ("hilbert", 700, [2, 5])
    assert (told["shell"]["points"], told["start"]) == (1, [0, 0, 0, 0, 0])
    numbers = np.frombuffer(rest[: 48 * 1 + 24], "<f8")
    assert numbers.tolist() == [0.1, 0.2, 0.3, 0, 0, 1, 0.01, 0, 0]
    row = np.dtype([(name, kind, *map(tuple, shape)) for name, kind, *shape in told["row"]])
    assert row == FRAME
    assert np.memmap(path, row, "r", rows_at).tobytes() == frames.tobytes()
    assert FRAME.itemsize == 336
    assert list(State) == [1, 2, 4, 8, 16, 32]


# --- files that exist ---------------------------------------------------------------------------


def test_recorder_existing_file_needs_replace(tmp_path: Path) -> None:
    path = tmp_path / "s.hdbrec"
    path.write_text("a letter")
    with pytest.raises(UsageError, match=r"is there already: replace it \(--replace\)"):
        Recorder(path).open()
    with pytest.raises(FileError, match="is no recording of hapticdb"):
        Recorder(path, replace=True).open()
    assert path.read_text() == "a letter"
    for old in (b"", OLDER + b"older"):
        path.write_bytes(old)
        with begun(path, replace=True) as recorder:
            recorder.append(motion(3))
        assert len(Recording(path)) == 3
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_recorder_replaces_at_first_frame(tmp_path: Path) -> None:
    path = write(tmp_path / "s.hdbrec", motion(10))
    before = path.read_bytes()
    with begun(path, replace=True):
        pass
    assert path.read_bytes() == before
    with begun(path, replace=True) as recorder:
        assert path.read_bytes() == before
        recorder.append(motion(4))
        assert len(Recording(path)) == 4
        with begun(path, replace=True), pytest.raises(UsageError, match="is being recorded"):
            Recorder(path, replace=True).open()
    assert recorded(path).tobytes() == motion(4).tobytes()


def test_recorder_writes_no_password(tmp_path: Path) -> None:
    url = "postgresql://ann:secret@127.0.0.1/plant?password=secret"
    path = write(tmp_path / "s.hdbrec", motion(1), header(environment=url))
    assert b"secret" not in path.read_bytes()
    assert Recording(path).header.environment.startswith("postgresql://ann")


@pytest.mark.parametrize(
    "changes",
    [
        {"rate": 0.0},
        {"rate": float("nan")},
        {"coupling": {"k": {1}}},
        {"coupling": {"k": float("inf")}},
        {"law": SimpleNamespace()},
    ],
)
def test_header_bad_values(changes: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        header(**changes)


def test_recording_other_file_or_version(tmp_path: Path) -> None:
    path = tmp_path / "s.hdbrec"
    with pytest.raises(FileError, match="no recording at"):
        Recording(path)
    with pytest.raises(FileError, match="is no file"):
        Recording(tmp_path)
    with pytest.raises(FileError, match="cannot write"):
        Recorder(tmp_path / "no" / "s.hdbrec").open()
    for version in (1, 2, 3, 4):
        path.write_bytes(OLDER + version.to_bytes(4, "little") + bytes(500))
        with pytest.raises(FileError, match=r"s\.hdbrec was made before 0\.1: record it again$"):
            Recording(path)
    path.write_bytes(b"hapticdb recording 2 000000000064 00000000\n" + bytes(100))
    with pytest.raises(FileError, match="format 2, this hapticdb reads 1"):
        Recording(path)


# --- files that were cut off --------------------------------------------------------------------


def test_recording_truncated_file(tmp_path: Path) -> None:
    content = write(tmp_path / "whole.hdbrec", motion(4)).read_bytes()
    start = len(content) - 4 * FRAME.itemsize
    path = tmp_path / "cut.hdbrec"
    for cut in [*drawn(range(len(content)), 150), 0, start - 1, start]:
        path.write_bytes(content[:cut])
        if cut < start:
            with pytest.raises(FileError, match="cut off in its header"):
                Recording(path)
            continue
        found = Recording(path)
        assert (len(found), found.n_torn) == divmod(cut - start, FRAME.itemsize)
        assert recorded(path).tobytes() == motion(len(found)).tobytes()


@repeatedly
@given(place=st.floats(0, 1, exclude_max=True), flip=st.integers(1, 255))
def test_recording_corrupt_header(tmp_path: Path, place: float, flip: int) -> None:
    content = bytearray(write(tmp_path / "s.hdbrec", motion(0)).read_bytes())
    content[int(place * len(content))] ^= flip
    (tmp_path / "s.hdbrec").unlink()
    (tmp_path / "f.hdbrec").write_bytes(content)
    with pytest.raises(FileError) as raised:
        Recording(tmp_path / "f.hdbrec")
    assert "\n" not in str(raised.value)


def test_recorder_killed_leaves_whole_frames(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    for n in range(4):
        path = tmp_path / f"{n}.hdbrec"
        child = os.fork()
        if child == 0:
            try:
                recorder = begun(path)
                while True:
                    recorder.append(motion(97, len(recorder)))
            finally:
                os._exit(1)
        until(lambda p=path: p.exists() and p.stat().st_size > 10_000, every=0.001)  # type: ignore[misc]
        time.sleep(rng.uniform(0.0, 0.05))
        os.kill(child, signal.SIGKILL)
        assert exit_code(child) == -signal.SIGKILL
        found = recorded(path)
        assert len(found) > 0
        assert found.tobytes() == motion(len(found)).tobytes()


# --- limits -------------------------------------------------------------------------------------


def test_recorder_disk_full_leaves_whole_frames(tmp_path: Path) -> None:
    path = tmp_path / "s.hdbrec"
    child = os.fork()
    if child == 0:  # the file size limit holds for the child process only
        code = 1
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
            recorder = begun(path)
            try:
                for n in range(1000):
                    recorder.append(motion(20, 20 * n))
            except FileError as error:
                told = f"cannot write {path}: File too large; its first {len(recorder)} frames"
                code = 0 if str(error).startswith(told) else 2
        finally:
            os._exit(code)
    assert exit_code(child) == 0
    found = Recording(path)
    assert (len(found) > 20, found.n_torn) == (True, 0)
    assert recorded(path).tobytes() == motion(len(found)).tobytes()


def test_recorder_size_limit_and_disk_reserve(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    size = write(tmp_path / "whole.hdbrec", motion(500)).stat().st_size
    for limit, n_frames in ((size, 500), (size - 1, 499)):
        with begun(tmp_path / f"{limit}.hdbrec", limit_bytes=limit) as recorder:
            recorder.append(motion(500))
        assert (recorder.ended is None) == (n_frames == 500)
        assert len(Recording(recorder.path)) == n_frames == len(recorder)
    assert "ends after 499 frames, at its limit of 0.1" in str(recorder.ended)

    def shrinking(file: io.FileIO) -> int:
        return LEFT_FREE + size - 1 - file.tell()

    monkeypatch.setattr(module, "free_bytes", shrinking)
    for given_limit in (None, 1 << 30):
        with begun(tmp_path / f"{given_limit}.hdbrec", limit_bytes=given_limit) as recorder:
            recorder.append(motion(500))
        assert str(recorder.ended).endswith("since its disk has no more than 64 MiB left")
        assert len(Recording(recorder.path)) == 499


@pytest.mark.parametrize("limit", [0, -5, float("nan")])
def test_recorder_bad_limit(tmp_path: Path, limit: Any) -> None:  # noqa: ANN401
    with pytest.raises(UsageError, match="bytes at most: give 1 or more"):
        Recorder(tmp_path / "s.hdbrec", limit_bytes=limit)


def test_recorder_limit_below_one_frame(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    recorder = Recorder(tmp_path / "s.hdbrec", limit_bytes=400)
    recorder.open()
    with pytest.raises(UsageError, match="400 bytes at most, and its header and a frame take"):
        recorder.begin(HEADER)
    recorder.discard()
    monkeypatch.setattr(module, "free_bytes", lambda _: 20 << 20)
    recorder = Recorder(tmp_path / "s.hdbrec")
    with pytest.raises(FileError, match="its disk has 20 MiB left, of which a recording leaves 64"):
        recorder.open()
    recorder.discard()
    assert not list(tmp_path.iterdir())


def test_session_continues_beyond_recording_limit(sphere: PointShell, tmp_path: Path) -> None:
    path = tmp_path / "short.hdbrec"
    with floored(make(tmp_path, bits=6)) as env, Session(
        env.url, sphere, still(0.010), law="plane", rate=RATE, seconds=2.0,
        record=path, record_limit_bytes=50_000,
    ) as session:  # fmt: skip
        assert session.recording_ended is None
        report = session.wait(TIMEOUT)
    assert report is not None
    n_frames = len(recorded(path))
    assert f"ends after {n_frames:,} frames, at its limit" in str(report.recording_ended)
    assert 0 < n_frames == report.recorded_frames < report.loop.frames
    assert report.lost_records == 0
