"""A recording ends with a whole chunk at its limit or before the disk is full."""

import io
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from children import PATIENCE
from hapticdb import PointShell
from hapticdb.errors import FileError, UsageError
from hapticdb.realtime.session import Session
from hapticdb.recording import file as module
from hapticdb.recording.file import CHUNK, FRAME, LEFT_FREE, Frames, Recorder, Recording
from realtime.hands import still
from realtime.sessions import RATE, floored, recorded
from realtime.worlds import make
from recordings import HEADER, motion, read, write

LIMIT = 1_000_000
"""Most bytes of a recording."""


def noise(n: int) -> Frames:
    """Random frames, which compression makes no shorter."""
    return np.frombuffer(np.random.default_rng(n).bytes(FRAME.itemsize * n), dtype=FRAME)


@pytest.mark.parametrize("frames", [motion(4 * CHUNK), noise(4 * CHUNK)], ids=["smooth", "noise"])
def test_a_recording_ends_whole_at_its_limit(tmp_path: Path, frames: Frames) -> None:
    path = tmp_path / "s.hdbrec"
    with Recorder(path, HEADER, limit_bytes=LIMIT) as recorder:
        for start in range(0, len(frames), 97):
            recorder.append(frames[start : start + 97])
        assert recorder.ended == (
            f"{path}: the recording ends after {len(recorder):,} frames, at its limit of 0.9537 MiB"
        )
        recorder.append(frames)  # these frames are dropped
        recorder.flush()
    assert 0.5 * LIMIT < path.stat().st_size <= LIMIT
    found = Recording(path)
    assert (found.n_torn, found.damaged_at) == (0, None)
    assert len(found) == len(recorder) > 0
    assert read(path) == frames[: len(found)].tobytes()


def test_a_recording_below_its_limit_does_not_end(tmp_path: Path) -> None:
    whole = write(tmp_path / "whole.hdbrec", motion(5000))
    for limit, is_cut in ((whole.stat().st_size, False), (whole.stat().st_size - 1, True)):
        path = tmp_path / f"{limit}.hdbrec"
        with Recorder(path, HEADER, limit_bytes=limit) as recorder:
            recorder.append(motion(5000))
        assert (recorder.ended is not None) == is_cut
        assert (len(Recording(path)) < 5000) == is_cut
        assert path.stat().st_size <= limit


def test_a_recording_leaves_room_on_its_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def shrinking(file: io.FileIO) -> int:
        return LEFT_FREE + LIMIT - file.tell()

    monkeypatch.setattr(module, "free_bytes", shrinking)
    for limit in (None, 1 << 30):
        path = tmp_path / f"{limit}.hdbrec"
        with Recorder(path, HEADER, limit_bytes=limit) as recorder:
            recorder.append(noise(4 * CHUNK))
        assert recorder.ended is not None
        assert recorder.ended.endswith("since its disk has no more than 64 MiB left")
        assert 0.5 * LIMIT < path.stat().st_size <= LIMIT
        assert len(Recording(path)) == len(recorder) > 0


def test_the_limit_counts_what_is_gone_on_with(tmp_path: Path) -> None:
    path = write(tmp_path / "s.hdbrec", motion(500))
    size = path.stat().st_size
    with pytest.raises(UsageError, match="come before the first new frame: give a higher limit"):
        Recorder(path, HEADER, append=True, limit_bytes=size)
    assert path.stat().st_size == size
    with Recorder(path, HEADER, append=True, limit_bytes=size + 50_000) as recorder:
        recorder.append(motion(5000))
    assert recorder.ended is not None
    assert 500 < len(Recording(path)) == len(recorder)
    assert size < path.stat().st_size <= size + 50_000


@pytest.mark.parametrize("limit", [0, -5, math.nan])
def test_a_limit_that_makes_no_sense_is_refused(tmp_path: Path, limit: Any) -> None:  # noqa: ANN401
    with pytest.raises(UsageError, match="bytes at most: give 1 or more"):
        Recorder(tmp_path / "s.hdbrec", HEADER, limit_bytes=limit)
    assert not list(tmp_path.iterdir())


def test_where_no_frame_would_fit_nothing_is_begun(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = write(tmp_path / "kept.hdbrec", motion(9)).read_bytes()
    path = tmp_path / "s.hdbrec"
    with pytest.raises(UsageError, match=r"300 bytes at most, and .*: give a higher limit"):
        Recorder(path, HEADER, limit_bytes=300)
    monkeypatch.setattr(module, "free_bytes", lambda _: 20 << 20)
    told = "its disk has 20 MiB left, of which a recording leaves 64 MiB: make room"
    for name, options in (("s", {}), ("kept", {"replace": True}), ("kept", {"append": True})):
        with pytest.raises(FileError, match=told):
            Recorder(tmp_path / f"{name}.hdbrec", HEADER, **options)
    assert not path.exists()
    assert (tmp_path / "kept.hdbrec").read_bytes() == kept


def test_a_session_goes_on_without_its_recording(sphere: PointShell, tmp_path: Path) -> None:
    path = tmp_path / "short.hdbrec"
    with floored(make(tmp_path, bits=6)) as env, Session(
        env.url, sphere, still(0.010), law="plane", rate=RATE, seconds=2.0,
        record=path, record_limit_bytes=20_000,
    ) as session:  # fmt: skip
        assert session.recording_ended is None
        report = session.wait(PATIENCE)
        assert report is not None
        assert report.recording_ended == session.recording_ended
    n_frames = len(recorded(path))
    assert report.recording_ended is not None
    assert f"ends after {n_frames:,} frames, at its limit" in report.recording_ended
    assert 0 < n_frames == report.recorded_frames < report.loop.frames
    assert report.loop.seconds >= 2.0
    assert report.lost_records == 0
