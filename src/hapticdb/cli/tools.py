"""The tool that a file holds."""

from typing import TYPE_CHECKING

from hapticdb.cli import render
from hapticdb.errors import UsageError

if TYPE_CHECKING:
    from hapticdb.pointshell.shell import PointShell


def shell_of(
    tool: str,
    unit: str | None,
    points: int | None,
    seed: int | None,
    spacing: float | None = None,
) -> "PointShell":
    """Shell of a tool's file, its defects told; --points and --seed as they were given."""
    from hapticdb.pointshell.shell import PointShell

    if tool.lower().endswith(".npz") and (points is not None or seed is not None):
        raise UsageError(f"{tool} is a saved shell: leave out --points and --seed")
    shell = PointShell.from_file(tool, points, spacing=spacing, unit=unit, seed=seed or 0)
    if shell.defects:
        render.note(f"{tool}: found in the file: {shell.defects}")
    if not shell.is_closed:
        render.note(f"{tool}: the tool's mesh is open, so its inside is a guess")
    return shell
