"""Whether the sizes of tool, path and scene fit together, told before a verb begins."""

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from hapticdb.cli import render
from hapticdb.units import UNITLESS, length_text

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hapticdb.environment import Environment
    from hapticdb.pointshell.shell import PointShell
    from hapticdb.proportions import Proportions


def compare(
    env: "Environment",
    shell: "PointShell",
    poses: "NDArray[np.float64]",
    *,
    exclude: Iterable[int],
    tool: str | None,
    tool_unit: str | None,
    path_unit: str | None,
    is_moving: bool,
    reach: float = 0.0,
) -> "Proportions":
    """Compare the sizes and places of tool, path and scene; tell what does not fit.

    tool : its file, or None where parts of the environment are the tool; reach : distance from a
    surface, metres, from which on a force law may feel it.
    """
    from hapticdb.proportions import compare_proportions

    found = compare_proportions(
        env.objects(),
        env.grid.voxel_size,
        shell,
        poses,
        exclude=exclude,
        tool_unit=None if tool is None else tool_unit or "m",
        path_unit=path_unit or "m",
        is_path_unit_given=path_unit is not None,
        is_moving=is_moving,
    )
    tell(found, tool, "--path-unit")
    if not found.misfits and found.gap and found.gap > reach and not is_moving:
        render.note(
            f"no pose comes within {length_text(found.gap)} of the scene: nothing can be touched"
        )
    return found


def tell(found: "Proportions", tool: str | None, path_option: str) -> None:
    """Say in a line what does not fit, and which option sets it right."""
    if not found.misfits:
        return
    is_unitless = tool is not None and Path(tool).suffix.lower() in UNITLESS
    hints = []
    for misfit in found.misfits:
        if misfit.what == "path" and misfit.factor is not None:
            value = f"{1.0 / misfit.factor:.4g}" if path_option == "--scale" else misfit.unit
            hints.append(f"{path_option} {value}")
        elif misfit.what == "tool" and misfit.unit is not None and is_unitless:
            hints.append(f"--tool-unit {misfit.unit}")
    hint = f"; give {' '.join(hints)} if so" if hints else ""
    render.note(f"{found.text}{hint}")
