"""Recordings that were cut off or damaged: whole chunks are read, the rest is one error line."""

import json
import os
import resource
import signal
import struct
import time
import zlib
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from children import exit_code, until
from draws import drawn
from hapticdb.errors import FileError
from hapticdb.recording.chunks import HEAD, MOST_FRAMES, Chunk
from hapticdb.recording.file import Recorder, Recording
from hapticdb.recording.header import MAGIC, PREAMBLE
from recordings import HEADER, motion, places, read, write

repeatedly = settings(suppress_health_check=[HealthCheck.function_scoped_fixture], deadline=None)


def test_a_file_cut_anywhere_is_whole_up_to_its_last_chunk_and_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", lambda _: None)
    frames = motion(4)
    whole = write(tmp_path / "s.hdbrec", frames[:2], frames[2:3], frames[3:])
    content, starts = whole.read_bytes(), places(whole)
    known = [0, 2, 3, 4, 4]
    path = tmp_path / "cut.hdbrec"
    for cut in drawn(range(len(content)), 150):
        path.write_bytes(content[:cut])
        if cut < starts[0]:
            with pytest.raises(FileError, match="cut off in its header"):
                Recording(path)
            continue
        n_whole = sum(start <= cut for start in starts) - 1
        found = Recording(path)
        assert (found.damaged_at, found.n_torn) == (None, cut - starts[n_whole])
        assert found.columns("time")[0].tolist() == frames["time"][: known[n_whole]].tolist()
        if cut % 5:
            continue
        with Recorder(path, HEADER, append=True) as recorder:
            assert len(recorder) == known[n_whole]
            recorder.append(frames[known[n_whole] :])
        assert read(path) == frames.tobytes()
        assert Recording(path).n_torn == 0


def test_a_killed_recorder_leaves_whole_chunks(tmp_path: Path) -> None:
    """Recorders are killed at random moments; the next one continues the file."""
    rng = np.random.default_rng(5)
    path = tmp_path / "s.hdbrec"
    Recorder(path, HEADER).close()
    n_before = 0
    for _ in range(8):
        before = path.stat().st_size
        child = os.fork()
        if child == 0:
            try:
                recorder = Recorder(path, HEADER, append=True)
                while True:
                    recorder.append(motion(97, len(recorder)))
                    recorder.flush()
            finally:
                os._exit(1)
        until(lambda b=before: path.stat().st_size > b, every=0.001)  # type: ignore[misc]
        time.sleep(rng.uniform(0.0, 0.08))
        os.kill(child, signal.SIGKILL)
        assert exit_code(child) == -signal.SIGKILL
        n_frames = len(Recording(path))
        assert n_frames >= n_before
        assert Recording(path).damaged_at is None
        assert read(path) == motion(n_frames).tobytes()
        n_before = n_frames
    assert n_before > 0


def test_a_full_disk_leaves_whole_chunks(tmp_path: Path) -> None:
    path = tmp_path / "s.hdbrec"
    child = os.fork()
    if child == 0:  # the file size limit holds for the child process only
        code = 1
        try:
            resource.setrlimit(resource.RLIMIT_FSIZE, (20_000, 20_000))
            recorder = Recorder(path, HEADER)
            try:
                for n in range(1000):
                    recorder.append(motion(20, 20 * n))
                    recorder.flush()
            except FileError as error:
                told = f"cannot write {path}: File too large; its first {len(recorder)} frames"
                code = 0 if str(error).startswith(told) and recorder._file.closed else 2
        finally:
            os._exit(code)
    assert exit_code(child) == 0
    found = Recording(path)
    assert (found.n_torn, found.damaged_at) == (0, None)
    assert len(found) > 20
    assert read(path) == motion(len(found)).tobytes()


@pytest.mark.parametrize("within", [2, 9, HEAD.size - 1, HEAD.size + 3, HEAD.size + 200])
def test_damage_in_the_middle_is_told_with_its_frame(tmp_path: Path, within: int) -> None:
    frames = motion(12)
    path = write(tmp_path / "s.hdbrec", frames[:5], frames[5:8], frames[8:])
    content = bytearray(path.read_bytes())
    content[places(path)[1] + within] ^= 0x10
    path.write_bytes(content)
    found = Recording(path)
    assert (found.damaged_at, len(found)) == (5, 5)
    each = found.frames()
    assert next(each).tobytes() == frames[:5].tobytes()
    told = r"s\.hdbrec: damaged at frame 5; .* until_damage, or 'hapticdb replay --until-damage'$"
    with pytest.raises(FileError, match=told):
        next(each)
    with pytest.raises(FileError, match="damaged at frame 5"):
        found.poses()
    assert read(path, until_damage=True) == frames[:5].tobytes()
    assert len(found.poses(until_damage=True)[0]) == 5
    with pytest.raises(FileError, match="damaged at frame 5; give another name"):
        Recorder(path, HEADER, append=True)
    assert path.read_bytes() == content


