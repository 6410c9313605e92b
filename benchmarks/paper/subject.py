"""An opened environment under stated conditions, and the alternatives that are measured on it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from hapticdb import Environment, Query
from hapticdb.paper.calibration import calibrate
from hapticdb.paper.cost_model import CostModel
from hapticdb.paper.grouping import DEFAULT_MAXGAP
from hapticdb.paper.quantiles import QuantileVector
from hapticdb.paper.strategies import Strategies, Strategy
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.law import DistanceField, ForceLaw, TangentPlane
from hapticdb.store.sqlite.sqlite_store import SQLiteStore
from paper.measure import Alternative, Cell, Pose
from paper.workload import Task

PAPER_CACHE = 4 << 20
"""Bytes of the paper's database cache: 500 blocks of 8 KB."""
LAWS: dict[str, ForceLaw] = {"plane": TangentPlane(), "distance": DistanceField()}


@dataclass
class Subject:
    """An opened environment under stated conditions.

    name : the environment's; drop : empties all caches, or None where this process cannot.
    """

    env: Environment
    name: str
    drop: Callable[[], None] | None = None

    @cached_property
    def costs(self) -> CostModel:
        """Cost model fitted under these conditions. It is not stored: they end with the run."""
        return calibrate(self.env.store)

    @cached_property
    def quantiles(self) -> QuantileVector:
        """Quantile vector that `cbgroup` and `auto` use."""
        return self.env.quantiles()

    def conditions(self, task: Task) -> Cell:
        """What every cell of this subject and task says."""
        return {
            "environment": self.name,
            "engine": self.env.engine,
            "layout": self.env.layout,
            "file": "cached",
            "poses": task.name,
            "points": len(task.shell),
            "resolution": self.quantiles.resolution,
            **({"region": task.region, "density": task.density} if task.region else {}),
        }

    def query(self, quantiles: QuantileVector | None = None) -> Strategies:
        """Frames on this environment, with its quantiles unless others are given."""
        statistics = (quantiles or self.quantiles, self.costs)
        return Strategies(self.env.store, lambda: statistics)

    def alternative(
        self,
        task: Task,
        strategy: Strategy,
        *,
        gap: int | None = None,
        query: Strategies | None = None,
        law: str = "plane",
        **more: Any,  # noqa: ANN401 - what a cell says is JSON's
    ) -> Alternative:
        """A strategy over a task. `gap` is MAXGAP, for the strategy maxgap alone."""
        cell = {
            **self.conditions(task),
            "strategy": strategy,
            "law": law,
            **({"maxgap": gap} if gap is not None else {}),
            **more,
        }
        return Alternative(cell, asking(query or self.query(), task.shell, strategy, law, gap))


def asking(
    query: Strategies, shell: PointShell, strategy: Strategy, law: str, gap: int | None
) -> Callable[[Pose], Query]:
    """Frames of one shell by one strategy."""
    gap = DEFAULT_MAXGAP if gap is None else gap
    return lambda pose: query.touch(shell, pose, strategy, gap, law=LAWS[law]).query


def with_papers_cache(env: Environment) -> None:
    """Limit the connection's cache on SQLite. A server has one cache for all connections."""
    if isinstance(env.store, SQLiteStore):
        env.store._connection.fetch(f"PRAGMA cache_size = -{PAPER_CACHE >> 10}")  # noqa: SLF001 - no user limits it
