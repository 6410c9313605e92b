"""The verb feel."""

import signal
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from hapticdb.cli import fitting, render
from hapticdb.cli.choosing import Exclude, ids_of
from hapticdb.cli.root import (
    Budget,
    Interrupted,
    Json,
    Points,
    ToolUnit,
    Url,
    bytes_of,
    leave,
    numbers_of,
    size_of,
)
from hapticdb.cli.verbs.touching import shell_of
from hapticdb.interrupting import interrupt

if TYPE_CHECKING:
    from hapticdb.devices.scripted import Device
    from hapticdb.realtime.report import Report, Spread
    from hapticdb.realtime.resident_cells import ResidentCells
    from hapticdb.realtime.session import Session

PolicyName = Literal["hold", "wait"]
MOST_NAMED = 8
TERMINATED = 128 + signal.SIGTERM
DEFAULT_SPEED = 0.3
"""Fastest of a random hand, m/s."""
PATH_SPEED = 0.1
"""Of a path that has no times, m/s."""
LOOK_EVERY = 0.25
"""Seconds between looks whether the recording goes on."""
VENDORS = {
    "force-dimension": ("hapticdb.devices.vendors.force_dimension", "ForceDimensionDevice"),
    "openhaptics": ("hapticdb.devices.vendors.openhaptics", "OpenHapticsDevice"),
    "haply": ("hapticdb.devices.vendors.haply", "HaplyDevice"),
}


