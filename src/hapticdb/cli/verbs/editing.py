"""The verbs that edit an environment: move, remove."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hapticdb.cli import render
from hapticdb.cli.choosing import chosen
from hapticdb.cli.options import JsonOption, ObjectsArgument, UrlArgument
from hapticdb.cli.values import numbers_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray


def move(
    url: UrlArgument,
    objects: ObjectsArgument,
    *,
    translate: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z", help="Shift from the present place, metres, world frame."),
    ] = None,
    pose: Annotated[
        str | None,
        typer.Option(metavar="X,Y,Z,QW,QX,QY,QZ", help="New placement: metres, unit quaternion."),
    ] = None,
    matrix: Annotated[
        str | None,
        typer.Option(
            metavar="FILE",
            help="New placement: 16 numbers, row by row, in a text file or separated by commas.",
        ),
    ] = None,
    json: JsonOption = False,
) -> None:
    """Place objects anew; their geometry is read from their files again.

    --translate shifts all objects that are chosen, or none of them when one would
    leave the grid; --pose and --matrix place one object. 'hapticdb objects --help' says how
    names choose objects.

    Example: hapticdb move car.db 17 --translate 0,0,0.25

    Example: hapticdb move car.db 'body/door_*' --translate 0,0,0.25
    """
    import hapticdb
    from hapticdb.cli.verbs.listing import record_of
    from hapticdb.errors import UsageError

    given = [option for option in (translate, pose, matrix) if option is not None]
    if len(given) != 1:
        raise UsageError("give one of --translate, --pose and --matrix")
    placed = _placement(pose, matrix)
    shift = translate and numbers_of(translate, 3, "--translate", "X,Y,Z in metres")
    with hapticdb.open(url) as env:
        found = chosen(env, objects, "WORDS")
        if not shift and len(found) > 1:
            raise UsageError(
                f"--pose and --matrix place one object, and {len(found)} are chosen: give one, or "
                "--translate"
            )
        render.compile_kernels("move")
        if shift:
            moved = env.shift([obj.id for obj in found], shift)
        else:
            if pose is not None:
                _check_unscaled(found[0].transform)
            moved = [env.move(found[0].id, placed)]
    for obj in moved:
        if json:
            render.say_json(record_of(obj))
        else:
            low, high = (", ".join(f"{x:.4g}" for x in corner) for corner in obj.bounds.tolist())
            render.say(f"moved {obj.id} ({obj.name}): now from ({low}) to ({high}) m")


def _check_unscaled(transform: "NDArray[np.float64]") -> None:
    """Refuse a pose for a part that its file scales: it would change its size in silence."""
    import numpy as np

    from hapticdb.errors import UsageError

    turned = transform[:3, :3]
    if not np.allclose(turned.T @ turned, np.eye(3), atol=1e-6):
        scale = float(abs(np.linalg.det(turned))) ** (1 / 3)
        raise UsageError(
            f"--pose would change the object's size: its file places it scaled by {scale:.4g}; "
            "use --translate, or --matrix with the scale in it"
        )


def _placement(pose: str | None, matrix: str | None) -> "NDArray[np.float64]":
    """world_from_part (4, 4) of the options; the identity without any."""
    import numpy as np

    from hapticdb.errors import UsageError
    from hapticdb.poses import rotation_of

    placed = np.eye(4)
    if pose is not None:
        numbers = np.array(numbers_of(pose, 7, "--pose", "X,Y,Z,QW,QX,QY,QZ"))
        norm = float(np.linalg.norm(numbers[3:]))
        if not norm > 1e-9:
            raise UsageError(f"--pose {pose!r}: the quaternion is no rotation")
        placed[:3, :3] = rotation_of(numbers[3:] / norm)[0]
        placed[:3, 3] = numbers[:3]
    elif matrix is not None:
        text = _matrix_text(matrix)
        placed = np.array(numbers_of(text, 16, "--matrix", "a file of 16 numbers")).reshape(4, 4)
    return placed


def _matrix_text(matrix: str) -> str:
    """Return the option itself where it holds numbers, else what is in the file that it names."""
    from hapticdb.errors import FileError

    if len(matrix.replace(",", " ").split()) == 16:
        return matrix
    try:
        return Path(matrix).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise FileError(f"--matrix: no file at {matrix}; give one, or 16 numbers") from None
    except (OSError, ValueError) as error:
        raise FileError(f"--matrix: cannot read {matrix}: {error}") from None


def remove(url: UrlArgument, objects: ObjectsArgument, *, json: JsonOption = False) -> None:
    """Remove objects, each in a transaction of its own.

    'hapticdb objects --help' says how names choose objects.

    Example: hapticdb remove car.db 17 18

    Example: hapticdb remove car.db 'wheel_bolt_*'
    """
    import hapticdb
    from hapticdb.cli.verbs.listing import record_of

    with hapticdb.open(url) as env:
        for obj in chosen(env, objects, "WORDS"):  # all, or an error before any is removed
            env.remove(obj.id)
            if json:
                render.say_json(record_of(obj))
            else:
                render.say(f"removed {obj.id} ({obj.name})")
