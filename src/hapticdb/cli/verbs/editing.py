"""Verbs for editing an environment: move, remove."""

import hapticdb
from hapticdb.cli.emit import Output
from hapticdb.cli.root import left_at
from hapticdb.cli.selection import chosen
from hapticdb.cli.values import Point, numbers_of
from hapticdb.errors import UsageError
from hapticdb.tabular.schema import OBJECT, record


def move(
    url: str, objects: list[str], *, translate: Point | None = None, matrix: str | None = None,
    output: Output,
) -> None:  # fmt: skip
    """Move objects.

    --translate shifts all chosen objects in one transaction: all or none of them move, even if the
    command is interrupted; --matrix places one object. 'hapticdb objects --help' explains how to
    choose objects.

    Example: hapticdb move car.db 17 --translate 0,0,0.25

    Example: hapticdb move car.db 'body/door_*' --translate 0,0,0.25
    """
    import numpy as np

    if (translate is None) == (matrix is None):
        raise UsageError("give one of --translate and --matrix")
    placed = matrix and numbers_of(matrix, 16, "--matrix", "16 numbers")
    with hapticdb.open(url) as env:
        found = chosen(env, objects, "WORDS")
        if placed and len(found) > 1:
            raise UsageError(f"--matrix places one object, and {len(found)} are chosen: give one")
        with left_at(f"all have moved, or nothing: see 'hapticdb objects {env.url}'"):
            if translate:
                moved = env.shift([obj.id for obj in found], translate)
            else:
                moved = [env.move(found[0].id, np.array(placed).reshape(4, 4))]
    for obj in moved:
        low, high = (", ".join(f"{x:.4g}" for x in corner) for corner in obj.bounds.tolist())
        words = f"moved {obj.id} ({obj.name}): now from ({low}) to ({high}) m"
        output.emit(record(obj, OBJECT), words)


def remove(url: str, objects: list[str], *, output: Output) -> None:
    """Remove objects.

    Each is removed in a transaction of its own. 'hapticdb objects --help' explains how to choose
    objects.

    Example: hapticdb remove car.db 17 18

    Example: hapticdb remove car.db 'wheel_bolt_*'
    """
    with hapticdb.open(url) as env:
        for obj in chosen(env, objects, "WORDS"):  # all, or an error before any is removed
            env.remove(obj.id)
            output.emit(record(obj, OBJECT), f"removed {obj.id} ({obj.name})")
