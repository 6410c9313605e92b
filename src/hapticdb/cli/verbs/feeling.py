"""The verb feel."""

import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from time import perf_counter
from typing import TYPE_CHECKING, Annotated

import typer

import hapticdb
from hapticdb.cli import render, session_page
from hapticdb.cli.choosing import Felt, felt_objects
from hapticdb.cli.forces import law_and_coupling
from hapticdb.cli.hands import HandOptions
from hapticdb.cli.options import (
    BudgetOption,
    ConservativeOption,
    ExcludeOption,
    FramesOn,
    JsonOption,
    LawName,
    LawOption,
    PointsOption,
    RenderingName,
    ToolOption,
    ToolUnitOption,
    UrlArgument,
    WhereOption,
    length_option,
)
from hapticdb.cli.root import TERMINATED, Interrupted, ended_by_signals
from hapticdb.cli.tools import tool_of, warn_of_size
from hapticdb.cli.values import Point, budget_bytes, point_of, size_bytes
from hapticdb.devices.profiles import profile_named
from hapticdb.errors import UsageError

if TYPE_CHECKING:
    from hapticdb.pointshell.kept import Tool
    from hapticdb.pointshell.shell import PointShell
    from hapticdb.session.coupling import Rendering
    from hapticdb.session.report import Report
    from hapticdb.session.session import Session

LOOK_EVERY, OBJECTS_EVERY = 0.1, 3
"""Seconds between two looks at the session: how late a lost database is reported, or the end of its
recording; and looks between two whether the tool lies in an object, which may last a moment."""

DeviceOption = Annotated[
    str,
    typer.Option(
        metavar="DEVICE",
        help="The hand: poses in a .csv (column t: seconds), a recording .hdbrec, random, "
        "force-dimension, openhaptics or haply.",
    ),
]
RateOption = Annotated[float, typer.Option(metavar="HZ", help="Frames a second.")]
SecondsOption = Annotated[
    float | None,
    typer.Option(metavar="S", help="How long; unless given, until the device ends or Ctrl-C."),
]
SpeedOption = Annotated[
    float | None,
    typer.Option(metavar="M/S", help="Speed along a path, or greatest speed of a random hand."),
]
PlaceOption = Annotated[
    Point | None, length_option("where the hand random is.", parse=point_of, unit="m")
]
SimulateOption = Annotated[
    bool, typer.Option("--simulate", help="Let the force push the hand, as a simulated device.")
]
LoopOption = Annotated[bool, typer.Option("--loop", help="Begin a path again at its end.")]
ScaleOption = Annotated[
    float, typer.Option(metavar="N", help="Metres in the scene for each metre of the hand.")
]
ClutchOption = Annotated[
    int | None,
    typer.Option(
        metavar="BUTTON", help="While this button is down, only the hand moves; 0 is the first."
    ),
]
RecordOption = Annotated[
    str | None, typer.Option(metavar="FILE", help="Record the session: a new .hdbrec.")
]
ReplaceOption = Annotated[
    bool,
    typer.Option("--replace", help="Replace a recording that exists, once there is a first frame."),
]
RecordLimitOption = Annotated[
    str | None,
    typer.Option(
        metavar="SIZE",
        help="Size at which the recording ends and the session goes on: MiB, or such as 4GiB. "
        "It also ends when its disk has 64 MiB left.",
        show_default="4GiB",
    ),
]
FramesOnOption = Annotated[
    FramesOn,
    typer.Option(
        help="What finds the tool's points near surfaces: a processor, or a GPU of NVIDIA for "
        "tools of millions of points.",
    ),
]
RenderingOption = Annotated[
    RenderingName | None,
    typer.Option(
        "--rendering",
        help="coupled: a spring between hand and tool, which stays outside of surfaces; needs "
        "distances. direct: each frame's wrench goes to the device, up to its caps.",
        show_default="coupled; direct with --law plane",
    ),
]
DeviceStiffnessOption = Annotated[
    float | None,
    typer.Option(
        metavar="N/M",
        help="Stiffness that the hand feels; lowered to what the device holds without trembling. "
        "With --rendering direct: of a contact.",
        show_default="the device's, or 1000",
    ),
]
ProfileOption = Annotated[
    str | None,
    typer.Option(
        metavar="NAME",
        help="What the device renders: touch, omni, desktop, premium-1.5, falcon, omega, delta or "
        "sigma.7.",
        show_default="the device's own",
    ),
]
CapOption = Annotated[
    float | None,
    typer.Option(metavar="N", help="Greatest force.", show_default="the device's"),
]
DelayOption = Annotated[
    float | None,
    typer.Option(
        metavar="MS",
        help="Milliseconds from reading the hand's place until its force acts.",
        show_default="the device's, or one period",
    ),
]
HandSeedOption = Annotated[
    int | None,
    typer.Option(
        metavar="N", help="Seed of the points' places, and of a random hand.", show_default="0"
    ),
]
ProcessorOption = Annotated[
    int | None, typer.Option(metavar="N", help="Bind the loop to that processor.")
]
NoBaselineOption = Annotated[
    bool,
    typer.Option(
        "--no-baseline", help="Skip the empty loop that is measured before, for 2 s at most."
    ),
]


