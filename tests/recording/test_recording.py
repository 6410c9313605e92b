"""Recordings: frames are read as they were written, bit for bit."""

import json
import struct
import zlib
from dataclasses import asdict
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from hapticdb import Coupling, PointShell
from hapticdb.devices.profiles import PROFILES
from hapticdb.errors import FileError, UsageError
from hapticdb.poses import rotation_of
from hapticdb.query.law import DistanceField
from hapticdb.recording.file import CHUNK, FRAME, Frames, Recorder, Recording, State
from recordings import HEADER, header, motion, read, write

repeatedly = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)


# --- what is written is read --------------------------------------------------------------------


@repeatedly
@given(frames=arrays(FRAME, st.integers(1, 6)), n=st.integers(1, 6))
def test_frames_return_bit_for_bit(tmp_path: Path, frames: Frames, n: int) -> None:
    """Also infinities, signed zeros and NaN."""
    path = tmp_path / "s.hdbrec"
    with Recorder(path, header(), replace=True) as recorder:
        recorder.append(frames[:n])
        recorder.flush()
        recorder.append(frames[n:])
    assert read(path) == frames.tobytes()
    assert len(Recording(path)) == len(frames)


def test_the_header_returns(tmp_path: Path, sphere: PointShell) -> None:
    changes: dict[str, Any] = {
        "law": DistanceField(800.0),
        "coupling": asdict(Coupling().settled(PROFILES["omni"], 1000.0, 2.0, 0.1)),
        "where": ["wheel*", 3],
        "exclude": ["material=steel"],
        "budget_points": 500,
    }
    given = header(sphere, **changes)
    Recorder(tmp_path / "s.hdbrec", given).close()
    found = Recording(tmp_path / "s.hdbrec").header
    assert found.differing(given) == []
    assert set(found.differing(HEADER)) == {"shell", *changes}
    assert (found.law, found.coupling) == (changes["law"], changes["coupling"])
    for name in ("grid", "revision", "rate", "where", "exclude", "version", "started"):
        assert getattr(found, name) == getattr(given, name)
    for name in ("points", "normals", "center"):
        assert getattr(found.shell, name).tobytes() == getattr(sphere, name).tobytes()


def test_a_session_without_frames_is_a_recording(tmp_path: Path) -> None:
    Recorder(tmp_path / "s.hdbrec", HEADER).close()
    found = Recording(tmp_path / "s.hdbrec")
    assert (len(found), list(found.frames()), found.n_torn) == (0, [], 0)
    times, poses = found.poses()
    assert (times.shape, poses.shape) == ((0,), (0, 4, 4))


def test_small_appends_wait_for_a_chunk(tmp_path: Path) -> None:
    frames = motion(CHUNK + 10)
    with Recorder(tmp_path / "s.hdbrec", HEADER) as recorder:
        for start in range(0, len(frames), 7):
            recorder.append(frames[start : start + 7])
        assert len(recorder) == CHUNK + 10
        assert len(Recording(tmp_path / "s.hdbrec")) == CHUNK
        recorder.flush()
        assert len(Recording(tmp_path / "s.hdbrec")) == CHUNK + 10
    assert [len(f) for f in Recording(tmp_path / "s.hdbrec").frames()] == [CHUNK, 10]


def test_columns_and_poses_are_those_of_the_frames(tmp_path: Path) -> None:
    frames = motion(500)
    found = Recording(write(tmp_path / "s.hdbrec", frames[:200], frames[200:]))
    hits, tools = found.columns("hits", "tool")
    np.testing.assert_array_equal(hits, frames["hits"])
    np.testing.assert_array_equal(tools, frames["tool"])
    times, poses = found.poses()
    np.testing.assert_array_equal(times, frames["time"])
    np.testing.assert_array_equal(poses[:, :3, 3], frames["hand"][:, :3])
    np.testing.assert_array_equal(poses[:, :3, :3], rotation_of(frames["hand"][:, 3:]))
    with pytest.raises(UsageError, match="columns heat: choose of time, dt"):
        found.columns("time", "heat")


def test_the_file_is_as_the_format_says(tmp_path: Path) -> None:
    """The file is read as docs/format.md describes, with NumPy alone."""
    frames = motion(9)
    content = write(tmp_path / "s.hdbrec", frames[:5], frames[5:]).read_bytes()
    magic, number, n_text, n_points, crc = struct.unpack_from("<8sIIII", content)
    end = 24 + n_text + 48 * n_points + 24
    assert (magic, number, n_points) == (b"HDBREC\r\n", 4, 1)
    assert zlib.crc32(content[24:end], zlib.crc32(content[:20])) == crc
    told = json.loads(content[24 : 24 + n_text])
    assert (told["grid"]["curve"], told["stiffness"], told["exclude"]) == ("hilbert", 700, [2, 5])
    numbers = np.frombuffer(content[24 + n_text : end], "<f8")
    assert numbers.tolist() == [0.1, 0.2, 0.3, 0, 0, 1, 0.01, 0, 0]

    found: list[Frames] = []
    at = end
    while at < len(content):
        mark, n, first, size, payload_crc, head_crc = struct.unpack_from("<4sIQIII", content, at)
        payload = content[at + 28 : at + 28 + size]
        assert (mark, zlib.crc32(content[at : at + 24])) == (b"HDBC", head_crc)
        assert (zlib.crc32(payload), first) == (payload_crc, sum(len(rows) for rows in found))
        at += 28 + size
        rows = np.zeros(n, FRAME)
        start = 4 * 16
        for name, length in zip(
            FRAME.names or (), np.frombuffer(payload[:start], "<u4"), strict=n > 0
        ):
            dtype = FRAME[name].base
            planes = np.frombuffer(zlib.decompress(payload[start : start + length]), np.uint8)
            zigzag = np.ascontiguousarray(planes.reshape(-1, n).T).view(f"<u{dtype.itemsize}")
            steps = np.where(zigzag & 1, ~(zigzag >> 1), zigzag >> 1)
            bits = steps.cumsum(0, steps.dtype).cumsum(0, steps.dtype)
            rows[name] = bits.view(dtype).reshape(rows[name].shape)
            start += length
        found.append(rows)
    assert np.concatenate(found).tobytes() == frames.tobytes()
    assert [len(rows) for rows in found] == [5, 4, 0]


