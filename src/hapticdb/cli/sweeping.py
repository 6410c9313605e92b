"""The verb sweep."""

from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hapticdb.cli import fitting, render
from hapticdb.cli.choosing import Exclude, Parts, ids_of
from hapticdb.cli.root import Budget, Json, PathUnit, Points, Seed, ToolUnit, UpName, Url, bytes_of
from hapticdb.cli.touching import DEFAULT_POINTS, shell_of

if TYPE_CHECKING:
    from hapticdb.environment import Environment
    from hapticdb.pointshell import PointShell
    from hapticdb.realtime.swept import Clearance, Deepest, Moment, Swept
    from hapticdb.store.base import Object

MOST_OBJECTS = 20
MOST_NAMED = 3
DOUBTFUL = 3
"""Exit code of "comes out" where tool, path and scene do not fit."""


def sweep(
    url: Url,
    *,
    tool: Annotated[
        str | None, typer.Option(metavar="FILE", help="Mesh of the tool, or a shell saved as .npz.")
    ] = None,
    part: Parts = None,
    path: Annotated[
        str,
        typer.Option(metavar="CSV", help="Poses x,y,z,qw,qx,qy,qz with a header."),
    ],
    exclude: Exclude = None,
    clearance: Annotated[
        float | None,
        typer.Option(
            metavar="M",
            help="Look so far for what is near; 0: not at all.",
            show_default="32 voxels",
        ),
    ] = None,
    budget: Budget = 256.0,
    tool_unit: ToolUnit = None,
    path_unit: PathUnit = None,
    points: Points = None,
    seed: Seed = None,
    as_given: Annotated[
        bool,
        typer.Option(
            "--as-given", help="Sizes and places are as they should be: exit code 0 or 1."
        ),
    ] = False,
    picture: Annotated[
        str | None, typer.Option(metavar="PNG", help="Draw the path, its hits and clearance.")
    ] = None,
    up: Annotated[
        UpName | None,
        typer.Option(help="Axis that points up in the picture.", show_default="the files'"),
    ] = None,
    json: Json = False,
) -> None:
    """Say whether a tool or part comes out along a path: what it hits, where, how near it comes.

    Between two poses the tool's middle moves straight while the tool turns about
    it, in steps in which no point moves more than half a voxel. Segment 0 leads
    from pose 0 to pose 1.

    With --part, objects are the tool: all of them together, rigid, left out of
    what is felt. The poses are displacements from where they sit: x,y,z 0 and
    qw 1 is their place. A sub-assembly's name means all that is below it;
    'hapticdb objects --help' says how names choose objects.

    The exit code is 0 when nothing is hit, 1 when anything is, and 3 when
    nothing is hit, but the sizes or places of tool, path and scene do not fit,
    as a line then says: --as-given if they are meant so.

    Example: hapticdb sweep car.db --part 17 --path out.csv --picture out.png
    """
    import hapticdb
    from hapticdb.errors import UsageError
    from hapticdb.poses import read_poses
    from hapticdb.realtime.sweep import sweep as swept_by

    if (tool is None) == (not part):
        raise UsageError("give one of --tool and --part")
    if part and tool_unit is not None:
        raise UsageError("--tool-unit is of a --tool; a part has the unit that it was imported in")
    if picture is not None and Path(picture).suffix.lower() != ".png":
        raise UsageError(f"--picture {picture!r}: give a name that ends with .png")
    budget_bytes = bytes_of(budget)
    poses = read_poses(path, unit=path_unit or "m")
    with hapticdb.open(url, read_only=True) as env:
        parts = ids_of(env, part, "--part")
        excluded = sorted({*parts, *ids_of(env, exclude, "--exclude")})
        render.compile_kernels("sweep", files=[tool] if tool else [])
        if tool is not None:
            shell = shell_of(tool, tool_unit, points, seed)
        else:
            shell = env.shell(
                *parts, points=DEFAULT_POINTS if points is None else points, seed=seed or 0
            )
        fit = fitting.compare(
            env, shell, poses, exclude=excluded, tool=tool, tool_unit=tool_unit,
            path_unit=path_unit, is_moving=True,
        )  # fmt: skip
        with _bar() as progress:
            found = swept_by(
                env,
                shell,
                poses,
                exclude=excluded,
                budget_bytes=budget_bytes,
                clearance_limit=clearance,
                profile=picture is not None,
                progress=progress,
            )
        if env.store.revision() != found.revision:
            render.note(f"{env.url} was written meanwhile; this is of revision {found.revision}")
        try:
            if json:
                render.say_json(
                    _record(found, shell, parts, excluded) | {"proportions": fit.record()}
                )
            else:
                _show(env, found, shell)
        finally:  # also when who reads, such as head, has enough
            if picture is not None:
                from hapticdb.sweep_picture import draw_sweep

                draw_sweep(
                    picture, env, shell, found, exclude=excluded, verdict=_verdict(found), up=up
                )
    if not json and picture is not None:
        render.say(f"picture: {picture}")
    if not found.comes_out:
        raise typer.Exit(1)
    if fit.misfits and not as_given:
        raise typer.Exit(DOUBTFUL)