def feel(
    url: UrlArgument,
    *,
    tool: ToolOption,
    device: DeviceOption,
    rate: RateOption = 1000.0,
    seconds: SecondsOption = None,
    speed: SpeedOption = None,
    at: PlaceOption = None,
    simulate: SimulateOption = False,
    loop: LoopOption = False,
    scale: ScaleOption = 1.0,
    clutch: ClutchOption = None,
    where: WhereOption = None,
    exclude: ExcludeOption = None,
    record: RecordOption = None,
    replace: ReplaceOption = False,
    record_limit: RecordLimitOption = None,
    budget: BudgetOption = 256.0,
    frames_on: FramesOnOption = "cpu",
    law: LawOption = None,
    rendering: RenderingOption = None,
    conservative: ConservativeOption = False,
    stiffness: DeviceStiffnessOption = None,
    device_profile: ProfileOption = None,
    cap: CapOption = None,
    delay: DelayOption = None,
    tool_unit: ToolUnitOption = None,
    points: PointsOption = None,
    seed: HandSeedOption = None,
    processor: ProcessorOption = None,
    no_baseline: NoBaselineOption = False,
    json: JsonOption = False,
) -> None:
    """Feel an environment in real time with a device; report how well frames kept their time.

    Example: hapticdb feel car.db --tool wrench.stl --device path.csv --rate 1000 --seconds 10
    """
    began = perf_counter()
    chosen_rendering = _begin_loop(law, rendering, processor, frames_on)
    profile = None if device_profile is None else profile_named(device_profile)
    chosen, coupling = law_and_coupling(law, chosen_rendering, stiffness, cap, delay, profile)
    limit_bytes = _recording_limit(record, record_limit, is_replaced=replace)
    hands = HandOptions(device, speed, at, seed or 0, loop, simulate, profile)
    (hand, speed), handle = hands.open(), hapticdb.Handle(scale=scale, clutch=clutch)
    drawn_in = partial(_tool, tool, tool_unit, points, seed, device)
    felt, shell = _looked_at(url, where, exclude, drawn_in, law or "distance", not conservative)
    session_page.tell_cost(len(shell), rate, law or "distance", frames_on)
    begin = partial(
        hapticdb.Session, shell=shell, device=hand, rate=rate, seconds=seconds, handle=handle,
        law=chosen, rendering=chosen_rendering, coupling=coupling, frames_on=frames_on,
        processor=processor, record=record, replace_recording=replace,
        record_limit_bytes=limit_bytes, has_baseline=not no_baseline,
    )  # fmt: skip
    with _begun(begin, url, budget_bytes(budget), felt, law) as session:
        with ended_by_signals(session.ask_to_end) as signals:
            report = _waited_for(session, stiffness, seconds)
        session_page.show(report, session.cells, shell, record, speed, None if json else began)
    _exit_after(signals, report)


@contextmanager
def _begun(
    begin: "partial[Session]", url: str, budget_bytes: int, felt: Felt, law: LawName | None
) -> "Iterator[Session]":
    """Begin a session; its resident cells have distances where the law reads them."""
    is_measured = begin.keywords["has_baseline"]
    doing = "measuring an empty loop, then starting" if is_measured else "starting"
    with ExitStack() as held:
        with render.bar(doing, ""):
            cells = held.enter_context(hapticdb.ResidentCells(
                url, budget_bytes=budget_bytes, where=felt.where, exclude=felt.exclude,
                distances=None if law is None else law == "distance",
            ))  # fmt: skip
            session = held.enter_context(begin(cells))
        yield session


