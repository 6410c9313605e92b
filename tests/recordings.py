"""Recordings for tests: a header, frames that are functions of their index, and files of both."""

from pathlib import Path
from typing import Any

import numpy as np

from hapticdb import Grid, PointShell, TangentPlane
from hapticdb.recording.chunks import HEAD, Chunk
from hapticdb.recording.file import FRAME, Frames, Header, Recorder, Recording

POINT = PointShell(
    np.array([[0.1, 0.2, 0.3]]), np.array([[0.0, 0.0, 1.0]]), np.array([0.01, 0.0, 0.0])
)


def header(shell: PointShell = POINT, **changes: Any) -> Header:  # noqa: ANN401 - any of its fields
    given: dict[str, Any] = {
        "environment": "scene.db",
        "grid": Grid(0.005, (0.1, -0.2, 1 / 3), 7, "hilbert"),
        "revision": 3,
        "shell": shell,
        "rate": 1000.0,
        "law": TangentPlane(700.0),
        "exclude": [5, 2],
        "coupling": {"stiffness": 1500.0, "clutch": False},
    }
    return Header(**(given | changes))


HEADER = header()


def motion(n_frames: int, first: int = 0) -> Frames:
    """Frames of a smooth motion, each a function of its index alone."""
    n = np.arange(first, first + n_frames)
    t = n / 1000 + 1e-6 * np.sin(n * n)
    frames = np.zeros(n_frames, dtype=FRAME)
    frames["time"] = t
    frames["dt"] = 1e-3 + 1e-6 * np.cos(n * n)
    frames["elapsed"] = 3e-5 + 3e-6 * np.sin(3.0 * n * n)
    for name in ("hand", "hand_velocity", "tool", "wrench", "applied"):
        for k in range(FRAME[name].shape[0]):
            frames[name][:, k] = 0.4 + np.sin(t * (2 + k)) / (5 + k) + 0.01 * np.sin(t * (30 + k))
    for name in ("hand", "tool"):
        frames[name][:, 3:] /= np.linalg.norm(frames[name][:, 3:], axis=1, keepdims=True)
    frames["wrench"][np.sin(t) < 0] = 0.0
    frames["hits"] = np.maximum(0, 40 * np.sin(t)).astype(int)
    frames["revision"] = 3 + n // 5000
    return frames


def write(path: Path, *chunks: Frames, is_closed: bool = True) -> Path:
    """Write a recording with one chunk for each given array of frames."""
    recorder = Recorder(path, HEADER)
    for frames in chunks:
        recorder.append(frames)
        recorder.flush()
    if is_closed:
        recorder.close()
    else:
        recorder._file.close()
    return path


def read(path: Path, *, until_damage: bool = False) -> bytes:
    frames = Recording(path).frames(until_damage=until_damage)
    return b"".join(chunk.tobytes() for chunk in frames)


def places(path: Path) -> list[int]:
    """Offsets of the chunks and of the end mark of a complete file, and its length."""
    content = path.read_bytes()
    found = [Recording(path)._start]
    while chunk := Chunk.parse(content[found[-1] : found[-1] + HEAD.size]):
        found.append(found[-1] + HEAD.size + chunk.n_bytes)
    return found
