"""Finds objects by ids, names and patterns."""

import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from fnmatch import translate
from operator import index

from hapticdb.errors import ObjectNotFoundError, UsageError
from hapticdb.store.base import Object, Store
from hapticdb.store.refusals import no_object

MOST_IDS = 1 << 63
"""All ids lie below this value: they are signed 64-bit integers in the databases."""


def find_objects(store: Store, words: Iterable[int | str]) -> list[Object]:
    """Objects that ids, names and patterns choose, each once, ordered by id.

    Parameters
    ----------
    store : Store
        Store of the objects. It is asked for all objects once, and only if a word is a name.
    words : iterable of int or str
        An int, or a text of digits, is an id; ``3,4`` is several. Any other text is a name or a
        pattern as of `fnmatch`: ``*`` stands for any characters, ``?`` for one, ``[ab]`` for one of
        those; case counts. Names are paths, such as ``body/door/handle``: a text without ``/`` is
        compared with every element of the path, one with ``/`` with the path from its beginning.
        If the match is a sub-assembly, everything below it is chosen. A text that is exactly a name
        is no pattern. A text with commas is several words, unless it matches as a whole.

    Raises
    ------
    ObjectNotFoundError
        When a word chooses nothing.
    UsageError
        When a word is neither an int nor a text.
    """
    listed: list[Object] = []

    def chosen(word: int | str) -> list[Object]:
        if isinstance(word, int):
            if not -MOST_IDS <= word < MOST_IDS:
                raise no_object(word, store.url)
            return [store.object(word)]
        pieces = [piece.strip() for piece in word.split(",")]
        if all(piece.isascii() and piece.isdecimal() for piece in pieces):
            return [obj for piece in pieces for obj in chosen(_id_of(piece, store.url))]
        listed.extend([] if listed else store.objects())
        if found := named_like(listed, word):
            return found
        if len(pieces) > 1:
            return [obj for piece in pieces for obj in chosen(piece)]
        raise _nothing_like(word, listed, store.url)

    found = {obj.id: obj for word in _checked(words) for obj in chosen(word)}
    return [found[i] for i in sorted(found)]


def named_like(objects: Sequence[Object], pattern: str) -> list[Object]:
    """Objects that a name or pattern chooses, by the rules of `find_objects`, in their order."""
    pattern = pattern.rstrip("/") or pattern
    branches = [_branches(obj.name, is_path="/" in pattern) for obj in objects]
    as_it_stands = [obj for obj, some in zip(objects, branches, strict=True) if pattern in some]
    if as_it_stands:
        return as_it_stands
    fits: Callable[[str], object] = re.compile(translate(pattern)).match
    return [obj for obj, some in zip(objects, branches, strict=True) if any(map(fits, some))]


def _branches(name: str, *, is_path: bool) -> list[str]:
    """Texts to compare a pattern with: a path's elements, or each beginning of the path."""
    elements = name.split("/")
    if not is_path:
        return elements
    return ["/".join(elements[: n + 1]) for n in range(len(elements))]


def _checked(words: Iterable[int | str]) -> list[int | str]:
    """Words as ids and texts; anything else is refused before the first lookup."""
    if isinstance(words, (str, bytes)) or not isinstance(words, Iterable):
        raise UsageError(f"objects {words!r}: give ids, names and patterns in a list")
    checked: list[int | str] = []
    for word in words:
        try:
            if isinstance(word, bool):
                raise TypeError  # noqa: TRY301 - to Python a bool is an int, but it is no id
            checked.append(word if isinstance(word, str) else index(word))
        except TypeError:
            raise UsageError(f"object {word!r}: give an id, a name or a pattern") from None
    return checked


def _id_of(digits: str, url: str) -> int:
    if len(digits.lstrip("0")) > len(str(MOST_IDS)):  # Python refuses texts of 4,300 digits
        raise ObjectNotFoundError(f"no object {digits[:40]}... in {url}")
    return int(digits)


def _nothing_like(word: str, objects: Sequence[Object], url: str) -> ObjectNotFoundError:
    """Build the error for a name or pattern that fits nothing."""
    folded = [replace(obj, name=obj.name.casefold()) for obj in objects]
    names = {obj.id: obj.name for obj in objects}
    if alike := named_like(folded, word.casefold()):
        hint = f", where case counts: there is {names[alike[0].id]!r}"
    elif word.strip("*/ ") and (alike := named_like(folded, f"*{word.strip('*/ ').casefold()}*")):
        hint = f", but {names[alike[0].id]!r}" + (f" and {len(alike) - 1} more" * (len(alike) > 1))
    else:
        hint = ""
    return ObjectNotFoundError(
        f"no object {word[:80]!r} in {url}{hint}; 'hapticdb objects {url}' lists the names"
    )
