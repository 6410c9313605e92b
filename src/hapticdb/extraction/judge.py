"""The proof of a found path: sweeps of the dense shell, as of any other path."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hapticdb.extraction.problem import Problem
from hapticdb.extraction.result import WayOut
from hapticdb.sweeps.depths import ALLOWED, depths_along
from hapticdb.sweeps.result import ContactDepth, Swept
from hapticdb.sweeps.run import sweep

Floats = NDArray[np.float64]

AWAY = (2.0, 6.0)
"""Voxels of motion after the last touch from which on a proof is tried, one after another. Larger:
a proof of less of the path, where a first one fails."""


def judge(
    problem: Problem, poses: Floats, how: Literal["pull", "plan"], budget_bytes: int
) -> WayOut:
    """Sweep a path of displacements (M, 4, 4); bound how deep it gets at its start, and go on."""
    found = _swept(problem, poses, budget_bytes)
    if not _only_leaves(found):
        return WayOut(poses, how, found, None, 0.0)
    depths = _depths(problem, found)
    if any(one.is_cut for one in depths):
        return WayOut(poses, how, found, None, 0.0, depths)
    rest, begin = None, 0.0
    for voxels in AWAY:
        later, begin = _after_contact(found, voxels)
        rest = _swept(problem, later, budget_bytes)
        if rest.comes_out:
            break
    beside = None
    if rest is not None and rest.comes_out and all(one.is_bounded for one in depths):
        left = tuple(one.object.id for one in depths)
        beside = _swept(problem, poses, budget_bytes, left)
    return WayOut(poses, how, found, rest, begin, depths, beside)


def _swept(problem: Problem, poses: Floats, budget_bytes: int, left: tuple[int, ...] = ()) -> Swept:
    """Sweep the dense shell; left : ids of objects that are left out, too."""
    return sweep(
        problem.env, problem.shell, poses, where=problem.where, exclude=(*problem.exclude, *left),
        budget_bytes=budget_bytes, profile=True,
    )  # fmt: skip


def _depths(problem: Problem, found: Swept) -> tuple[ContactDepth, ...]:
    """How deep the parts go into what they only leave, until the last way that `AWAY` allows."""
    size, last = found.voxel_size, _sample_after(found, AWAY[-1])
    objects = [one.object for one in found.objects]
    return depths_along(
        problem.shell, found.path, objects, voxel_size=size, allowed=ALLOWED * size, last=last
    )


def _only_leaves(found: Swept) -> bool:
    """Whether the parts hit only what they touch at their start, leave it, and never return."""
    left = {one.object.id for one in found.objects if one.is_left_at_once}
    return (
        bool(left)
        and len(left) == len(found.objects)
        and all(obj.id in left for obj in found.enclosed)
    )


def _sample_after(found: Swept, voxels: float) -> int:
    """The first sample some voxels of motion after the last hit."""
    path, length = found.path, float(found.path.motion.sum())
    fractions = path.fractions(np.arange(len(path)))
    begin = max(one.last for one in found.objects) + voxels * found.voxel_size / max(length, 1e-12)
    return min(int(np.searchsorted(fractions, begin)), len(path) - 1)


def _after_contact(found: Swept, voxels: float) -> tuple[Floats, float]:
    """Poses (M, 4, 4) of the path some voxels of motion after the last hit, and metres before."""
    path, sample = found.path, _sample_after(found, voxels)
    rest = path.poses[path.starts > sample]
    before = float(path.fractions(sample)) * float(path.motion.sum())
    return np.concatenate([path.sample(sample, sample + 1), rest]), before
