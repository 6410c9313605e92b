"""The tool that a file holds."""

from pathlib import Path
from typing import TYPE_CHECKING

from hapticdb.cli import render
from hapticdb.errors import FileError, UsageError
from hapticdb.units import length_text

if TYPE_CHECKING:
    from hapticdb.pointshell.shell import PointShell


def compile_for(tool: str, *purposes: str) -> None:
    """Compile the kernels of purposes; refuse a tool whose file is missing before that."""
    if not Path(tool).exists():
        raise FileError(f"cannot read {tool}: there is no such file")
    render.compile_kernels(*purposes)


def shell_of(
    tool: str,
    unit: str | None,
    points: int | None,
    seed: int | None,
    spacing: float | None = None,
    inset: float = 0.0,
) -> "PointShell":
    """Shell of a tool's file, its defects told; --points and --seed as they were given.

    inset : how far its points are drawn inward, metres; a saved shell stays as it was saved.
    """
    if tool.lower().endswith(".npz") and (points is not None or seed is not None):
        raise UsageError(f"{tool} is a saved shell: leave out --points and --seed")
    with render.bar("sampling the tool", "points"):
        from hapticdb.pointshell.shell import PointShell

        shell = PointShell.from_file(
            tool, points, spacing=spacing, unit=unit, seed=seed or 0, inset=inset
        )
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
    return shell


def shell_text(shell: "PointShell") -> str:
    """Say of a shell how many points it has, and how far they are drawn in."""
    points, deepest = render.counted(len(shell), "point"), float(shell.inset.max())
    if deepest == 0.0:
        return f"{points}, on the surface"
    n_less = int((shell.inset < 0.98 * deepest).sum())
    less = f"; {n_less:,} of them less, in thin or sharp parts" if n_less else ""
    return f"{points}, drawn in by {length_text(deepest)}{less}"


def shell_record(shell: "PointShell") -> dict[str, object]:
    """Put the same in JSON."""
    return {
        "points": len(shell),
        "inset": {"least": float(shell.inset.min()), "greatest": float(shell.inset.max())},
    }
