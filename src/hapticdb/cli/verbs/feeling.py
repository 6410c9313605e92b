"""Verbs of sessions: feel, replay."""

from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from pathlib import Path
from time import perf_counter
from typing import TYPE_CHECKING, Any

import typer

import hapticdb
from hapticdb.cli import render, session_report
from hapticdb.cli.device_options import HandOptions
from hapticdb.cli.emit import STDOUT, Output, TableOutput, open_csv
from hapticdb.cli.options import FramesOn, LawName, RenderingName
from hapticdb.cli.root import ended_by_signals, exit_by
from hapticdb.cli.selection import FilterOptions
from hapticdb.cli.tool_options import ToolOptions
from hapticdb.cli.values import MIB, refuse
from hapticdb.errors import UsageError
from hapticdb.tabular.schema import COLUMNS

if TYPE_CHECKING:
    from hapticdb.devices.profiles import DeviceProfile
    from hapticdb.query.law import ForceLaw
    from hapticdb.recording.file import Recording
    from hapticdb.session.coupling import Coupling, Rendering
    from hapticdb.session.report import Report
    from hapticdb.session.session import Session

POLL_EVERY = 0.1
"""Seconds between two polls of the session: delay of its notes."""
PIECE = 4096
"""Frames of a block of CSV. Larger: more memory."""
FRAMES = (
    "time", "dt", "lateness", "elapsed", "hand", "hand_velocity", "tool", "applied", "spring",
    "hits", "contacts", "unknown", "deepest", "revision", "buttons", "state",
)  # fmt: skip
"""Keys of `replay --csv`, fields of a recorded frame: a row for each frame."""


@dataclass(frozen=True)
class ForceOptions:
    """Options of the force on the hand: law, coupling and device limits."""

    law: LawName | None = None
    rendering: RenderingName | None = None
    stiffness: float | None = None
    device_profile: str | None = None
    cap: float | None = None
    delay: float | None = None

    @property
    def profile(self) -> "DeviceProfile | None":
        """Profile of the device by ``--device-profile``; None for the device's own."""
        from hapticdb.devices.profiles import profile_named

        return None if self.device_profile is None else profile_named(self.device_profile)

    def settled(self, rendering: "Rendering") -> "tuple[ForceLaw | None, Coupling]":
        """Law and coupling of a session; UsageError for contradictory options."""
        from hapticdb.query.law import law_named
        from hapticdb.session.coupling import Coupling

        if rendering == "coupled":
            delay = None if self.delay is None else 1e-3 * self.delay
            return None, Coupling(self.stiffness, self.cap, delay=delay, profile=self.profile)
        refuse("with --rendering direct", self, "delay")
        stiffness = 1000.0 if self.stiffness is None else self.stiffness
        law = law_named(self.law or "distance", stiffness)
        return law, Coupling(cap=self.cap, profile=self.profile)


@dataclass(frozen=True)
class RecordOptions:
    """Options of a recording."""

    record: str | None = None
    replace: bool = False
    record_limit: int | None = None

    def settled(self) -> dict[str, Any]:
        """Arguments of a session; UsageError for options of a recording without one."""
        from hapticdb.recording.file import DEFAULT_LIMIT

        if self.record is None:
            refuse("without --record", self)
        return {
            "record": self.record, "replace_recording": self.replace,
            "record_limit_bytes": self.record_limit or DEFAULT_LIMIT,
        }  # fmt: skip


@dataclass(frozen=True)
class LoopOptions:
    """Options of the loop, and of its processor or GPU."""

    rate: float = 1000.0
    seconds: float | None = None
    frames_on: FramesOn = "cpu"
    processor: int | None = None


