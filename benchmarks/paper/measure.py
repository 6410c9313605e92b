"""Timing alternatives in turns, so that a slow phase of the machine slows all of them alike."""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.query.touches import Query

CHUNK = 20
"""Poses that an alternative runs in one turn. More poses warm the processor's caches better and let
the machine drift further between turns."""
WARM_FRAMES = 20
"""Untimed frames of each alternative before the first turn. More take longer and change little."""
SEED = 0
"""Of the order in which alternatives take turns."""

Cell = dict[str, Any]
"""One measured combination, as it is written to JSON: conditions, counts, percentiles."""
Pose = NDArray[np.float64]


@dataclass
class Alternative:
    """One way to answer a frame, and what its frames took.

    cell : what its cell says before anything is measured; frame : pose -> Query; before : called
    before each frame and not timed, or None.
    """

    cell: Mapping[str, Any]
    frame: Callable[[Pose], Query]
    before: Callable[[], None] | None = None
    times_us: list[float] = field(default_factory=list)
    queries: list[Query] = field(default_factory=list)
    spent_s: float = 0.0

    def run(self, poses: NDArray[np.float64], indices: Sequence[int], limit_s: float) -> None:
        """Measure some poses, until the time is spent.

        One frame runs first and is not timed, at the pose before them: it finds the processor's
        caches full of the other alternatives' data.
        """
        if self.before is None and self.spent_s <= limit_s:
            self.frame(poses[indices[0] - 1])
        for index in indices:
            if self.spent_s > limit_s:
                return
            if self.before is not None:
                self.before()
            start = time.perf_counter_ns()
            query = self.frame(poses[index])
            elapsed_us = (time.perf_counter_ns() - start) / 1000
            self.times_us.append(elapsed_us)
            self.queries.append(query)
            self.spent_s += elapsed_us / 1e6

    def record(self) -> Cell:
        """The cell with everything measured."""
        found: Cell = {**self.cell, "frames": len(self.queries), "us": summary(self.times_us)}
        found["ranges"] = float(np.mean([query.ranges for query in self.queries]))
        return found | {"rows": float(np.mean([query.rows for query in self.queries]))}


def in_turns(
    alternatives: Sequence[Alternative],
    poses: NDArray[np.float64],
    *,
    limit_s: float,
    warm: int = WARM_FRAMES,
) -> list[Cell]:
    """Measure all alternatives over all poses and return a cell for each.

    poses (M, 4, 4): world_from_tool; limit_s : seconds of frames that each may take: one that
    reaches it stops, and its cell is marked `cut_short`; warm : untimed frames of each before.

    The poses are cut into chunks. Every alternative runs each chunk once. In one turn the
    alternatives run different chunks, in an order drawn anew for each turn. So an alternative does
    not profit from pages that the one before it has just brought into the cache, and what disturbs
    the machine for a while disturbs all of them.
    """
    for alternative in alternatives:
        started = time.perf_counter()
        for pose in poses[:: max(1, len(poses) // max(warm, 1))][:warm]:
            alternative.frame(pose)
            if time.perf_counter() - started > limit_s / 4:
                break
    chunks = [range(at, min(at + CHUNK, len(poses))) for at in range(0, len(poses), CHUNK)]
    stride = max(1, len(chunks) // max(len(alternatives), 1))
    rng = np.random.default_rng(SEED)
    for turn in range(len(chunks)):
        for n in rng.permutation(len(alternatives)).tolist():
            chunk = chunks[(turn + n * stride) % len(chunks)]
            alternatives[n].run(poses, chunk, limit_s)
    return [one.record() | {"cut_short": len(one.queries) < len(poses)} for one in alternatives]


def summary(times_us: ArrayLike) -> dict[str, float]:
    """Mean, percentiles and worst of frame times (N,), microseconds.

    `typical` is the mean of the times between the 5th and the 95th percentile. It varies as little
    as a median between runs, and counts every kind of pose by its share, as a mean does.
    """
    times = np.sort(np.asarray(times_us, dtype=np.float64))
    cut = len(times) // 20
    found: dict[str, float] = {
        "mean": float(times.mean()),
        "typical": float(times[cut : len(times) - cut].mean()),
    }
    for share in (10, 50, 90, 99):
        found[f"p{share}"] = float(np.percentile(times, share))
    found["max"] = float(times[-1])
    return found