# --- files that exist ---------------------------------------------------------------------------


def test_a_file_is_not_replaced_unasked(tmp_path: Path) -> None:
    path = tmp_path / "s.hdbrec"
    path.write_text("a letter")
    with pytest.raises(
        UsageError, match=r"is there already: append to it \(--append\), replace it"
    ):
        Recorder(path, header())
    with pytest.raises(FileError, match="is no recording of hapticdb"):
        Recorder(path, header(), append=True)
    assert path.read_text() == "a letter"
    with pytest.raises(FileError, match="is no recording of hapticdb"):
        Recorder(path, header(), replace=True)
    assert path.read_text() == "a letter"
    path.write_bytes(b"")
    with Recorder(path, header(), replace=True) as recorder:
        recorder.append(motion(3))
    assert len(Recording(path)) == 3
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_a_recording_is_replaced_by_the_first_frames_of_another(tmp_path: Path) -> None:
    path = tmp_path / "s.hdbrec"
    write(path, motion(10))
    before = path.read_bytes()
    Recorder(path, header(), replace=True).close()  # no frame was recorded
    assert path.read_bytes() == before
    with Recorder(path, header(), replace=True) as recorder:
        recorder.append(motion(4))
        assert path.read_bytes() == before
        recorder.flush()
        assert len(Recording(path)) == 4
    assert read(path) == motion(4).tobytes()
    assert [file.name for file in tmp_path.iterdir()] == [path.name]


def test_a_recording_goes_on(tmp_path: Path) -> None:
    frames = motion(30)
    write(tmp_path / "s.hdbrec", frames[:10])
    for start in (10, 20):
        later = header(revision=9, started="2031-01-01T00:00:00+00:00")
        with Recorder(tmp_path / "s.hdbrec", later, append=True) as recorder:
            assert (len(recorder), recorder.header.revision) == (start, 3)
            recorder.append(frames[start : start + 10])
    assert read(tmp_path / "s.hdbrec") == frames.tobytes()


def test_a_recorder_that_appends_begins_where_nothing_is(tmp_path: Path) -> None:
    (tmp_path / "empty.hdbrec").touch()
    for name in ("new.hdbrec", "empty.hdbrec"):
        with Recorder(tmp_path / name, header(), append=True) as recorder:
            recorder.append(motion(3))
        assert read(tmp_path / name) == motion(3).tobytes()


def test_another_session_is_not_appended(tmp_path: Path, sphere: PointShell) -> None:
    path = write(tmp_path / "s.hdbrec", motion(10))
    content = path.read_bytes()
    for other, named in (
        (header(sphere, rate=5000.0), "rate, shell"),
        (header(environment="other.db"), "environment"),
        (header(coupling={"stiffness": 1500.0}), "coupling"),
    ):
        with pytest.raises(UsageError, match=f"recorded with another {named}: give another name"):
            Recorder(path, other, append=True)
    assert path.read_bytes() == content


def test_one_recorder_at_a_time(tmp_path: Path) -> None:
    with Recorder(tmp_path / "s.hdbrec", HEADER) as recorder:
        recorder.append(motion(3))
        for how in ({"append": True}, {"replace": True}):
            with pytest.raises(UsageError, match="is being recorded"):
                Recorder(tmp_path / "s.hdbrec", header(), **how)
    assert read(tmp_path / "s.hdbrec") == motion(3).tobytes()


def test_no_password_is_written(tmp_path: Path) -> None:
    url = "postgresql://ann:secret@127.0.0.1/plant?password=secret"
    Recorder(tmp_path / "s.hdbrec", header(environment=url)).close()
    assert b"secret" not in (tmp_path / "s.hdbrec").read_bytes()
    assert Recording(tmp_path / "s.hdbrec").header.environment.startswith("postgresql://ann")


@pytest.mark.parametrize(
    "changes",
    [{"rate": 0.0}, {"rate": float("nan")}, {"coupling": {"k": {1}}}, {"law": SimpleNamespace()}],
)
def test_a_header_that_cannot_be_is_refused(changes: dict[str, Any]) -> None:
    with pytest.raises(UsageError):
        header(**changes)
    with pytest.raises(UsageError, match="finite numbers"):
        header(coupling={"k": float("inf")})


def test_what_is_no_frame_is_refused(tmp_path: Path) -> None:
    with Recorder(tmp_path / "s.hdbrec", HEADER) as recorder:
        with pytest.raises(UsageError, match="of FRAME"):
            recorder.append(np.zeros((2, 2), FRAME))
        with pytest.raises(UsageError, match="of FRAME"):
            recorder.append(np.zeros(3))  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="the recorder is closed"):
        recorder.append(motion(1))
    recorder.close()


def test_what_is_no_recording_is_told(tmp_path: Path) -> None:
    with pytest.raises(FileError, match="no recording at"):
        Recording(tmp_path / "none.hdbrec")
    with pytest.raises(FileError, match="is no file"):
        Recording(tmp_path)
    with pytest.raises(FileError, match="cannot write"):
        Recorder(tmp_path / "no" / "s.hdbrec", header())


def test_bits_of_the_state_are_as_the_format_says() -> None:
    assert list(State) == [1, 2, 4, 8]
