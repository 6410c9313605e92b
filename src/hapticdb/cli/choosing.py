"""Options and arguments that choose objects: by id, by name, by pattern."""

from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from hapticdb.environment import Environment
    from hapticdb.store.base import Object

Exclude = Annotated[
    list[str] | None,
    typer.Option(
        metavar="ID|NAME", help="Objects that are not felt; 7 or 3,4 or 'wheel*'; again for more."
    ),
]
Parts = Annotated[
    list[str] | None,
    typer.Option(
        "--part",
        metavar="ID|NAME",
        help="Instead of --tool: the objects that move, all together; as for --exclude.",
    ),
]
Chosen = Annotated[
    list[str],
    typer.Argument(
        metavar="ID|NAME...", help="As 'hapticdb objects' lists them: 7 or 3,4 or 'wheel*'."
    ),
]


def chosen(env: "Environment", words: Iterable[str], option: str) -> "list[Object]":
    """Objects that the words of an option choose, ordered by id; the error names the option."""
    from hapticdb.errors import ObjectNotFoundError

    try:
        return env.find(*words)
    except ObjectNotFoundError as error:
        raise ObjectNotFoundError(f"{option}: {error}") from None


def ids_of(env: "Environment", words: Iterable[str] | None, option: str) -> list[int]:
    """Ids of those objects."""
    return [obj.id for obj in chosen(env, words or (), option)]
