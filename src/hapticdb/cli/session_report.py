"""Report of a session, as `feel` prints it."""

from collections.abc import Sequence
from contextlib import suppress
from time import perf_counter
from typing import TYPE_CHECKING, Any

import hapticdb
from hapticdb.cli import render
from hapticdb.cli.tool_options import shell_record, shell_text
from hapticdb.errors import DatabaseError
from hapticdb.tabular.schema import plain
from hapticdb.units import length_text

if TYPE_CHECKING:
    from hapticdb.pointshell.shell import PointShell
    from hapticdb.session.prefetch.resident_cells import ResidentCells
    from hapticdb.session.report import Report
    from hapticdb.session.session import Session

MOST_NAMED = 8
"""Names of touched objects in the report; further ones are counted."""
PERCENTILES = {"p50": "p50", "p99": "p99", "p99.9": "p999", "worst": "worst"}
"""Headings of the percentiles, and their fields in a `Spread`."""

POINT_NS = {False: (50.0, 50.0), True: (100.0, 600.0)}
"""Nanoseconds of a frame for each tool point near a surface, without and with distances: in tools
of up to `IN_CACHE` points, and in larger ones (57,600 on a plane, and results/realtime.json)."""
IN_CACHE = 10_000

Facts = list[tuple[str, str]]


def note_cost(n_points: int, rate: float, frames_on: str = "cpu", *, reads_distances: bool) -> None:
    """Note the cost of a tool if its frames may exceed the period on a processor."""
    seconds = 1e-9 * n_points * POINT_NS[reads_distances][n_points > IN_CACHE]
    if rate > 0.0 and seconds > 1.0 / rate and frames_on == "cpu":
        render.note(
            f"a frame with all of the tool's {n_points:,} points near a surface takes about "
            f"{1e3 * seconds:.2g} ms, and {rate:,.0f} Hz leave {1e3 / rate:.2g} ms: give fewer "
            "--points, a lower --rate, or --frames-on cuda"
        )


def record_of(report: "Report", shell: "PointShell", path_speed: float | None) -> dict[str, Any]:
    """Report for JSON; path_speed : as for `show`."""
    values: dict[str, Any] = {"path_speed": path_speed, "shell": shell_record(shell)}
    values |= plain(report)
    values["touched"] = values.pop("objects")
    return values


def show(
    report: "Report", cells: "ResidentCells", shell: "PointShell", recording: str | None,
    path_speed: float | None, began: float,
) -> None:  # fmt: skip
    """Print the loop's timing next to the empty loop's, then the events of the session.

    recording : file of its recording; path_speed : assumed for a path without times, m/s; began :
    start of the verb, as of `perf_counter`.
    """
    cache = report.cache
    _show_loops(report)
    resident, fetched = (render.counted(n, "cell") for n in (cache.resident, cache.loaded))
    frames = report.unknown_frames, report.held_frames, report.hit_frames
    unknown, held, hit = (render.counted(n, "frame") for n in frames)
    touched = f"{len(report.objects)} touched{_names_after(cells, report.objects)}"
    inside = inside_text(report, cells) if report.inside_frames else ""
    speed = f"{path_speed} m/s: the path has no times (column t); --speed"
    render.facts([
        ("shell", shell_text(shell)),
        ("touching", f"{hit} hit, {report.contact_frames:,} in contact"),
        ("not known", f"{unknown} with cells that were not in memory yet"),
        ("force held", f"{held}, {report.stale_frames:,} of them without a database"),
        *_force_facts(report),
        ("resident", f"{resident} in {cache.budget_bytes / 2**20:.4g} MiB"),
        ("fetched", f"{fetched}, {1e3 * cache.worst:.3g} ms at worst"),
        *[("in something", text) for text in (inside,) if text],
        ("objects", touched),
        *_exceptional_facts(report),
        *[("played at", speed) for one in (path_speed,) if one is not None],
        *[("recorded", _recording_text(report, one)) for one in (recording,) if one],
        ("took", f"{perf_counter() - began:.1f} s in all"),
        *sorted(report.conditions.items()),
    ])  # fmt: skip


def _show_loops(report: "Report") -> None:
    """Print frames, deadlines and times of the session, and of the empty loop if it ran."""
    loops = [loop for loop in (report.loop, report.empty) if loop is not None]
    rows = [
        ("frames", *(f"{loop.frames:,}" for loop in loops)),
        ("rate, Hz", *(f"{loop.rate:,.1f}" for loop in loops)),
        ("missed deadlines", *(f"{loop.missed:,}" for loop in loops)),
    ]
    for what, times in (("late", "lateness"), ("computing", "elapsed")):
        for name, field in PERCENTILES.items():
            spreads = (getattr(loop, times) for loop in loops)
            figures = (f"{1e6 * getattr(spread, field):,.1f}" for spread in spreads)
            rows.append((f"{what} {name}, µs", *figures))
    render.table(("", "session>", "empty loop>")[: 1 + len(loops)], rows)


