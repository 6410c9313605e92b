"""The verb replay."""

from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from hapticdb.cli import render
from hapticdb.cli.emit import STDOUT, TableOutput, open_csv
from hapticdb.errors import UsageError
from hapticdb.tabular.schema import COLUMNS

if TYPE_CHECKING:
    from hapticdb.recording.file import Recording

PIECE = 4096
"""Frames of a block of CSV. Larger: more memory."""
FRAMES = (
    "time", "dt", "lateness", "elapsed", "hand", "hand_velocity", "tool", "applied", "spring",
    "hits", "contacts", "unknown", "deepest", "revision", "buttons", "state",
)  # fmt: skip
"""Keys of `replay --csv`, fields of a recorded frame: a row for each frame."""


def replay(recording: str, url: str | None = None, *, output: TableOutput) -> None:
    """Run a recorded session again.

    Tool, wrench and contacts are compared. The exit code is 0 if all frames are equal bit for bit,
    1 if some differ or there was none to compare; the first difference is printed with its reason.
    --csv writes the recorded frames and compares nothing; it needs no environment.

    Example: hapticdb replay session.hdbrec car.db
    """
    import typer

    import hapticdb
    from hapticdb.recording.file import Recording

    if output.csv is not None and (url is not None or output.json):
        raise UsageError("--csv compares nothing: leave out URL, --json")
    session = Recording(recording)
    if session.n_torn:
        render.note(
            f"{recording}: its last frame is torn, since the recorder was cut off; "
            f"{session.n_torn:,} bytes are left out"
        )
    if output.csv is not None:
        _write_frames(session, output.csv)
        return
    place: str | Path = url or session.environment_beside()
    if url is None:
        render.note(f"{session.path} names {place}, which is opened")
    with hapticdb.open(place, read_only=True) as env:
        replayed = hapticdb.replay(session, env)
    output.emit(replayed, replayed.describe(), int(not replayed.is_equal))
    if not replayed.is_equal:
        raise typer.Exit(1)


def _write_frames(session: "Recording", target: str) -> None:
    """Write recorded frames as CSV, block by block; single-precision numbers round-trip."""
    frames = session.frames()
    with open_csv(target, FRAMES) as table:
        assert table is not None  # noqa: S101 - a target was given
        for at in range(0, len(frames), PIECE):
            piece = frames[at : at + PIECE]
            columns = [piece[key].reshape(len(piece), -1).T for key in FRAMES]
            names = [COLUMNS.get(key, (key,)) for key in FRAMES]
            table.write(dict(zip(chain(*names), chain(*columns), strict=True)))
    if target != STDOUT:
        render.say(f"{target}: {render.counted(len(frames), 'frame')}")