def feel(
    url: Url,
    *,
    tool: Annotated[
        str, typer.Option(metavar="FILE", help="Mesh of the tool, or a shell saved as .npz.")
    ],
    device: Annotated[
        str,
        typer.Option(
            metavar="DEVICE",
            help="The hand: poses in a .csv (column t: seconds), a recording .hdbrec, random, "
            "tumble, force-dimension, openhaptics or haply.",
        ),
    ],
    rate: Annotated[float, typer.Option(metavar="HZ", help="Frames a second.")] = 1000.0,
    seconds: Annotated[
        float | None, typer.Option(metavar="S", help="Until the device ends, or Ctrl-C, without.")
    ] = None,
    speed: Annotated[
        float | None,
        typer.Option(metavar="M/S", help="Of a path, and the fastest of a random hand."),
    ] = None,
    at: Annotated[
        str | None, typer.Option(metavar="X,Y,Z", help="Where random and tumble are, metres.")
    ] = None,
    simulate: Annotated[
        bool, typer.Option("--simulate", help="Let the force push back a simulated device.")
    ] = False,
    loop: Annotated[bool, typer.Option("--loop", help="Begin a path anew at its end.")] = False,
    scale: Annotated[
        float, typer.Option(metavar="N", help="Scene metres a metre of the hand.")
    ] = 1.0,
    clutch: Annotated[
        int | None,
        typer.Option(metavar="BUTTON", help="While it is down, 0 the first, only the hand moves."),
    ] = None,
    exclude: Exclude = None,
    record: Annotated[
        str | None, typer.Option(metavar="FILE", help="Record the session: a new .hdbrec.")
    ] = None,
    append: Annotated[
        bool, typer.Option("--append", help="Go on with a recording that is there.")
    ] = False,
    replace: Annotated[
        bool,
        typer.Option("--replace", help="Record anew in its place, once there is a first frame."),
    ] = False,
    record_limit: Annotated[
        str | None,
        typer.Option(
            metavar="SIZE",
            help="Size at which the recording ends and the session goes on: MiB, or such as 4GiB. "
            "It also ends when its disk has 64 MiB left.",
            show_default="4GiB",
        ),
    ] = None,
    budget: Budget = 256.0,
    policy: Annotated[
        PolicyName,
        typer.Option(
            help="Where cells are not there yet: hold the force for 20 ms and let it fall, or wait."
        ),
    ] = "hold",
    staleness: Annotated[
        float, typer.Option(metavar="S", help="Silence of the database after which force falls.")
    ] = 1.0,
    stiffness: Annotated[float, typer.Option(metavar="N/M", help="Of the force law.")] = 1000.0,
    tool_unit: ToolUnit = None,
    points: Points = None,
    seed: Annotated[
        int | None,
        typer.Option(metavar="N", help="Of the points, and of a random hand.", show_default="0"),
    ] = None,
    fifo: Annotated[bool, typer.Option("--fifo", help="Ask the system for SCHED_FIFO.")] = False,
    processor: Annotated[
        int | None, typer.Option(metavar="N", help="Bind the loop to that processor.")
    ] = None,
    no_baseline: Annotated[
        bool,
        typer.Option("--no-baseline", help="Skip the empty loop that is run before, 2 s at most."),
    ] = False,
    json: Json = False,
) -> None:
    """Feel an environment in real time with a device; report how well frames kept their time.

    Example: hapticdb feel car.db --tool wrench.stl --device path.csv --rate 1000 --seconds 10
    """
    import hapticdb
    from hapticdb.errors import UsageError
    from hapticdb.realtime.deadlines import Timing
    from hapticdb.realtime.handle import Handle
    from hapticdb.realtime.resident_cells import ResidentCells
    from hapticdb.realtime.session import Session
    from hapticdb.recording.file import DEFAULT_LIMIT

    law = hapticdb.TangentPlane(stiffness)
    budget_bytes = bytes_of(budget)
    limit_bytes = DEFAULT_LIMIT if record_limit is None else size_of(record_limit, "--record-limit")
    if (append or replace) and record is None:
        raise UsageError(
            "--append and --replace belong to --record: give it, too, or leave both out"
        )
    if record_limit is not None and record is None:
        raise UsageError("--record-limit belongs to --record: give it, too, or leave both out")
    Timing(processor=processor).check_granted()  # before a kernel is compiled
    if device in VENDORS and policy == "wait":
        raise UsageError(f"--policy wait: a real hand, {device}, cannot wait; leave it out")
    assumed = _assumed_speed(device, speed)
    hand = _device(
        device,
        speed=speed if assumed is None else assumed,
        at=at,
        seed=seed or 0,
        loops=loop,
        is_simulated=simulate,
    )
    handle = Handle(scale=scale, clutch=clutch)
    excluded: list[int] = []
    if exclude:
        with hapticdb.open(url, read_only=True) as env:
            excluded = ids_of(env, exclude, "--exclude")
    render.compile_kernels("feel", files=[tool])
    # a saved shell takes no seed, and a random hand does
    is_for_hand_alone = device == "random" and tool.lower().endswith(".npz")
    shell = shell_of(tool, tool_unit, points, None if is_for_hand_alone else seed)
    with ResidentCells(url, budget_bytes=budget_bytes, exclude=excluded) as cells:
        with (
            Session(
                cells,
                shell,
                hand,
                rate=rate,
                seconds=seconds,
                law=law,
                handle=handle,
                policy=policy,
                staleness=staleness,
                record=record,
                append_recording=append,
                replace_recording=replace,
                record_limit_bytes=limit_bytes,
                is_fifo=fifo,
                processor=processor,
                has_baseline=not no_baseline,
            ) as session,
            _ended_by_signals(session) as signals,
        ):
            fitting.tell(session.proportions, tool, "--scale")
            report = _waited_for(session)
        if json:
            render.say_json(report.figures() | {"path_speed": assumed})
        else:
            _show(report, cells, record, assumed)
    if signal.SIGTERM in signals:
        render.note(f"ended by SIGTERM after {report.loop.seconds:.3g} s")
        raise typer.Exit(TERMINATED)
    if signals:
        raise Interrupted(f"ended by Ctrl-C after {report.loop.seconds:.3g} s")


