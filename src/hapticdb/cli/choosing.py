"""Objects that the words of an option choose: ids, names, patterns."""

from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hapticdb.environment import Environment
    from hapticdb.store.base import Object


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
