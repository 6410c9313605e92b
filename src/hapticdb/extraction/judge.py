"""The proof of a found path: sweeps of the dense shell, as of any other path."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hapticdb.extraction.problem import Problem
from hapticdb.extraction.result import WayOut
from hapticdb.sweeps.result import Swept
from hapticdb.sweeps.run import sweep

Floats = NDArray[np.float64]

AWAY = (2.0, 6.0)
"""Voxels of motion after the last touch from which on a proof is tried, one after another. Larger:
a proof of less of the path, where a first one fails."""


def judge(
    problem: Problem, poses: Floats, how: Literal["pull", "plan"], budget_bytes: int
) -> WayOut:
    """Sweep a path of displacements (M, 4, 4); and what follows the contact at its start."""
    found = _swept(problem, poses, budget_bytes)
    if not _only_leaves(found):
        return WayOut(poses, how, found, None, 0.0)
    rest, begin = None, 0.0
    for voxels in AWAY:
        later, begin = _after_contact(found, voxels)
        rest = _swept(problem, later, budget_bytes)
        if rest.comes_out:
            break
    return WayOut(poses, how, found, rest, begin)


def _swept(problem: Problem, poses: Floats, budget_bytes: int) -> Swept:
    return sweep(
        problem.env, problem.shell, poses, where=problem.where, exclude=problem.exclude,
        budget_bytes=budget_bytes, profile=True,
    )  # fmt: skip


def _only_leaves(found: Swept) -> bool:
    """Whether the parts hit only what they touch at their start, leave it, and never return."""
    left = {one.object.id for one in found.objects if one.is_left_at_once}
    return (
        bool(left)
        and len(left) == len(found.objects)
        and all(obj.id in left for obj in found.enclosed)
    )


def _after_contact(found: Swept, voxels: float) -> tuple[Floats, float]:
    """Poses (M, 4, 4) of the path some voxels of motion after the last hit, and metres before."""
    path, length = found.path, float(found.path.motion.sum())
    fractions = path.fractions(np.arange(len(path)))
    begin = max(one.last for one in found.objects) + voxels * found.voxel_size / max(length, 1e-12)
    sample = min(int(np.searchsorted(fractions, begin)), len(path) - 1)
    rest = path.poses[path.starts > sample]
    return np.concatenate([path.sample(sample, sample + 1), rest]), float(
        fractions[sample]
    ) * length
