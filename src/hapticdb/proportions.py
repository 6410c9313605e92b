"""Compares the sizes and places of a tool, its path and the scene, to find wrong units.

A length in a wrong unit gives an answer that looks valid: nothing is hit. Only clear cases are
reported: a tool larger than the whole scene or smaller than a voxel; a path that stays farther from
the scene than the scene or the tool is long; a path a hundred times as long as both. A unit that a
person or a file gave is believed: then a size is no misfit, and no other unit is suggested.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.errors import UsageError
from hapticdb.pointshell.shell import PointShell
from hapticdb.poses import as_floats
from hapticdb.store.attributes import scene_bounds
from hapticdb.store.base import Object
from hapticdb.units import NAMES, UNITLESS, UNITS, length_text, metres_of

Floats = NDArray[np.float64]
What = Literal["tool", "path", "scene"]

LARGE_TOOL = 5.0
"""Metres. A shorter tool may be larger than the scene, because a scene may be one small part.
Larger: fewer large tools are reported."""
LONG_PATH = 100.0
"""Greatest length of a path, in lengths of the scene or tool. Larger: fewer paths are reported."""
PAIRS = 2_000_000
"""Greatest number of pairs of a path's box and an object's box. If there are more, neighbouring
boxes of the path are joined. Larger: a more exact gap, more time."""
LIKELY = ("mm", "in", "cm", "ft", "m", "um", "yd", "km")
"""Units that may explain a misfit, in the order in which they are tried."""


class Misfit(NamedTuple):
    """A tool, path or scene that does not fit the others."""

    what: What
    factor: float | None
    """If its numbers are in another unit than assumed, they are this many times too large."""
    unit: str | None
    """That other unit; both None if no unit explains the misfit."""
    text: str
    """One line for people."""


@dataclass(frozen=True)
class Proportions:
    """Sizes of tool, path and scene, and the distance between path and scene, in metres."""

    scene: Floats | None
    """(2, 3) lower and upper corner of the objects that can be hit; None if there are none."""
    tool: float
    """Longest side of the tool's box."""
    path: Floats | None
    """(2, 3) corners of the box that the tool's middle moves in; None if the path is unknown."""
    gap: float | None
    """Lower bound of the distance from the tool to the box of any object; 0 if boxes meet, None
    without a path or a scene."""
    misfits: tuple[Misfit, ...]
    """Empty if all fit or too little is known."""

    @property
    def text(self) -> str:
        """All misfits in one line; empty if there are none."""
        return "; ".join(misfit.text for misfit in self.misfits)

    def record(self) -> dict[str, Any]:
        """All fields for JSON, in metres."""
        return {
            "scene": None if self.scene is None else self.scene.tolist(),
            "tool": self.tool,
            "path": None if self.path is None else self.path.tolist(),
            "gap": self.gap,
            "misfits": [misfit._asdict() for misfit in self.misfits],
        }


def compare_proportions(
    objects: Iterable[Object],
    voxel_size: float,
    shell: PointShell,
    poses: ArrayLike | None = None,
    *,
    exclude: Iterable[int] = (),
    tool_unit: str | None = "m",
    path_unit: str = "m",
    is_path_unit_given: bool = False,
    is_moving: bool = True,
    margin: float = 0.0,
) -> Proportions:
    """Compare the sizes and places of a tool, its path and a scene, from their boxes alone.

    Parameters
    ----------
    objects, voxel_size
        Of the environment; metres.
    shell : PointShell
        The tool, metres.
    poses : (M, 4, 4) array or None
        `world_from_tool`, metres; None if the path is not known in advance.
    exclude : iterable of int
        Ids of objects that are left out.
    tool_unit, path_unit : str
        Units in which the numbers of tool and path were read, of `hapticdb.mesh.UNITS`. A
        `tool_unit` of None skips the check of the tool's size, as does `shell.has_unit`: the tool
        is a part of the scene.
    is_path_unit_given : bool
        Whether a person gave `path_unit`; else it is assumed.
    is_moving : bool
        Whether the tool moves in straight lines between the poses; else it is only at the poses.
    margin : float
        Metres by which the tool may leave the path.

    Raises
    ------
    UsageError
        If the poses have another shape, there are none, or a unit is unknown.
    """
    left_out = set(exclude)
    felt = [obj for obj in objects if obj.id not in left_out]
    scene = scene_bounds(felt)
    tool = _Tool.of(shell)
    centers = None if poses is None else _centers(poses, tool)
    path = None if centers is None else np.stack([centers.min(axis=0), centers.max(axis=0)])
    if scene is None:
        empty = Misfit("scene", None, None, "the scene holds nothing that could be hit")
        return Proportions(None, tool.length, path, None, (empty,))
    boxes = np.array([obj.bounds for obj in felt])
    is_known = all("unit" in obj.attributes or not _is_unitless(obj.link) for obj in felt)
    look = _Look(boxes, scene, voxel_size, tool, centers, is_moving, margin, is_known)
    gap = None if centers is None else look.gap()
    misfits = [] if tool_unit is None or shell.has_unit else _tool_misfits(look, tool_unit)
    misfits += _path_misfits(look, gap, None if is_path_unit_given else path_unit)
    scenes = [misfit for misfit in misfits if misfit.what == "scene"]
    # a misfit of the scene explains those of tool and path, so it is reported alone
    return Proportions(scene, tool.length, path, gap, tuple(scenes[:1] or misfits))