def _force_facts(report: "Report") -> Facts:
    """Law and coupling, the greatest force, and interventions for stability."""
    from hapticdb.session.coupling import SettledCoupling, limit_text

    spring = report.coupling
    facts = [("force law", report.law), ("rendering", "coupled: the hand feels a spring")]
    if isinstance(spring, SettledCoupling):
        lowered = "" if spring.lowered is None else f"; {spring.lowered}"
        facts.append(("stiffness", f"{spring.stiffness:.4g} N/m at the device{lowered}"))
    else:
        facts[1] = ("rendering", "direct: each frame's wrench goes to the device")
    caps = f"{spring.cap:.4g} N, {spring.torque_cap:.3g} N m (profile {spring.profile})"
    facts.append(("at most", caps))
    limit = limit_text(report.peak_force, spring.cap)
    peak = (
        f"{report.peak_force:.4g} N{limit}; {report.peak_torque:.4g} N m at the device; "
        f"deepest contact {length_text(report.deepest)}"
    )
    facts.append(("peak", peak))
    if report.guard_actions:
        times = render.counted(report.guard_actions, "time")
        left = f"to {100.0 * report.least_share:.0f} %"
        facts.append(("guard", f"the force went back and forth: stiffness lowered {times}, {left}"))
    return facts


def inside_text(report: "Report", cells: "ResidentCells") -> str:
    """Sentence on the time of the tool inside objects, without force."""
    frames, first = report.inside_frames, report.first_inside_frame
    start = f"from second {first / report.rate:.3g} on it was" if first else "it began"
    inside = _in_objects(cells, report.enclosing_objects)
    end = "it never came free" if report.ended_inside else "until it was free"
    counted = render.counted(frames, "frame")
    return f"{start} inside {inside}: no force for {counted} ({frames / report.rate:.3g} s), {end}"


class Notes:
    """Live notes on the command line: reasons for a missing force, and a recording's end."""

    def __init__(self) -> None:
        self._inside_polls = 0
        self._is_lost = self._is_cut = False

    def poll(self, session: "Session") -> None:
        """Report the loss and the return of the database, and the end of the recording."""
        lost = session.database_lost
        if lost is not None and not self._is_lost:
            render.note(f"{lost}; until then no force is felt")
        elif lost is None and self._is_lost:
            render.note("the database is back: surfaces are felt again")
        self._is_lost = lost is not None
        if session.recording_ended is not None and not self._is_cut:
            render.note(f"{session.recording_ended}; the session goes on without it")
            self._is_cut = True

    def report_objects(self, session: "Session") -> None:
        """Report a tool inside an object; the object's name may arrive one call later."""
        if self._is_lost:  # nothing is known
            return
        if session.is_loose:
            self._inside_polls += 1
            if self._inside_polls <= 2 and (self._inside_polls == 2 or session.enclosing_objects):
                inside = _in_objects(session.cells, session.enclosing_objects)
                render.note(
                    f"the tool is inside {inside}: nothing is felt until it is free; draw it out"
                )
                self._inside_polls = 2
        elif self._inside_polls:
            if self._inside_polls > 1:
                render.note("the tool is free: from now on surfaces are felt")
            self._inside_polls = 0


def _exceptional_facts(report: "Report") -> Facts:
    """Rare events: missing cells at the start, bad readings, outages, a standby."""
    facts: Facts = []
    cache = report.cache
    if not report.is_warm:
        facts.append(("warm start", "it began although cells were missing"))
    if report.empty is None:
        facts.append(("empty loop", "not measured (--no-baseline)"))
    if report.bad_reading is not None:
        held = render.counted(report.invalid_frames, "frame")
        facts.append(("hand nowhere", f"{held}: {report.bad_reading}"))
    if cache.losses or cache.restarts:
        fetching = f"{cache.restarts:,} of the process that fetches"
        facts.append(("outages", f"{cache.losses:,} of the database, {fetching}"))
    if cache.lag is not None:
        old = f"{cache.lag:.3g} s old"
        facts.append(("standby", f"the last commit that it has replayed: {old}"))
    return facts


def _recording_text(report: "Report", recording: str) -> str:
    lost = f", {report.lost_records:,} lost" if report.lost_records else ""
    ended = ", not to the end" if report.recording_ended else ""
    return f"{report.recorded_frames:,} frames in {recording}{lost}{ended}"


def _in_objects(cells: "ResidentCells", ids: Sequence[int]) -> str:
    """Names of the objects around a tool, for a sentence."""
    return _names_after(cells, ids).removeprefix(": ") or "an object"


def _names_after(cells: "ResidentCells", ids: Sequence[int]) -> str:
    """Colon and names of objects, '' for none; ids of new ones while the database is lost."""
    names = {obj.id: obj.name for obj in cells.first_objects}
    with suppress(DatabaseError):
        if not set(ids) <= set(names) and cells.database_lost is None:
            with hapticdb.open(cells.url, read_only=True) as env:
                names = {obj.id: obj.name for obj in env.objects()}
    listed = [names.get(i, f"object {i}") for i in ids]
    shown = ", ".join(listed[:MOST_NAMED])
    more = f" and {len(listed) - MOST_NAMED} more" if len(listed) > MOST_NAMED else ""
    return f": {shown}{more}" if shown else ""