def test_a_chunk_that_is_missing_is_damage(tmp_path: Path) -> None:
    frames = motion(12)
    path = write(tmp_path / "s.hdbrec", frames[:5], frames[5:8], frames[8:], is_closed=False)
    content, starts = path.read_bytes(), places(path)
    path.write_bytes(content[: starts[1]] + content[starts[2] :])
    assert Recording(path).damaged_at == 5


def test_the_last_chunk_is_torn_unless_the_recorder_was_closed(tmp_path: Path) -> None:
    frames = motion(12)
    for is_closed, damaged_at in ((True, 5), (False, None)):
        path = write(tmp_path / f"{is_closed}", frames[:5], frames[5:], is_closed=is_closed)
        content = bytearray(path.read_bytes())
        content[places(path)[1] + 40] ^= 1
        path.write_bytes(content)
        assert Recording(path).damaged_at == damaged_at
        assert read(path, until_damage=True) == frames[:5].tobytes()


def readable(path: Path) -> bytes:
    """Frames that can be read; the error at the first damaged one must be one line."""
    found = b""
    try:
        found = read(path, until_damage=True)
        return read(path)
    except FileError as error:
        if "\n" in str(error):
            raise
        return found


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    frames = motion(12)
    path = tmp_path_factory.mktemp("sound") / "s.hdbrec"
    return write(path, frames[:5], frames[5:6], frames[6:]).read_bytes()


@settings(repeatedly, max_examples=300)
@given(
    flips=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(1, 255)), max_size=4),
    cut=st.floats(0, 1),
)
def test_whatever_happens_to_a_file_no_frame_is_wrong(
    tmp_path: Path, sound: bytes, flips: list[tuple[float, int]], cut: float
) -> None:
    content = bytearray(sound)
    for place, flip in flips:
        content[int(place * len(content))] ^= flip
    path = tmp_path / "s.hdbrec"
    path.write_bytes(content[: round(cut * len(content))])
    assert motion(12).tobytes().startswith(readable(path))


@pytest.mark.parametrize(
    "head",
    [
        Chunk(0, 2**32 - 1, 100, 0),
        Chunk(0, MOST_FRAMES, 100, 0),
        Chunk(0, 1, 2**32 - 1, 0),
        Chunk(2**63, 1, 400, 0),
        Chunk(0, 0, 400, 0),
    ],
)
def test_a_chunk_that_asks_for_absurd_sizes_is_none(tmp_path: Path, head: Chunk) -> None:
    """A chunk with absurd sizes counts as no chunk, even with a right checksum."""
    path = tmp_path / "s.hdbrec"
    path.write_bytes(HEADER.packed() + head.packed() + bytes(400))
    assert len(Recording(path)) == 0
    assert read(path, until_damage=True) == b""


def test_a_column_that_unpacks_to_more_than_its_frames_is_damage(tmp_path: Path) -> None:
    """Unpacking stops at the size that the frames need."""
    bomb = zlib.compress(bytes(10_000_000))
    payload = np.array([len(bomb)] * 16, "<u4").tobytes() + bomb * 16
    path = tmp_path / "s.hdbrec"
    chunk = Chunk(0, 10_000, len(payload), zlib.crc32(payload))
    path.write_bytes(HEADER.packed() + chunk.packed() + payload)
    with pytest.raises(FileError, match="damaged at frame 0"):
        read(path)


def sealed(text: bytes, n_points: int = 1, n_text: int | None = None, number: int = 1) -> bytes:
    """A header with any content and the right checksum."""
    counts = PREAMBLE.pack(MAGIC, number, len(text) if n_text is None else n_text, n_points, 0)[:-4]
    body = text + HEADER.packed()[-72:]
    return counts + struct.pack("<I", zlib.crc32(body, zlib.crc32(counts))) + body


json_values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=True) | st.text(),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=5,
)


@repeatedly
@given(data=st.data())
def test_a_header_of_anything_is_told_in_one_line(tmp_path: Path, data: st.DataObject) -> None:
    _, n_text, *_ = struct.unpack_from("<8xIIII", HEADER.packed())
    told = json.loads(HEADER.packed()[PREAMBLE.size : PREAMBLE.size + n_text])
    for name in data.draw(st.lists(st.sampled_from(sorted(told)), min_size=1, max_size=3)):
        told[name] = data.draw(json_values)
    path = tmp_path / "s.hdbrec"
    path.write_bytes(sealed(json.dumps(told).encode()))
    assert readable(path) == b""


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (sealed(b"[" * 100_000), "cannot be used"),
        (sealed(b"{}"), "cannot be used"),
        (sealed(b"\xff"), "cannot be used"),
        (sealed(b"{}", n_points=2**32 - 1), "damaged"),
        (sealed(b"{}", n_points=10_000_000), "cut off"),
        (sealed(b"{}", n_text=2**32 - 1), "damaged"),
        (sealed(b"{}", number=5), "format 5"),
        (b"", "cut off"),
        (b"HDB", "cut off"),
        (b"SQLite format 3\0" * 9, "is no recording"),
    ],
)
def test_a_header_that_cannot_be_used_is_told(tmp_path: Path, content: bytes, message: str) -> None:
    path = tmp_path / "s.hdbrec"
    path.write_bytes(content)
    with pytest.raises(FileError, match=message):
        Recording(path)