def _tool(
    tool: str, unit: str | None, points: int | None, seed: int | None, device: str, inset: float
) -> "Tool":  # fmt: skip
    """Make the tool, its points drawn inward by `inset` metres."""
    # a saved shell takes no seed, and a random hand does
    is_for_hand_alone = device == "random" and tool.lower().endswith(".npz")
    seed = None if is_for_hand_alone else seed
    return tool_of(tool, unit, points, seed, inset=inset)


def _looked_at(
    url: str,
    where: Sequence[str] | None,
    exclude: Sequence[str] | None,
    drawn_in: "Callable[[float], Tool]",
    law: LawName,
    is_inset: bool,  # noqa: FBT001 - of one call
) -> "tuple[Felt, PointShell]":
    """Filter and shell, before a process starts; `is_inset`: drawn in to the contact."""
    from hapticdb.query.law import inset_of

    with hapticdb.open(url, read_only=True) as env:
        felt = felt_objects(env, where, exclude)
        tool = drawn_in(inset_of(env.grid.voxel_size, law) if is_inset else 0.0)
        warn_of_size(env, tool, felt.left_out)
    return felt, tool.shell


def _recording_limit(record: str | None, limit: str | None, *, is_replaced: bool) -> int:
    """Bytes at which a recording ends; refuses options of a recording where there is none."""
    from hapticdb.recording.file import DEFAULT_LIMIT

    limit_bytes = DEFAULT_LIMIT if limit is None else size_bytes(limit, "--record-limit")
    if record is None and (is_replaced or limit is not None):
        raise UsageError("--replace and --record-limit belong to --record: give it, too")
    return limit_bytes


def _begin_loop(
    law: LawName | None,
    rendering: RenderingName | None,
    processor: int | None,
    frames_on: FramesOn,
) -> "Rendering":
    """Start the fork server, check the loop; returns the rendering."""
    from hapticdb.session.processes.fork_server import prepare

    # at once: another interpreter with numba takes as long to load as all that is done here
    prepare("hapticdb.session.loop:work", with_kernels=True)
    prepare("hapticdb.session.prefetch.fetching:fetch", with_kernels=True)
    from hapticdb.query.law import DISTANCE, as_law
    from hapticdb.session.coupling import rendering_of

    chosen = rendering_of(rendering, as_law(law) or DISTANCE)
    if frames_on != "cpu":
        from hapticdb.session.on_gpu import check_frames

        check_frames(frames_on, chosen)

    with render.bar("loading", ""):
        from hapticdb.session.timing import Timing

    Timing(processor=processor)
    return chosen


def _exit_after(signals: Sequence[int], report: "Report") -> None:
    """Leave with the exit code of the signal that ended the session.

    1 if the database was lost at its end, or so long that frames had no force.
    """
    if signal.SIGTERM in signals:
        render.note(f"ended by SIGTERM after {report.loop.seconds:.3g} s")
        raise typer.Exit(TERMINATED)
    if signals:
        raise Interrupted(f"ended by Ctrl-C after {report.loop.seconds:.3g} s")
    if report.database_lost is not None or report.stale_frames:
        raise typer.Exit(1)


def _waited_for(session: "Session", stiffness: float | None, seconds: float | None) -> "Report":
    """Wait for a session's end; what a person should know at once is told at once."""
    lowered = getattr(session.coupling, "lowered", None)
    if stiffness is not None and lowered is not None:
        render.note(lowered)
    report, notes, n_looks = None, session_page.Notes(), 0
    with render.bar("feeling; Ctrl-C ends it", "s") as progress:
        while report is None:
            report = session.wait(LOOK_EVERY)
            notes.look(session)
            n_looks += 1
            if n_looks % OBJECTS_EVERY == 0 or report is not None:
                notes.look_for_objects(session)
            if progress is not None:
                progress(session.n_frames / session.timing.rate, round(seconds or 0.0))
    return report
