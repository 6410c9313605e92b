"""The verb feel."""

from contextlib import ExitStack
from dataclasses import dataclass, replace
from functools import partial
from time import perf_counter
from typing import TYPE_CHECKING, Any

import typer

import hapticdb
from hapticdb.cli import render, session_report
from hapticdb.cli.device_options import HandOptions
from hapticdb.cli.emit import Output
from hapticdb.cli.options import FramesOn, LawName, RenderingName
from hapticdb.cli.root import ended_by_signals, exit_by
from hapticdb.cli.selection import FilterOptions
from hapticdb.cli.tool_options import ToolOptions
from hapticdb.cli.values import MIB, refuse

if TYPE_CHECKING:
    from hapticdb.devices.profiles import DeviceProfile
    from hapticdb.query.law import ForceLaw
    from hapticdb.session.coupling import Coupling, Rendering
    from hapticdb.session.report import Report
    from hapticdb.session.session import Session

POLL_EVERY = 0.1
"""Seconds between two polls of the session: delay of its notes."""


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
        page = session_report.SessionPage(report, session.cells, shell, recorded.record, path_speed)
        output.emit(page.record(), partial(page.show, began))
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
