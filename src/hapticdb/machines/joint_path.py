"""Joint paths: CSV files, and the path of each link as poses so near that rigid motion bounds it.

Between two rows the joints move linearly, so a link moves on no line and about no axis. Its path is
cut so that the motion of a sweep, straight with an even turn, deviates from it by `DEVIATION` at
most: a place between two poses is h^2 / 8 of its greatest second derivative from the straight line,
on either motion. A sweep takes that off its gaps; a collision begins at five times as much.
"""

import csv
import re
from collections.abc import Callable, Iterable, Sequence
from functools import reduce
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.errors import FileError, UsageError
from hapticdb.exact.distance import in_time
from hapticdb.exact.movers import Mover
from hapticdb.exact.path import SampledPath, ToolPath, checked_poses
from hapticdb.machines.machine import HINGE, Machine, motion_bounds
from hapticdb.poses import as_floats
from hapticdb.units import UNITS

Floats = NDArray[np.float64]
RowSteps = tuple[Floats, NDArray[np.int32]]
"""Of a link between two rows, (rows - 1,) each: metres of its fastest place; parts of its path."""

DEVIATION = 2e-6
"""Greatest deviation of a link from its motion, metres. Larger: fewer poses, and wider bounds."""
MOST_TURN = 0.5
"""Greatest turn of a link between two poses, radians."""
MOST_POSES = 1_000_000
"""Poses of a link's path. Larger: more memory, 0.14 GiB each million."""
AT_ONCE = 1 << 14
"""Rows or poses between two readings of the clock: a tenth of a second, 0.1 GiB."""
MOST_VALUE = 1e6
"""Greatest value of a joint, rad or m. Larger: rounding has a part in the deviation."""
_NAME = re.compile(r"(.*?)\s*(?:\[\s*(\S+)\s*\])?")
_DEGREE = np.pi / 180.0


def read_joints(path: str, machine: Machine) -> Floats:
    """Values (rows, driven) of a CSV file with a column a joint; joints without one stay at 0.

    Radians and metres, or a unit in the header: ``elbow [deg]``, ``lift [mm]``.
    """
    try:
        text = Path(path).read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        why = error.strerror if isinstance(error, OSError) else "it is no text"
        raise FileError(f"cannot read {path}: {why}") from error
    try:
        lines = [line for line in csv.reader(text.splitlines(), strict=True) if any(line)]
    except csv.Error as error:
        raise FileError(f"{path}: {error}") from error
    if len(lines) < 2:
        raise FileError(
            f"{path}: give a header with the names of joints, and a row for each sample"
        )
    columns = [_column(path, head.strip(), machine) for head in lines[0]]
    if len({n for n, _ in columns}) < len(columns):
        raise FileError(f"{path}: its header names a joint twice")
    q = np.zeros((len(lines) - 1, len(machine.driven)))
    for row, line in enumerate(lines[1:]):
        if len(line) != len(columns):
            raise FileError(f"{path}, row {row}: {len(line)} values for {len(columns)} joints")
        for (n, factor), cell in zip(columns, line, strict=True):
            try:
                q[row, n] = factor * float(cell)
            except ValueError:
                raise FileError(f"{path}, row {row}: {cell[:40]!r} is no number") from None
    return q


def _column(path: str, head: str, machine: Machine) -> tuple[int, float]:
    """Column of `Machine.driven`, and factor, of a header."""
    known = ", ".join(machine.driven)
    name, unit = head, None
    if head not in machine.driven and (match := _NAME.fullmatch(head)):
        name, unit = match[1], match[2]
    if name not in machine.driven:
        follows = next((one.driver for one in machine.joints if one.name == name), "")
        why = f"follows {follows!r}, so leave it out" if follows else f"is none of its: {known}"
        raise FileError(f"{path}: joint {name[:60]!r} {why}")
    joint = next(one for one in machine.joints if one.name == name)
    units = {"rad": 1.0, "deg": _DEGREE} if joint.kind == HINGE else UNITS
    if unit is not None and unit not in units:
        raise FileError(f"{path}: {head!r}: give {name} in {', '.join(units)}")
    return machine.driven.index(name), units[unit] if unit else 1.0


def checked_values(machine: Machine, q: ArrayLike) -> Floats:
    """Values (rows, joints) of all joints, two rows at least, for those of the driven ones."""
    given = as_floats(q, "a joint path")
    wanted = len(machine.driven)
    if not machine.joints:
        raise UsageError(f"{machine.file} has no joints: sweep its mesh as a tool")
    if given.ndim != 2 or given.shape[1] != wanted or not len(given):
        raise UsageError(
            f"a joint path of shape {given.shape}: give (rows, {wanted}), a column for each of "
            f"{', '.join(machine.driven) or 'no joint'}"
        )
    bad = np.flatnonzero(~np.isfinite(given).all(axis=1))
    if len(bad):
        raise UsageError(f"row {bad[0]} of the joint path has a value that is not finite")
    # one row is a path of no length: the sweep needs a segment
    values = machine.values(given if len(given) > 1 else given[[0, 0]])
    # negated, so NaN is refused, too
    for row, n in np.argwhere(~(np.abs(values) <= MOST_VALUE)):
        raise UsageError(
            f"joint {machine.joints[n].name} is at {values[row, n]:.6g} in row {row} of the joint "
            f"path: give {MOST_VALUE:.0e} rad or m at most"
        )
    return values


