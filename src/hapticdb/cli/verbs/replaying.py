"""The verb replay."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hapticdb.cli import render
from hapticdb.cli.csv_files import FRAME_COLUMNS, STDOUT, open_csv, rows_of_frames
from hapticdb.cli.options import CsvOption, JsonOption

if TYPE_CHECKING:
    from hapticdb.recording.file import Recording
    from hapticdb.session.replay import Replayed

PIECE = 4096
"""Frames that are written to CSV at once. Larger: more memory."""


def replay(
    recording: Annotated[str, typer.Argument(metavar="FILE", help="A session's .hdbrec.")],
    url: Annotated[
        str | None,
        typer.Argument(
            metavar="URL",
            help="The environment; unless given, the recorded one if its file is beside FILE.",
        ),
    ] = None,
    *,
    csv: CsvOption = None,
    json: JsonOption = False,
) -> None:
    """Run a recorded session again, and say whether tool, wrench and contacts are equal.

    Ends with exit code 0 when all frames are equal bit for bit, 1 when some
    differ or there was none to compare; the first one is named with the
    reason. With --csv, the recorded frames are written and nothing is
    compared; no environment is needed.

    Example: hapticdb replay session.hdbrec car.db
    """
    from hapticdb.errors import UsageError
    from hapticdb.recording.file import Recording

    if csv is not None and (url is not None or json):
        raise UsageError(
            "--csv writes what was recorded and compares nothing: leave out URL, --json"
        )
    session = Recording(recording)
    if session.n_torn:
        render.note(
            f"{recording}: its last frame is torn, since the recorder was cut off; "
            f"{session.n_torn:,} bytes are left out"
        )
    if csv is not None:
        _write_frames(session, csv)
        return
    replayed = _replayed(session, url)
    if json:
        parting = replayed.parting
        render.say_json(
            {
                "frames": replayed.n_frames,
                "differing": replayed.n_differing,
                "revision": replayed.revision,
                "parts_at": None if parting is None else parting.frame,
                "reason": None if parting is None else parting.reason,
            }
        )
    else:
        render.say(replayed.describe())
    if not replayed.is_equal:
        raise typer.Exit(1)


def _replayed(session: "Recording", url: str | None) -> "Replayed":
    """Run a recording's frames again."""
    import hapticdb

    place: str | Path
    if url is None:
        place = session.environment_beside()
        render.note(f"{session.path} names {place}, which is opened")
    else:
        place = url
    with hapticdb.open(place, read_only=True) as env:
        return hapticdb.replay(session, env)


def _write_frames(session: "Recording", target: str) -> None:
    """Write recorded frames as CSV, piece by piece."""
    columns = [name for names in FRAME_COLUMNS.values() for name in names]
    frames = session.frames()
    with open_csv(target, "--csv", columns) as rows:
        assert rows is not None  # noqa: S101 - a target was given
        for at in range(0, len(frames), PIECE):
            rows.write(rows_of_frames(frames[at : at + PIECE]))
    if target != STDOUT:
        render.say(f"{target}: {render.counted(len(frames), 'frame')}")