@contextmanager
def _bar() -> Iterator[Callable[[int, int], None] | None]:
    """Show a bar with samples a second and time left; nothing where nobody looks."""
    import sys

    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(file=sys.stderr), transient=True) as bar:
        task = bar.add_task("sweeping", total=None)
        yield lambda done, total: bar.update(task, completed=done, total=total)


# -- for people -----------------------------------------------------------------------------------


def _verdict(found: "Swept") -> str:
    """One line: whether it comes out, and if not, what is in the way first."""
    samples = f"{found.samples:,} sample{'s' * (found.samples > 1)}"
    if found.first_hit is None:
        return f"comes out: no hit in {samples}{_clearance_clause(found.clearance)}"
    is_start = found.first_hit.sample == 0 and len(found.hit_intervals) == 1
    if is_start and found.hit_intervals[0, 1] < 1.0:
        free = _percent(found.hit_intervals[0, 1])
        met = _names([one.object for one in found.objects])
        return f"touches {met} where it starts; no hit after {free} of the path"
    if found.first_contact is None:
        return (
            f"grazes {_names(found.first_hit.objects)} at {_where(found, found.first_hit)}: "
            "within a voxel, without contact"
        )
    contact = found.first_contact
    return f"is caught: first contact at {_where(found, contact)} with {_names(contact.objects)}"


def _clearance_clause(clearance: "Clearance | None") -> str:
    if clearance is None:
        return ""
    if clearance.moment is None:
        return f", nothing nearer than {render.metres(clearance.distance)}"
    return (
        f", least clearance {render.metres(clearance.distance)} "
        f"from {_names(clearance.moment.objects)}"
    )


def _percent(fraction: float) -> str:
    return f"{100 * fraction:.3g} %"


def _where(found: "Swept", moment: "Moment") -> str:
    """Where on the path: ``31 % of the path (segment 4)``."""
    segment = f" (segment {moment.segment})" if len(found.path.poses) > 2 else ""
    return f"{_percent(moment.fraction)} of the path{segment}"


def _names(objects: "Sequence[Object]") -> str:
    names = [obj.name for obj in objects]
    more = len(names) - MOST_NAMED
    return ", ".join(names[:MOST_NAMED]) + (f" and {more} more" if more > 0 else "")


def _show(env: "Environment", found: "Swept", shell: "PointShell") -> None:
    render.say(_verdict(found))
    if found.objects:
        rows = [
            (
                str(one.object.id),
                one.object.name,
                f"{_percent(one.first)} to {_percent(one.last)}",
                f"{one.samples:,}",
                f"{one.contacts:,}",
                render.metres(one.deepest) if one.deepest > 0.0 else "-",
            )
            for one in found.objects[:MOST_OBJECTS]
        ]
        columns = ("id>", "hit", "of the path>", "samples>", "in contact>", "deepest>")
        render.show(render.table(columns, rows))
        if len(found.objects) > MOST_OBJECTS:
            render.say(f"{len(found.objects)} objects, {MOST_OBJECTS} of them shown")
    render.show(render.facts(_facts(env, found, shell)))


