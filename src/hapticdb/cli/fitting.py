"""Warns of a tool whose size suggests a wrong unit."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

from hapticdb.cli import render
from hapticdb.units import length_text

if TYPE_CHECKING:
    from hapticdb.environment import Environment
    from hapticdb.pointshell.shell import PointShell


def warn_of_size(env: "Environment", shell: "PointShell", left_out: Iterable[int]) -> None:
    """Note a tool longer than the scene, or shorter than a voxel.

    Lengths are the longest sides of boxes. A unit that a person or the file gave is believed.
    """
    import numpy as np

    from hapticdb.store.attributes import scene_bounds

    gone = set(left_out)
    scene = scene_bounds(obj for obj in env.objects() if obj.id not in gone)
    if shell.has_unit or scene is None:
        return
    length, extent = float(np.ptp(shell.outline, axis=0).max()), float(np.ptp(scene, axis=0).max())
    if length > extent:
        compared = f"longer than the scene ({length_text(extent)})"
    elif length < env.grid.voxel_size:
        compared = f"shorter than a voxel ({length_text(env.grid.voxel_size)})"
    else:
        return
    render.note(f"the tool is {length_text(length)} long, {compared}: is --tool-unit right?")
