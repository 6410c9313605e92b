"""Opening of environments, and selection of objects by the words of an option."""

from collections.abc import Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple

import hapticdb
from hapticdb.cli import render
from hapticdb.errors import ObjectNotFoundError, ReadOnlyError

if TYPE_CHECKING:
    from hapticdb.environment import Environment
    from hapticdb.store.base import Object
    from hapticdb.store.finding import HasObjects


class FilterWords(NamedTuple):
    """Words of ``--where`` and ``--exclude``, and ids of the objects excluded by them now."""

    where: list[str]
    exclude: list[int | str]
    excluded: list[int]


@dataclass(frozen=True)
class FilterOptions:
    """Options ``--where`` and ``--exclude``: filter of the objects with contacts."""

    where: list[str] | None = None
    exclude: list[str] | None = None

    def resolve(self, env: "Environment", parts: Iterable[int] = ()) -> FilterWords:
        """Filter of checked words; parts : ids of moving objects, excluded, too."""
        words = as_named(env, self.where or (), "--where")
        more = as_named(env, self.exclude or (), "--exclude")
        _found(env, words, "--where")
        _found(env, more, "--exclude")
        excluded: list[int | str] = [*parts, *more]
        if not words and not excluded:
            return FilterWords([], [], [])
        selected = {obj.id for obj in env.select(words, excluded)}
        return FilterWords(
            words, excluded, [obj.id for obj in env.objects() if obj.id not in selected]
        )


def opened_to_store(url: str) -> "Environment":
    """Open an environment for writing, to store results; read-only for users without that right."""
    try:
        return hapticdb.open(url)
    except ReadOnlyError:
        return hapticdb.open(url, read_only=True)


def chosen(env: "HasObjects", words: Iterable[str], option: str) -> "list[Object]":
    """Objects chosen by the words of an option, ordered by id; the error names the option."""
    return _found(env, as_named(env, words, option), option)


def _found(env: "HasObjects", words: list[str], option: str) -> "list[Object]":
    from hapticdb.store.finding import find_objects

    try:
        return find_objects(env, words)
    except ObjectNotFoundError as error:
        raise ObjectNotFoundError(f"{option}: {error}") from None


def as_named(env: "HasObjects", words: Iterable[str], option: str) -> list[str]:
    """Words of an option; a number that fits only a name becomes a name. Notes such numbers."""
    from hapticdb.store.finding import NAME, find_objects, is_id

    taken = []
    for word in words:
        named: set[int] = set()
        if is_id(word):
            with suppress(ObjectNotFoundError):
                named = {obj.id for obj in find_objects(env, [NAME + word])} - {int(word)}
        is_name = named and all(obj.id != int(word) for obj in env.objects())
        if is_name:
            render.note(f"{option}: {word} is taken as a name: no object has this id")
        elif named:
            render.note(f"{option}: {word} is taken as an id; '{NAME}{word}' is a name")
        taken.append(NAME + word if is_name else word)
    return taken


def ids_of(env: "Environment", words: Iterable[str] | None, option: str) -> list[int]:
    """Ids of the objects chosen by the words of an option."""
    return [obj.id for obj in chosen(env, words or (), option)]