def _facts(env: "Environment", found: "Swept", shell: "PointShell") -> list[tuple[str, str]]:
    size = env.grid.voxel_size
    way = f"{len(found.path.poses):,} poses given, {found.samples:,} samples"
    rows = [
        ("path", f"{way}, no point moves more than {render.metres(0.5 * size)} between two"),
        ("tool", f"{len(shell)} points, {render.metres(_spacing(shell))} apart (median)"),
        ("hits", f"{found.hits:,} samples hit, {found.contacts:,} in contact"),
    ]
    if found.deepest is not None and found.deepest.depth > 0.0:
        rows.append(("deepest", _deepest_text(found.deepest)))
    if found.clearance is not None and found.comes_out:
        rows.append(("clearance", _clearance_text(found.clearance)))
    rate = f"{found.samples / max(found.elapsed, 1e-9):,.0f} poses a second"
    rows.append(("took", f"{found.elapsed:.2f} s, {rate}, {found.cells:,} cells fetched"))
    return rows


def _deepest_text(deepest: "Deepest") -> str:
    return (
        f"{render.metres(deepest.depth)} at {_percent(deepest.moment.fraction)}, in "
        f"{_names(deepest.moment.objects)}, at {_place(deepest.point)} m"
    )


def _place(point: "Iterable[float]") -> str:
    return f"({', '.join(f'{x:.4g}' for x in point)})"


def _clearance_text(clearance: "Clearance") -> str:
    """What the number means: a surface lies somewhere in its voxel."""
    if clearance.moment is None:
        return f"no voxel nearer than {render.metres(clearance.distance)}; farther is not looked"
    return (
        f"{render.metres(clearance.distance)} from a voxel of {_names(clearance.moment.objects)} "
        f"at {_percent(clearance.moment.fraction)}: its surface is "
        f"{render.metres(clearance.at_least)} to {render.metres(clearance.at_most)} from the points"
    )


def _spacing(shell: "PointShell") -> float:
    """Median distance from a point to its nearest neighbour, metres; of a thousand of them."""
    import numpy as np
    from scipy.spatial import cKDTree

    if len(shell) < 2:
        return 0.0
    some = shell.points[:: max(1, len(shell) // 1000)]
    distances, _ = cKDTree(shell.points).query(some, k=2)
    return float(np.median(np.asarray(distances)[:, 1]))


# -- for programs ---------------------------------------------------------------------------------


def _record(
    found: "Swept", shell: "PointShell", parts: list[int], excluded: list[int]
) -> dict[str, Any]:
    deepest, clearance = found.deepest, found.clearance
    return {
        "comes_out": found.comes_out,
        "verdict": _verdict(found),
        "poses": len(found.path.poses),
        "samples": found.samples,
        "hits": found.hits,
        "contacts": found.contacts,
        "first_hit": _moment(found.first_hit),
        "first_contact": _moment(found.first_contact),
        "deepest": deepest
        and {
            "depth": deepest.depth,
            "point": deepest.point.tolist(),
            "moment": _moment(deepest.moment),
        },
        "objects": [
            {
                **_named(one.object),
                "first": one.first,
                "last": one.last,
                "samples": one.samples,
                "contacts": one.contacts,
                "deepest": one.deepest,
            }
            for one in found.objects
        ],
        "hit_intervals": found.hit_intervals.tolist(),
        "contact_intervals": found.contact_intervals.tolist(),
        "clearance": clearance
        and {
            "distance": clearance.distance,
            "at_least": clearance.at_least,
            "at_most": None if clearance.is_beyond else clearance.at_most,
            "is_beyond": clearance.is_beyond,
            "point": None if clearance.point is None else clearance.point.tolist(),
            "voxel": None if clearance.voxel is None else clearance.voxel.tolist(),
            "moment": _moment(clearance.moment),
        },
        "tool": {"points": len(shell), "parts": parts, "excluded": excluded},
        "revision": found.revision,
        "elapsed": found.elapsed,
        "cells": found.cells,
    }


def _named(obj: "Object") -> dict[str, object]:
    return {"id": obj.id, "name": obj.name}


def _moment(moment: "Moment | None") -> dict[str, object] | None:
    return moment and {
        "sample": moment.sample,
        "fraction": moment.fraction,
        "segment": moment.segment,
        "pose": moment.pose.tolist(),
        "objects": [_named(obj) for obj in moment.objects],
    }
