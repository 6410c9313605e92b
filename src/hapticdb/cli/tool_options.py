"""Tools read from files, with notes on defects and doubtful sizes."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from hapticdb.cli import render
from hapticdb.cli.options import UnitName
from hapticdb.errors import UsageError
from hapticdb.units import length_text, unit_doubt

if TYPE_CHECKING:
    from hapticdb.environment import Environment
    from hapticdb.pointshell.shell import PointShell
    from hapticdb.pointshell.shell_cache import Tool
    from hapticdb.query.law import LawName


@dataclass(frozen=True)
class ToolOptions:
    """Options of the tool, and of the points on its surface."""

    tool: str
    tool_unit: UnitName | None = None
    points: int | None = None
    seed: int | None = None
    conservative: bool = False

    def made(self, env: "Environment", law: "LawName", excluded: Iterable[int]) -> "Tool":
        """Tool with points inset by the law's onset of contact; on its surface if conservative."""
        from hapticdb.query.law import inset_of

        inset = 0.0 if self.conservative else inset_of(env.grid.voxel_size, law)
        made = tool_of(self.tool, self.tool_unit, self.points, self.seed, inset)
        warn_of_size(env, made, excluded)
        return made


def tool_of(
    tool: str, unit: str | None, points: int | None, seed: int | None, inset: float = 0.0, *,
    has_surface: bool = False,
) -> "Tool":  # fmt: skip
    """Tool of a file, with notes on its defects; points, seed : as given, None if not.

    inset : inward offset of its points, metres, without effect on a saved shell; has_surface :
    whether its triangles are required, so the file is read and the cache bypassed.
    """
    if tool.lower().endswith(".npz") and (points is not None or seed is not None):
        raise UsageError(f"{tool} is a saved shell: leave out --points and --seed")
    with render.bar("sampling the tool", "points"):
        from hapticdb.pointshell.shell_cache import cached_tool, made_tool

        make = made_tool if has_surface else cached_tool
        found = make(tool, points, unit=unit, seed=seed or 0, inset=inset)
    shell = found.shell
    if shell.defects:
        render.note(f"{tool}: found in the file: {shell.defects}")
    if not shell.is_closed:
        render.note(f"{tool}: the tool's mesh is open, so its inside is a guess")
    deepest = float(shell.inset.max())
    if deepest > 1.001 * inset:
        render.note(
            f"{tool}: a saved shell, drawn in by {length_text(deepest)}: contact begins up to "
            f"{length_text(deepest - inset)} late; give the mesh it was made of, if that matters"
        )
    return found


def warn_of_size(env: "Environment", tool: "Tool", excluded: Iterable[int]) -> None:
    """Note a tool longer than the scene, or shorter than a voxel: its unit may be wrong.

    Lengths are the longest sides of AABBs. A unit given by the user or the file is trusted.
    """
    import numpy as np

    from hapticdb.store.attributes import scene_bounds

    gone = set(excluded)
    scene = scene_bounds(obj for obj in env.objects() if obj.id not in gone)
    if tool.shell.has_unit or scene is None:
        return
    doubt = unit_doubt(tool.length, float(np.ptp(scene, axis=0).max()), env.grid.voxel_size)
    if doubt:
        render.note(f"the tool is {doubt}")


def shell_text(shell: "PointShell") -> str:
    """Number of a shell's points and their inset, in words."""
    points, deepest = render.counted(len(shell), "point"), float(shell.inset.max())
    if deepest == 0.0:
        return f"{points}, on the surface"
    n_less = int((shell.inset < 0.98 * deepest).sum())
    less = f"; {n_less:,} of them less, in thin or sharp parts" if n_less else ""
    return f"{points}, drawn in by {length_text(deepest)}{less}"


def shell_record(shell: "PointShell") -> dict[str, object]:
    """Number of a shell's points and the range of their insets, metres, for JSON."""
    return {
        "points": len(shell),
        "inset": {"least": float(shell.inset.min()), "greatest": float(shell.inset.max())},
    }
