"""Sweeps of machines along joint paths: links against objects, and links against links."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from os import PathLike

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.environment import Environment
from hapticdb.exact.distance import OverTimeError, in_time
from hapticdb.exact.movers import LinkPair, Mover, SweepRequest
from hapticdb.exact.path import SampledPath, checked_poses
from hapticdb.exact.separation import CONTACT
from hapticdb.exact.sweep import swept_along
from hapticdb.exact.swept import Swept
from hapticdb.machines.joint_path import (
    AT_ONCE,
    DEVIATION,
    RowSteps,
    beyond_limits,
    checked_values,
    joint_path,
    mover_of,
)
from hapticdb.machines.machine import Machine, pairs_of
from hapticdb.machines.reader import read_machine
from hapticdb.store.base import Object, Progress
from hapticdb.store.finding import Words

Floats = NDArray[np.float64]

SAMPLES = 8
"""Rows at which the links' distances are measured: the nearest pair is swept first."""
STRETCHES = 128
"""Stretches of a path for the lower bounds of the links' gaps. More: fewer pairs are swept."""


def sweep_machine(
    env: Environment,
    machine: Machine | str | PathLike[str],
    q: ArrayLike,
    *,
    at: ArrayLike | None = None,
    where: Words = (),
    exclude: Words = (),
    contact: float = CONTACT, overlap: float = 0.0,
    limit: float | None = None, seconds: float | None = None,
    until_hit: bool = False, cloud_radius: float = 0.0, within: float | None = None,
    progress: Progress | None = None,
) -> Swept:  # fmt: skip
    """Move a machine along a joint path: its hits with objects and with itself, or the least gap.

    Parameters
    ----------
    env : Environment
        As for `sweep`.
    machine : Machine, str or path
        As of `read_machine`, or a file for it.
    q : (M, J) array
        Values of the joints `machine.driven`, rad or m; they move linearly between two rows.
    at : (4, 4) array or None
        `world_from_base`, metres; the world's frame unless given.
    where, exclude, contact, overlap, limit, seconds, until_hit, cloud_radius, within, progress
        As for `sweep`. Where the path starts, the machine may touch as a part at its place.

    Returns
    -------
    Swept
        `path.poses` are the values of all joints; `body` of a place is its link. Another link as
        the object has the id 0. `notes` name joints beyond their limits, and the untested pairs of
        links: without a list in the file, those in contact with all joints at 0.

    Raises
    ------
    UsageError, FileError, ObjectNotFoundError
        As for `sweep` and `read_machine`; if `q` is not finite or has another shape.
    """
    machine = machine if isinstance(machine, Machine) else read_machine(machine)
    request = SweepRequest(
        contact, overlap, seated=True, until_hit=until_hit, progress=progress,
        cloud_radius=cloud_radius, within=within,
    ).begun(limit, seconds)  # fmt: skip
    base = np.eye(4) if at is None else checked_poses(np.asarray(at)[None])[0]
    values = checked_values(machine, q)
    try:
        path, movers, links, notes = _prepared(machine, values, base, request)
    except OverTimeError:  # so the sweep ends at once, undecided
        path, movers, links, notes = SampledPath(np.zeros(len(values)), values), [], [], []
    found = swept_along(env, path, movers, request, where, exclude, links)
    gap = found.gap._replace(at_least=max(found.gap.at_least - DEVIATION, 0.0))
    if found.is_free and gap.place is not None:
        gap = gap._replace(at_most=gap.at_most + DEVIATION)
    remarks = (*machine.notes, *notes, *beyond_limits(machine, values))
    return replace(found, gap=gap, notes=remarks)