class _Tool(NamedTuple):
    """A tool's box, metres."""

    middle: Floats  # (3,) tool frame
    radius: float  # from the middle to the farthest point
    length: float  # longest side

    @classmethod
    def of(cls, shell: PointShell) -> "_Tool":
        points = shell.outline
        low, high = points.min(axis=0), points.max(axis=0)
        middle = 0.5 * (low + high)
        radius = float(np.sqrt(((points - middle) ** 2).sum(axis=1).max()))
        return cls(middle, radius, float((high - low).max()))


class _Look(NamedTuple):
    """Boxes to compare, metres; is_moving, margin as for `compare_proportions`.

    has_unit : whether the unit of every object was given by a person or its file.
    """

    boxes: Floats  # (O, 2, 3) of the objects
    scene: Floats  # (2, 3) of all objects
    voxel_size: float
    tool: _Tool
    centers: Floats | None  # (M, 3) places of the tool's middle
    is_moving: bool
    margin: float
    has_unit: bool

    @property
    def extent(self) -> float:
        """Longest side of the scene, metres."""
        return float((self.scene[1] - self.scene[0]).max())

    @property
    def way(self) -> float:
        """Longest side of the box that the tool's middle moves in, metres; 0 if it is unknown."""
        return 0.0 if self.centers is None else float(np.ptp(self.centers, axis=0).max())

    def gap(self, path_factor: float = 1.0, scene_factor: float = 1.0) -> float:
        """Lower bound of the distance from the tool to all boxes, metres.

        Path and scene are scaled by the factors first. The bound uses the box of each straight
        piece of the path and the tool's radius, so it holds for a tool of any shape.
        """
        assert self.centers is not None  # noqa: S101 - asked for paths alone
        at = self.centers * path_factor
        low, high = at, at
        if self.is_moving and len(at) > 1:
            low, high = np.minimum(at[:-1], at[1:]), np.maximum(at[:-1], at[1:])
        joined = -(-len(low) * len(self.boxes) // PAIRS)
        starts = np.arange(0, len(low), joined)
        low, high = np.minimum.reduceat(low, starts), np.maximum.reduceat(high, starts)
        boxes = self.boxes * scene_factor
        least = np.inf
        per_block = max(1, PAIRS // 4 // len(boxes))
        for start in range(0, len(low), per_block):
            some = slice(start, start + per_block)
            apart = np.maximum(
                np.maximum(boxes[:, 0] - high[some, None], low[some, None] - boxes[:, 1]), 0.0
            )
            with np.errstate(over="ignore"):
                nearest = float(np.sqrt((apart**2).sum(axis=2).min()))
            least = min(least, max(nearest - self.tool.radius - self.margin, 0.0))
            if least == 0.0:
                break
        return least


def _centers(poses: ArrayLike, tool: _Tool) -> Floats:
    """Places (M, 3) of the tool's middle at poses."""
    given = as_floats(poses, "a path")
    if given.ndim != 3 or given.shape[1:] != (4, 4) or not len(given):
        raise UsageError(f"a path of shape {given.shape}: give poses (M, 4, 4), one at least")
    return np.asarray(given[:, :3, :3] @ tool.middle + given[:, :3, 3])


def _tool_misfits(look: _Look, unit: str) -> list[Misfit]:
    """Compare the tool's size with the scene and the voxels."""
    length, extent = look.tool.length, look.extent
    if length > max(extent, LARGE_TOOL):
        is_off = f"{length / extent:.3g} times as long as the scene, {length_text(extent)}"
    elif length < look.voxel_size:
        is_off = f"smaller than a voxel ({length_text(look.voxel_size)})"
        if look.centers is not None and 0.0 < look.way < 0.01 * extent and not look.has_unit:
            return [_scene_misfit(look, is_off)]
    else:
        return []
    text = f"the tool is {length_text(length)} long, {is_off}"
    for other, factor in _suspects(unit):
        if look.voxel_size <= length * factor <= extent:
            return [_explained("tool", text, "it would fit", other, unit)]
    return [Misfit("tool", None, None, text)]


def _scene_misfit(look: _Look, is_off: str) -> Misfit:
    """Misfit of a scene that is far larger than both tool and path."""
    extent, tool, way = map(length_text, (look.extent, look.tool.length, look.way))
    text = f"the scene is {extent} long, but the tool {tool}, {is_off}, and its path {way}"
    for other, factor in _suspects("m"):
        fits = look.voxel_size * factor <= look.tool.length <= look.extent * factor
        if factor < 1.0 and fits and look.way >= 0.01 * look.extent * factor:
            return _explained("scene", text, "it would fit", other, "m")
    return Misfit("scene", None, None, text)


def _path_misfits(look: _Look, gap: float | None, unit: str | None) -> list[Misfit]:
    """Compare the path's place and length with the scene and the tool.

    unit : None where it was given: then only the place may be a misfit.
    """
    if gap is None:
        return []
    extent, way = look.extent, look.way
    larger, long = max(extent, look.tool.length), length_text(extent)
    # single poses are meant to touch the scene; a moving tool may pass the scene on purpose
    is_far = gap > (larger if look.is_moving else 0.25 * extent)
    if is_far:
        text = f"the path never comes within {length_text(gap)} of the scene, {long} long"
    elif way > LONG_PATH * larger and unit is not None:
        text = f"the path is {way / extent:.3g} times as long as the scene, {long}"
    else:
        return []
    is_small = 5.0 * extent < min(look.tool.length, way) and look.tool.length < LARGE_TOOL
    if is_far and is_small and not look.has_unit:
        # tool and path fit each other, so the scene is the misfit
        for other, factor in _suspects("m"):
            if look.tool.length <= extent * factor and look.gap(1.0, factor) == 0.0:
                return [_explained("scene", text, "the scene would fit", other, "m")]
    if unit is None:
        return [Misfit("path", None, None, text)]
    for other, factor in _suspects(unit):
        # a path shrunk to the origin meets any scene there, so a least length is required
        is_likely = way * factor >= 0.1 * extent or gap > LONG_PATH * larger
        if is_likely and way * factor <= 10.0 * larger and look.gap(factor) == 0.0:
            return [_explained("path", text, "it would meet it", other, unit)]
    return [Misfit("path", None, None, text)]


def _is_unitless(link: str) -> bool:
    return Path(link).suffix.lower() in UNITLESS


def _suspects(unit: str) -> list[tuple[str, float]]:
    """Other units, each with the factor of a length that is in that unit instead of `unit`."""
    own = metres_of(unit)
    return [(other, UNITS[other] / own) for other in LIKELY if UNITS[other] != own]


def _explained(what: What, text: str, outcome: str, other: str, unit: str) -> Misfit:
    """Misfit that disappears if the numbers are in the unit `other` instead of `unit`."""
    factor = UNITS[other] / UNITS[unit]
    by = 1.0 / factor if factor < 1.0 else factor
    if other == "km":  # no file is in km: a conversion to metres was applied twice
        return Misfit(what, 1.0 / factor, None, f"{text}: {outcome} {by:.4g} times as large")
    guess = f"{outcome} if its numbers were {NAMES[other]}, not {NAMES[unit]} (factor {by:.4g})"
    return Misfit(what, 1.0 / factor, other, f"{text}: {guess}")
