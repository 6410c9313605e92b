"""The verb extract."""

import importlib.util
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import typer

from hapticdb.cli import render
from hapticdb.cli.emit import Output
from hapticdb.cli.selection import FilterOptions, ids_of
from hapticdb.cli.values import MIB, pose_of, refuse
from hapticdb.errors import MissingExtraError, UsageError, pip_line
from hapticdb.tabular.schema import plain
from hapticdb.verdicts import EXTRACT_VERDICTS, exit_codes

if TYPE_CHECKING:
    from hapticdb.environment import Environment
    from hapticdb.extraction.disassembly import Disassembly
    from hapticdb.extraction.extraction_results import Extraction

MOST_BLOCKERS = 10
"""Rows of the tables of blockers and of failed searches."""

HELP = f"""Search a path on which parts come out.

A sweep of the surfaces judges it. The parts that WORDS choose move together as one rigid body.
Straight pulls are tried first: along the axes, away from contacts and along them, at random; with
--screw then screw motions. If none leads out, a planner (OMPL, pip install ompl) searches a path
round corners and with turns. A part is out when its bounding sphere is clear of the box of all
other parts, or at --out. With --to, a path to a pose is searched instead.

The path is written by --path as displacements from the present place, as 'hapticdb sweep --part'
takes them. The same seed gives the same path, unless --seconds end the search.

Overlaps count if they are more than --contact and --overlap. If no path is found, the parts that
block most of the straight pulls are named.

With --disassemble, what blocks the parts is taken off first, each object alone and on a path that
is proved; --keep names what stays. Each step has a file of its own: --path out.csv writes out-1.csv
and so on. The order may be longer than necessary.

{exit_codes(EXTRACT_VERDICTS)}

Example: hapticdb extract car.db body/hood --path out.csv
"""


@dataclass(frozen=True)
class OrderOptions:
    """Options of a disassembly: a search with removal of the parts' blockers."""

    disassemble: bool = False
    depth: int | None = None
    keep: list[str] | None = None
    on: str | None = None

    def __post_init__(self) -> None:
        if not self.disassemble:
            refuse("without --disassemble", self)


@dataclass(frozen=True)
class SearchOptions:
    """Options common to all searches."""

    seconds: float | None = None
    seed: int = 0
    motions: int = 20_000
    out: float | None = None
    screw: float | None = None
    contact: float = 5e-5
    overlap: float = 0.0


@dataclass(frozen=True)
class _Output(Output):
    path: str | None = None
    animation: str | None = None
    up: Literal["x", "y", "z"] | None = None

    def __post_init__(self) -> None:
        if self.animation is None:
            refuse("without --animation", self, "up")
            return
        if not self.animation.lower().endswith(".html"):
            raise UsageError(f"--animation {self.animation}: give a name that ends in .html")
        if None in map(importlib.util.find_spec, ("viser", "embreex")):
            raise MissingExtraError(f"an animation needs more packages: {pip_line('view')}")

    def files(self, n_steps: int | None) -> list[str]:
        """Files of the path, or of a disassembly's steps: ``out-1.csv`` for ``out.csv``."""
        if self.path is None or n_steps is None:
            return [self.path] if self.path else []
        path = Path(self.path)
        names = (f"{path.stem}-{n + 1}{path.suffix}" for n in range(n_steps))
        return [str(path.with_name(name)) for name in names]