def _waited_for(session: "Session") -> "Report":
    """Wait for a session's end; of a recording that ends before, tell at once."""
    report, is_told = None, False
    while report is None:
        report = session.wait(LOOK_EVERY)
        if session.recording_ended is not None and not is_told:
            render.note(f"{session.recording_ended}; the session goes on without it")
            is_told = True
    return report


@contextmanager
def _ended_by_signals(session: "Session") -> Iterator[list[int]]:
    """Let Ctrl-C or SIGTERM end the session, with its report, and a second one the program.

    Yields the signals that came.
    """
    came: list[int] = []
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    before = {  # another's handler stays
        number: handler
        for number, handler in handlers.items()
        if handler in {signal.default_int_handler, interrupt, leave}
    }

    def end(number: int, _: object) -> None:
        came.append(number)
        session.ask_to_end()
        signal.signal(number, before[signal.Signals(number)])

    for number in before:
        signal.signal(number, end)
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _device(
    word: str,
    *,
    speed: float | None,
    at: str | None,
    seed: int,
    loops: bool,
    is_simulated: bool,
) -> "Device":
    """The hand that a word names."""
    from importlib import import_module

    from hapticdb.devices import scripted
    from hapticdb.devices.simulated import SimulatedDevice
    from hapticdb.errors import UsageError
    from hapticdb.recording.file import Recording

    if seed < 0:
        raise UsageError(f"--seed {seed}: give 0 or more")
    place = numbers_of(at, [3], "--at", "metres, such as 0.5,0,1.2") if at is not None else None
    if word in {"random", "tumble"} and place is None:
        raise UsageError(f"--device {word}: give --at, where the hand is")
    if word not in {"random", "tumble"} and place is not None:
        raise UsageError(f"--at belongs to random and tumble, not to {word}")
    if loops and word in {"random", "tumble"}:
        raise UsageError(f"--loop: --device {word} has no end; leave it out")
    if speed is not None and (word == "tumble" or word.lower().endswith(".hdbrec")):
        raise UsageError(f"--speed: --device {word} has its own; leave it out")
    hand: Device
    if word in VENDORS:
        if is_simulated or loops or speed is not None:
            raise UsageError(
                f"--device {word} is a real hand: leave out --simulate, --loop, --speed"
            )
        module, name = VENDORS[word]
        hand = getattr(import_module(module), name)()
        return hand
    if word == "random":
        hand = scripted.RandomHand(place or (), seed, DEFAULT_SPEED if speed is None else speed)
    elif word == "tumble":
        hand = scripted.Tumble(place or ())
    elif word.lower().endswith(".hdbrec"):
        times, poses = Recording(word).poses()
        hand = scripted.Player(times, poses, loops=loops)
    elif word.lower().endswith(".csv"):
        hand = scripted.Path(word, speed=speed, loops=loops)
    else:
        raise UsageError(
            f"--device {word!r}: give poses in a .csv, a .hdbrec, random, tumble, "
            f"{', '.join(VENDORS)}"
        )
    return SimulatedDevice(hand) if is_simulated else hand


def _assumed_speed(device: str, speed: float | None) -> float | None:
    """Speed, m/s, at which a path of poses without times is played when none is asked for."""
    from hapticdb.poses import read_timed_poses

    if speed is not None or not device.lower().endswith(".csv"):
        return None
    return PATH_SPEED if read_timed_poses(device)[0] is None else None


