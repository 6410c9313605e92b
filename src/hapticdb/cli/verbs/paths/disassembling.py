"""What `extract` writes, and what it prints of an order: a file for each step."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from hapticdb.cli import render
from hapticdb.cli.verbs.paths.sweeping import UpName

if TYPE_CHECKING:
    from hapticdb.environment import Environment
    from hapticdb.extraction.disassembly.result import Disassembly
    from hapticdb.extraction.result import Extraction

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

    def tell() -> None:
        if asked.json:
            render.say_json(disassembly_record(found))
        else:
            _show(found, asked)

    ways = [(step.found, step.excluded) for step in found.steps] if found.is_found else []
    write(env, ways, asked, tell, numbered)


def write(
    env: "Environment",
    ways: "Sequence[tuple[Extraction, Sequence[int]]]",
    asked: Outputs,
    tell: Callable[[], None],
    name_of: Callable[[str, int], str] = lambda file, _: file,
) -> None:
    """Write the paths of ways that were found, `tell` the result, and draw what was asked for.

    ways : each with the ids of what is not felt on it; name_of : name of a way's file.
    """
    from hapticdb.extraction.verdict import extraction_line
    from hapticdb.poses import write_poses

    for n, (found, _) in enumerate(ways):
        if asked.path is not None and found.way is not None:
            write_poses(name_of(asked.path, n), found.way.poses)
    tell()
    for n, (found, excluded) in enumerate(ways):
        if asked.picture is not None and found.way is not None:
            from hapticdb.pictures.demo import save
            from hapticdb.pictures.sweep import compose_sweep

            figure = compose_sweep(
                env, found.shell, found.way.swept, exclude=excluded,
                verdict=extraction_line(found), up=asked.up,
            )  # fmt: skip
            save(figure, name_of(asked.picture, n))
    if asked.animation is not None and ways:
        from hapticdb.page.animation import animate

        steps = [found for found, _ in ways]
        animate(asked.animation, env, steps, exclude=ways[-1][1], up=asked.up)


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