def beyond_limits(machine: Machine, values: Floats) -> Iterable[str]:
    """A note for each joint whose values leave its limits."""
    for joint, own in zip(machine.joints, values.T, strict=True):
        over = np.maximum(own - joint.high, joint.low - own)
        row = int(np.argmax(over))
        if over[row] > 1e-9:
            unit = "rad" if joint.kind == HINGE else "m"
            is_above = own[row] > joint.high
            limit = f"above {joint.high:.6g}" if is_above else f"below {joint.low:.6g}"
            yield (
                f"joint {joint.name} is at {own[row]:.6g} {unit} in row {row}, {limit}, its limit"
            )


def joint_path(
    machine: Machine, values: Floats, pairs: Sequence[tuple[int, int]], until: float = np.inf
) -> tuple[SampledPath, dict[tuple[int, int], RowSteps]]:
    """Path over rows, its parameter the greatest motion of any link in the frame of another.

    Beside it the steps of each pair: a link in the frame of the first. until : end,
    `time.monotonic`, by OverTimeError.
    """
    pieces: dict[tuple[int, int], list[RowSteps]] = {pair: [] for pair in pairs}
    for first in range(0, len(values) - 1, AT_ONCE):
        some = values[first : first + AT_ONCE + 1]
        placed = machine.all_placed(some)
        for pair in in_time(pieces, until):  # each once: the scene's are also the base's
            with np.errstate(over="ignore", invalid="ignore"):
                speed, bend, turn = motion_bounds(machine, some, *pair, placed)
                # chord error h^2 / 8 times the second derivative, solved for the number of parts
                counts = np.maximum(np.sqrt(bend / (8.0 * DEVIATION)), turn / MOST_TURN)
            # fmin: NaN and infinity are too many, too
            counts = np.fmin(np.maximum(np.ceil(counts), 1.0), MOST_POSES + 1)
            pieces[pair].append((speed, counts.astype(np.int32)))
    steps = {
        pair: (np.concatenate([one for one, _ in some]), np.concatenate([one for _, one in some]))
        for pair, some in pieces.items()
    }
    # the fastest pair of links: a bound for all, so one parameter orders every hit
    fastest = reduce(np.maximum, (speed for speed, _ in steps.values()))
    parameters = np.concatenate([[0.0], np.cumsum(fastest)])
    if not np.isfinite(parameters[-1]):
        raise UsageError("the joint path is longer than numbers go: check its units")
    return SampledPath(parameters, values), steps


def mover_of(
    machine: Machine, path: SampledPath, first: int, last: int, steps: RowSteps,
    frame: Callable[[float], Floats] | None, base: Floats, until: float = np.inf,
) -> Mover:  # fmt: skip
    """A link on its path in the frame of another one, with its steps there.

    base (4, 4) : `world_from_base`; until : as of `joint_path`.
    """
    counts, surface = steps[1], machine.surfaces[last]
    if counts.sum() > MOST_POSES:
        raise UsageError(
            f"link {machine.names[last]} moves too far for one sweep: divide the joint path"
        )
    rows, columns = np.arange(len(counts) + 1.0), np.ascontiguousarray(path.poses.T)
    begins = np.repeat(np.cumsum(counts) - counts, counts)
    parts = (np.arange(len(begins)) - begins) / np.repeat(counts, counts)
    knots = np.append(np.repeat(rows[:-1], counts) + parts, rows[-1])

    def placed(n: int) -> Floats:
        some = knots[n : n + AT_ONCE + 1]
        own = np.stack([np.interp(some, rows, one) for one in columns], axis=1)
        # relative motion: the other link stands still, so it can play the part of an object
        before = base if frame is None else np.linalg.inv(machine.placed(own, first))
        poses = before @ machine.placed(own, last)
        # the inverse leaves rounding in the last row, and `checked_poses` compares exactly
        poses[:, 3] = 0.0, 0.0, 0.0, 1.0
        return checked_poses(poses)

    pieces = map(placed, in_time(range(0, len(knots) - 1, AT_ONCE), until))
    center, none = surface.corners.mean(axis=0), np.empty((0, 4, 4))
    motion = ToolPath.joined(pieces, surface.corners, center, none)
    parameters = np.interp(knots, rows, path.parameters)
    return Mover(surface, motion, machine.names[last], parameters, frame, DEVIATION)