def extract(
    url: str,
    objects: list[str],
    *,
    order: OrderOptions,
    to: str | None = None,
    search: SearchOptions,
    selection: FilterOptions,
    budget: int = 256 * MIB,
    output: _Output,
) -> None:
    """See `HELP`."""
    import hapticdb
    from hapticdb.extraction.disassembly import disassemble
    from hapticdb.extraction.removal_search import extract as search_path

    if to:
        refuse("with --to", order, "disassemble")
        refuse("with --to", search, "out screw")
    goal = pose_of(to, "--to") if to else None
    options: dict[str, Any] = vars(search) | {"budget_bytes": budget}
    options |= {"depth": order.depth} if order.disassemble else {"to": goal}
    options = {name: value for name, value in options.items() if value is not None}
    found: Extraction | Disassembly
    steps: list[tuple[Extraction, Sequence[int]]]
    with hapticdb.open(url, read_only=True) as env:
        ids = ids_of(env, objects, "WORDS")
        chosen = selection.resolve(env, ids)
        kept = ids_of(env, order.keep, "--keep") if order.keep else []
        with render.bar("pulling", "searches" if order.on else "pulls") as progress:
            options |= {"where": chosen.where, "progress": progress}
            if order.disassemble:
                excluded = selection.exclude or ()
                found = disassemble(env, *ids, exclude=excluded, keep=kept, on=order.on, **options)
                steps = [(step.found, step.excluded) for step in found.steps if found.is_found]
            else:
                found = search_path(env, *ids, exclude=chosen.exclude, **options)
                steps = [(found, chosen.excluded)] if found.path else []
        _report(env, found, steps, output)
    raise typer.Exit(found.verdict.exit_status)


extract.__doc__ = HELP


def _report(
    env: "Environment", found: "Extraction | Disassembly",
    steps: "Sequence[tuple[Extraction, Sequence[int]]]", output: _Output,
) -> None:  # fmt: skip
    """Write paths, print the verdict, and write the animation on request.

    steps : results with a path, each with the ids of the objects excluded from it.
    """
    from hapticdb.extraction.extraction_results import Extraction
    from hapticdb.extraction.verdict import disassembly_line, extraction_line
    from hapticdb.poses import write_poses

    is_one = isinstance(found, Extraction)
    files = output.files(None if is_one else len(steps)) if steps else []
    for file, (step, _) in zip(files, steps, strict=False):
        assert step.path is not None  # noqa: S101 - it was found
        write_poses(file, step.path.poses)
    line = extraction_line(found) if isinstance(found, Extraction) else disassembly_line(found)
    shown = partial(_show if is_one else _show_order, found)  # type: ignore[arg-type]
    names = " ... ".join(dict.fromkeys([*files[:1], *files[-1:]]))
    written = [("path", names), ("animation", output.animation if steps else "")]

    def words() -> None:
        render.say(line, found.verdict.exit_status)
        render.facts([*shown(), *((name, file) for name, file in written if file)])

    output.emit({"line": line} | plain(found), words)
    if output.animation is not None and steps:
        from hapticdb.page.animation import animate

        paths = [step for step, _ in steps]
        animate(output.animation, env, paths, exclude=steps[-1][1], up=output.up)


def _show(found: "Extraction") -> list[tuple[str, str]]:
    """Print the blockers; returns the figures of the search."""
    from hapticdb.exact.sweep_report import names_of

    if not found.is_free:
        rows = (
            (one.object.id, one.object.name, f"{one.pulls} of {found.pulls}")
            for one in found.blockers[:MOST_BLOCKERS]
        )
        render.table(("id>", "in the way", "of pulls>"), rows)
    return [
        ("near its start", names_of(found.near) or "nothing"),
        ("searched", render.counts(pull=found.pulls, motion=found.motions, pose=found.poses)),
        ("took", f"{found.seconds:.1f} s"),
    ]


def _show_order(found: "Disassembly") -> list[tuple[str, str]]:
    from hapticdb.exact.sweep_report import names_of
    from hapticdb.extraction.verdict import extraction_line, failed_line

    for n, step in enumerate(found.steps):
        render.say(f"{n + 1}. {names_of(step.found.parts)}: {extraction_line(step.found)}")
    if not found.is_found:
        rows = (
            (names_of(one.parts), one.n_gone, failed_line(one))
            for one in found.failed[-MOST_BLOCKERS:]
        )
        render.table(("tried", "after steps>", "result"), rows)
    return [("took", f"{found.seconds:.1f} s")]
