"""What `extract --disassemble` searches, prints and writes: a file for each step."""

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from hapticdb.cli import render
from hapticdb.cli.verbs.paths.sweeping import UpName

if TYPE_CHECKING:
    from hapticdb.environment import Environment
    from hapticdb.extraction.disassembly.result import Disassembly, Removal

EXIT_CODES = {"comes out": 0, "comes out of contact": 3, "no order found": 1}
MOST_FAILED = 12
"""Rows of the table of searches that failed."""


class Outputs(NamedTuple):
    """What is written beside the printed lines: names of files, or None."""

    path: str | None
    picture: str | None
    animation: str | None
    up: UpName | None
    json: bool


def numbered(file: str, step: int) -> str:
    """Name of a step's file: ``out.csv`` is ``out-1.csv`` for the first step, 0."""
    path = Path(file)
    return str(path.with_name(f"{path.stem}-{step + 1}{path.suffix}"))


def report(env: "Environment", found: "Disassembly", asked: Outputs) -> None:
    """Print an order or why there is none; write a path and a picture a step, and an animation.

    Nothing is written where no order was found.
    """
    from hapticdb.extraction.disassembly.record import disassembly_record
    from hapticdb.poses import write_poses

    steps = found.steps if found.is_found else ()
    if asked.path is not None:
        for n, step in enumerate(steps):
            assert step.found.way is not None  # noqa: S101 - steps are proved
            write_poses(numbered(asked.path, n), step.found.way.poses)
    if asked.json:
        render.say_json(disassembly_record(found))
    else:
        _show(found, asked)
    if asked.picture is not None:
        for n, step in enumerate(steps):
            _draw(numbered(asked.picture, n), env, step, asked.up)
    if asked.animation is not None and steps:
        from hapticdb.page.animation import animate

        animate(
            asked.animation, env, [step.found for step in steps], exclude=steps[-1].excluded,
            up=asked.up,
        )  # fmt: skip


def _show(found: "Disassembly", asked: Outputs) -> None:
    from hapticdb.extraction.disassembly.verdict import disassembly_line, failed_line, step_line
    from hapticdb.sweeps.verdict import names_of

    render.say(disassembly_line(found))
    for n in range(len(found.steps)):
        render.say(f"{n + 1}. {step_line(found, n)}")
    if not found.is_found and found.failed:
        rows = [
            (names_of(one.parts), str(one.n_gone), failed_line(one))
            for one in found.failed[-MOST_FAILED:]
        ]
        render.show(render.table(("tried", "after steps>", "result"), rows))
    facts = [("took", f"{found.seconds:.1f} s")]
    if found.is_found:
        last = len(found.steps) - 1
        for name, file in (("paths", asked.path), ("pictures", asked.picture)):
            if file is not None:
                facts.append(
                    (name, " ... ".join(dict.fromkeys(numbered(file, n) for n in (0, last))))
                )
        if asked.animation is not None:
            facts.append(("animation", asked.animation))
    render.show(render.facts(facts))


def _draw(picture: str, env: "Environment", step: "Removal", up: UpName | None) -> None:
    from hapticdb.extraction.verdict import extraction_line
    from hapticdb.pictures.sweep import draw_sweep

    assert step.found.way is not None  # noqa: S101 - steps are proved
    draw_sweep(
        picture, env, step.found.shell, step.found.way.swept, exclude=step.excluded,
        verdict=extraction_line(step.found), up=up,
    )  # fmt: skip
