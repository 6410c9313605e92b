"""How much of many cases a run tries."""

import random
from collections.abc import Sequence
from typing import TypeVar

import pytest
from hypothesis import settings

T = TypeVar("T")
_chosen: dict[str, int | None] = {"seed": 0}
"""The run's seed; None: every step."""


def add_options(parser: pytest.Parser) -> None:
    parser.addoption("--every-step", action="store_true", help="all steps, all versions: hours")
    parser.addoption("--draw", type=int, metavar="SEED", help="the steps of an earlier run")


def choose(config: pytest.Config) -> None:
    """Choose the run's seed. To be called before test modules are imported.

    Examples have no deadline: the first one compiles kernels, and the machine may be busy.
    """
    option = config.option
    of_a_worker: dict[str, int] = getattr(config, "workerinput", {})
    seed = of_a_worker.get("draw", option.draw)
    if seed is None:
        seed = random.randrange(10**6)  # noqa: S311 - `tell` gives it to all processes
    _chosen["seed"] = None if option.every_step else seed
    settings.register_profile("few", max_examples=25, deadline=None)
    settings.register_profile("many", max_examples=200, deadline=None)
    settings.load_profile("many" if option.every_step else "few")


def tell(workerinput: dict[str, object]) -> None:
    """Tell a process that runs tests which seed the run has."""
    workerinput["draw"] = _chosen["seed"] or 0


def is_every() -> bool:
    return _chosen["seed"] is None


def drawn(cases: Sequence[T], most: int = 12) -> list[T]:
    """Some of those cases, in their order; the same ones in all processes of the run."""
    if is_every() or len(cases) <= most:
        return list(cases)
    chance = random.Random(f"{_chosen['seed']} {cases!r}")  # noqa: S311 - no secret
    return [cases[n] for n in sorted(chance.sample(range(len(cases)), most))]


def header() -> str:
    if is_every():
        return "every step is tried"
    return f"some steps of each long loop: the same again with --draw={_chosen['seed']}"