def feel(
    url: str,
    *,
    tool: ToolOptions,
    hand: HandOptions,
    loop: LoopOptions,
    selection: FilterOptions,
    force: ForceOptions,
    recorded: RecordOptions,
    budget: int = 256 * MIB,
    no_baseline: bool = False,
    output: Output,
) -> None:
    """Feel in real time with a device.

    Example: hapticdb feel car.db --tool spanner.stl --device path.csv --rate 1000 --seconds 10
    """
    from hapticdb.query.law import reads_distances

    began = perf_counter()
    rendering = _begin_loop(force, loop)
    chosen, coupling = force.settled(rendering)
    recording, law = recorded.settled(), force.law or "distance"
    device, path_speed = hand.open(tool.seed or 0, force.profile)
    if hand.device == "random" and tool.tool.lower().endswith(".npz"):
        tool = replace(tool, seed=None)  # it is the hand's
    with hapticdb.open(url, read_only=True) as env:  # before a process starts
        found = selection.resolve(env)
        shell = tool.made(env, law, found.excluded).shell
    session_report.note_cost(
        len(shell), loop.rate, loop.frames_on, reads_distances=reads_distances(law)
    )
    doing = "starting" if no_baseline else "measuring an empty loop, then starting"
    with ExitStack() as stack:
        with render.bar(doing, ""):
            cells = stack.enter_context(hapticdb.ResidentCells(
                url, budget_bytes=budget, where=found.where, exclude=found.exclude,
                distances=None if force.law is None else reads_distances(force.law),
            ))  # fmt: skip
            session = stack.enter_context(hapticdb.Session(
                cells, shell, device, law=chosen, rendering=rendering, coupling=coupling,
                handle=hapticdb.Handle(scale=hand.scale, clutch=hand.clutch),
                has_baseline=not no_baseline, **vars(loop), **recording,
            ))  # fmt: skip
        with ended_by_signals(session.request_end) as signals:
            report = _waited_for(session, force.stiffness, loop.seconds)
        shown = partial(session_report.show, report, session.cells, shell, recorded.record)
        values = session_report.record_of(report, shell, path_speed)
        output.emit(values, partial(shown, path_speed, began))
    exit_by(signals, f" after {report.loop.seconds:.3g} s")
    if report.database_lost is not None or report.stale_frames:
        raise typer.Exit(1)


def _begin_loop(force: ForceOptions, loop: LoopOptions) -> "Rendering":
    """Start the fork server, check the loop; returns the rendering."""
    from hapticdb.session.processes.fork_server import prepare

    # at once: another interpreter with numba takes as long to load as all that is done here
    prepare("hapticdb.session.worker:work", with_kernels=True)
    prepare("hapticdb.session.prefetch.fetching:fetch", with_kernels=True)
    from hapticdb.query.law import DISTANCE, as_law
    from hapticdb.session.coupling import rendering_of

    chosen = rendering_of(force.rendering, as_law(force.law) or DISTANCE)
    if loop.frames_on != "cpu":
        from hapticdb.session.gpu_queries import check_frames

        check_frames(loop.frames_on, chosen)

    with render.bar("loading", ""):
        from hapticdb.session.timing import Timing

    Timing(processor=loop.processor)
    return chosen


def _waited_for(session: "Session", stiffness: float | None, seconds: float | None) -> "Report":
    """Wait for a session's end; urgent notes are printed meanwhile."""
    lowered = getattr(session.coupling, "lowered", None)
    if stiffness is not None and lowered is not None:
        render.note(lowered)
    report, notes, n_queries = None, session_report.Notes(), 0
    with render.bar("feeling; Ctrl-C ends it", "s") as progress:
        while report is None:
            report = session.wait(POLL_EVERY)
            notes.poll(session)
            n_queries += 1
            # a tool may be inside an object briefly
            if n_queries % 3 == 0 or report is not None:
                notes.report_objects(session)
            if progress is not None:
                progress(session.n_frames / session.timing.rate, round(seconds or 0.0))
    return report


def replay(recording: str, url: str | None = None, *, output: TableOutput) -> None:
    """Run a recorded session again.

    Tool, wrench and contacts are compared. The exit code is 0 if all frames are equal bit for bit,
    1 if some differ or there was none to compare; the first difference is printed with its reason.
    --csv writes the recorded frames and compares nothing; it needs no environment.

    Example: hapticdb replay session.hdbrec car.db
    """
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