def _show(
    report: "Report", cells: "ResidentCells", record: str | None, assumed: float | None
) -> None:
    """Print what a session was like, the empty loop beside it."""
    loops = [loop for loop in (report.loop, report.empty) if loop is not None]
    columns = ("", "session>", "empty loop>")[: 1 + len(loops)]
    rows = [
        ("frames", *(f"{loop.frames:,}" for loop in loops)),
        ("rate, Hz", *(f"{loop.rate:,.1f}" for loop in loops)),
        ("missed deadlines", *(f"{loop.missed:,}" for loop in loops)),
        *_times("late", [loop.lateness for loop in loops]),
        *_times("computing", [loop.elapsed for loop in loops]),
    ]
    render.show(render.table(columns, rows))
    cache = report.cache
    facts = [
        (
            "touching",
            (
                f"{render.counted(report.hit_frames, 'frame')} with a hit, "
                f"{report.contact_frames:,} in contact, "
                f"{report.cut_frames:,} held back at surfaces"
            ),
        ),
        (
            "not known",
            (
                f"{render.counted(report.unknown_frames, 'frame')}, of {report.points:,} points "
                f"{100 * (1 - report.hit_rate):.3g} %"
            ),
        ),
        (
            "force held",
            (
                f"{render.counted(report.held_frames, 'frame')}, "
                f"{report.stale_frames:,} while the database was silent"
            ),
        ),
        (
            "resident",
            (
                f"{render.counted(cache.resident, 'cell')}, and {cache.empty:,} known to be empty, "
                f"in {cache.budget_bytes / 2**20:.4g} MiB"
            ),
        ),
        (
            "fetched",
            (
                f"{render.counted(cache.loaded, 'cell')} in "
                f"{render.counted(cache.statements, 'statement')}, "
                f"{1e3 * cache.latency:.3g} ms each, {1e3 * cache.worst:.3g} ms at worst; "
                f"{cache.evicted:,} evicted"
            ),
        ),
        ("warm start", f"{1e3 * report.warm_up:.3g} ms" + _cold_clause(report)),
        (
            "peak",
            (
                f"{report.peak_force:.4g} N, {report.peak_torque:.4g} N m, "
                f"{render.metres(report.deepest)} deep"
            ),
        ),
        ("objects", _named(report, cells)),
    ]
    if report.empty is None:
        facts.append(("empty loop", "not measured (--no-baseline)"))
    if report.bad_reading is not None:
        held = render.counted(report.nowhere_frames, "frame")
        facts.append(("hand nowhere", f"{held}: {report.bad_reading}"))
    if cache.losses or cache.restarts:
        facts.append(
            (
                "outages",
                (
                    f"{cache.losses:,} of the database, {cache.restarts:,} of the process that "
                    "fetches"
                ),
            )
        )
    if assumed is not None:
        facts.append(("played at", f"{assumed} m/s: the path has no times (column t); --speed"))
    if record is not None:
        lost = f", {report.lost_records:,} lost" if report.lost_records else ""
        lost += ", not to the end" if report.recording_ended else ""
        facts.append(("recorded", f"{report.recorded_frames:,} frames in {record}{lost}"))
    facts += sorted(report.conditions.items())
    render.show(render.facts(facts))


def _cold_clause(report: "Report") -> str:
    return "" if report.is_warm else ", and begun although cells were missing"


def _times(what: str, spreads: "list[Spread]") -> list[tuple[str, ...]]:
    """Rows of percentiles, microseconds."""
    return [
        (f"{what} {name}, µs", *(f"{1e6 * getattr(spread, field):,.1f}" for spread in spreads))
        for name, field in (("p50", "p50"), ("p99", "p99"), ("p99.9", "p999"), ("worst", "worst"))
    ]


def _named(report: "Report", cells: "ResidentCells") -> str:
    """Names of objects that were touched; ids where the database is away."""
    import hapticdb
    from hapticdb.errors import DatabaseError

    names: dict[int, str] = {}
    with suppress(DatabaseError):
        if not cells.is_away:
            with hapticdb.open(cells.url, read_only=True) as env:
                names = {obj.id: obj.name for obj in env.objects()}
    touched = [names.get(i, f"object {i}") for i in report.objects]
    shown = ", ".join(touched[:MOST_NAMED])
    more = f" and {len(touched) - MOST_NAMED} more" if len(touched) > MOST_NAMED else ""
    return f"{len(touched)} touched" + (f": {shown}{more}" if shown else "")
