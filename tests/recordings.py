"""Recordings for tests: a header, frames that are functions of their index, and files of both."""

from pathlib import Path
from typing import Any

import numpy as np

from hapticdb import Grid, PointShell, TangentPlane
from hapticdb.recording.file import FRAME, Frames, Header, Recorder

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
    """Frames of a motion, each a function of its index alone."""
    n = np.arange(first, first + n_frames)
    frames = np.zeros(n_frames, dtype=FRAME)
    frames["time"], frames["dt"] = n / 1000, 1e-3
    for name in ("hand", "hand_velocity", "tool", "applied"):
        for k in range(FRAME[name].shape[0]):
            frames[name][:, k] = 0.4 + np.sin(n * (2 + k) / 1000) / (5 + k)
    for name in ("hand", "tool"):
        frames[name][:, 3:] /= np.linalg.norm(frames[name][:, 3:], axis=1, keepdims=True)
    frames["hits"], frames["revision"] = n % 40, 3 + n // 5000
    return frames


def begun(path: Path, head: Header = HEADER, **options: Any) -> Recorder:  # noqa: ANN401 - its options
    recorder = Recorder(path, **options)
    recorder.open()
    recorder.begin(head)
    return recorder


def write(path: Path, frames: Frames, head: Header = HEADER) -> Path:
    with begun(path, head) as recorder:
        recorder.append(frames)
    return path