def _prepared(
    machine: Machine, values: Floats, base: Floats, request: SweepRequest
) -> tuple[SampledPath, list[Mover], list[LinkPair], list[str]]:
    """Path, movers for the scene, pairs of links with the nearest ones first, and notes."""
    pairs, notes = _tested(machine, request)
    shown = machine.all_placed(values[np.linspace(0, len(values) - 1, SAMPLES).astype(np.int64)])
    gaps = {pair: _gap(machine, pair, shown, np.inf) for pair in in_time(pairs, request.until)}
    pairs.sort(key=gaps.__getitem__)  # bounds the later ones
    scene = [(0, link) for link in machine.surfaces]  # link 0 is the base: it stands still
    path, steps = joint_path(machine, values, [*pairs, *scene], request.until)
    movers = [
        mover_of(machine, path, *link, steps[link], None, base, request.until) for link in scene
    ]
    links = _link_pairs(machine, path, pairs, steps, base, request.until)
    return path, movers, list(links), notes


def _tested(machine: Machine, request: SweepRequest) -> tuple[list[tuple[int, int]], list[str]]:
    """Pairs of links that move to one another and are tested, and a note of those left out."""
    pairs = [pair for pair in pairs_of(machine.surfaces) if machine.chain(*pair)]
    if machine.excluded is not None:
        names = machine.names
        return [(a, b) for a, b in pairs if {names[a], names[b]} not in machine.excluded], []
    zero = machine.all_placed(machine.values(np.zeros((1, len(machine.driven)))))
    tested: list[tuple[int, int]] = []
    touching: list[tuple[int, int]] = []
    contact = request.contact
    for a, b in in_time(pairs, request.until):
        # no list in the file: neighbours in contact at zero are taken for joined, not for clashing
        is_touching = _gap(machine, (a, b), zero, 2.0 * contact) <= contact
        (touching if is_touching else tested).append((a, b))
    remarks = ", ".join(f"{machine.names[a]} and {machine.names[b]}" for a, b in touching)
    return tested, [
        f"not tested, since they touch with all joints at 0: {remarks}"
    ] if remarks else []


def _gap(
    machine: Machine, pair: tuple[int, int], placed: Mapping[int, Floats], farthest: float
) -> float:
    """Least distance of two links at some poses of all, infinite beyond the farthest."""
    a, b = pair
    poses = np.linalg.inv(placed[a]) @ placed[b]
    tree = machine.surfaces[a].tree
    near = machine.surfaces[b].nearest(tree, poses, np.full(len(poses), farthest))
    return float(near.at_most.min())


def _link_pairs(
    machine: Machine, path: SampledPath, pairs: Sequence[tuple[int, int]],
    steps: Mapping[tuple[int, int], RowSteps], base: Floats, until: float,
) -> Iterator[LinkPair]:  # fmt: skip
    rows = len(path.poses) - 1
    parts = max(STRETCHES // rows, 1)
    given, least = np.arange(rows + 1), dict.fromkeys(pairs, np.inf)
    for first in range(0, rows if pairs else 0, AT_ONCE):
        some = slice(first, first + AT_ONCE)
        middles = first + (np.arange(parts * len(given[:-1][some])) + 0.5) / parts
        values = np.stack([np.interp(middles, given, one) for one in path.poses.T], axis=1)
        placed = machine.all_placed(values)
        for a, b in in_time(pairs, until):
            # no place moves farther from the middle of a stretch: boxes there bound the gap
            reach = np.repeat(steps[a, b][0][some] / (2 * parts), parts)
            poses, box = np.linalg.inv(placed[a]) @ placed[b], machine.surfaces[a].box
            gaps = machine.surfaces[b].box_gaps(box[None], poses, reach)
            least[a, b] = min(least[a, b], float(gaps.min()))
    for a, b in pairs:

        def frame(parameter: float, link: int = a) -> Floats:  # the default binds `a` now
            return np.asarray(base @ machine.placed(path.at([parameter]), link)[0])

        shape = machine.surfaces[a]
        mover = partial(mover_of, machine, path, a, b, steps[a, b], frame, base, until)
        thing = Object(machine.names[a], machine.file, "", np.eye(4), 0, shape.box)
        yield LinkPair(least[a, b] - shape.chord, mover, thing, shape)
