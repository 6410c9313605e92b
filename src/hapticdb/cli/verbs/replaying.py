"""The verb replay."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hapticdb.cli import render
from hapticdb.cli.csv_files import FRAME_COLUMNS, STDOUT, open_csv, rows_of_frames
from hapticdb.cli.options import CsvOption, JsonOption

if TYPE_CHECKING:
    from hapticdb.recording.file import Recording
    from hapticdb.recording.replay import Replayed


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
    until_damage: Annotated[
        bool,
        typer.Option(
            "--until-damage", help="Take a damaged recording to end where the damage begins."
        ),
    ] = False,
    csv: CsvOption = None,
    json: JsonOption = False,
) -> None:
    """Compute a recorded session's contact wrenches again, and say whether they are equal.

    Ends with exit code 0 when all are equal bit for bit, 1 when some differ
    or there was none to compare. With --csv, the recorded frames are written
    and nothing is compared; no environment is needed.

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
            f"{recording}: the last {session.n_torn:,} bytes are an incomplete chunk, since the "
            "recorder was cut off; everything before them is whole"
        )
    if csv is not None:
        _write_frames(session, csv, until_damage=until_damage)
        return
    replayed = _replayed(session, url, until_damage=until_damage)
    if json:
        parting = replayed.parting
        render.say_json(
            {
                "compared": replayed.n_compared,
                "skipped": replayed.n_skipped,
                "differing": replayed.n_differing,
                "revision": replayed.revision,
                "is_same_revision": replayed.is_same_revision,
                "parts_at": None if parting is None else parting.frame,
            }
        )
    else:
        render.say(replayed.describe())
    if not replayed.is_equal:
        raise typer.Exit(1)


def _replayed(session: "Recording", url: str | None, *, until_damage: bool) -> "Replayed":
    """Compute a recording's wrenches again."""
    import hapticdb
    from hapticdb.query.law import frames_by

    place: str | Path
    if url is None:
        place = session.environment_beside()
        render.note(f"{session.path} names {place}, which is opened")
    else:
        place = url
    with hapticdb.open(place, read_only=True) as env:
        render.compile_kernels(frames_by(session.header.law))
        return hapticdb.replay(session, env, until_damage=until_damage)


def _write_frames(session: "Recording", target: str, *, until_damage: bool) -> None:
    """Write recorded frames as CSV, chunk by chunk."""
    columns = [name for names in FRAME_COLUMNS.values() for name in names]
    n_frames = 0
    with open_csv(target, "--csv", columns) as rows:
        assert rows is not None  # noqa: S101 - a target was given
        for frames in session.frames(until_damage=until_damage):
            rows.write(rows_of_frames(frames))
            n_frames += len(frames)
    if target != STDOUT:
        render.say(f"{target}: {render.counted(n_frames, 'frame')}")
