"""Search for objects by ids, names, patterns and attributes."""

import re
import unicodedata
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from difflib import get_close_matches
from fnmatch import translate
from operator import index
from typing import Protocol

from hapticdb.errors import ObjectNotFoundError, UsageError
from hapticdb.store.attributes import attribute_hint, having_attribute
from hapticdb.store.base import Object
from hapticdb.store.store_errors import no_object

MOST_IDS = 1 << 63
"""Upper bound of ids: signed 64-bit integers in the databases."""

NAME = "name="
"""Prefix of a name that reads as an id or an attribute."""

Words = Iterable[int | str]
"""Ids, names, patterns and ``attribute=value``, as of `find_objects`."""


class HasObjects(Protocol):
    """Source of objects: a store, or an environment with its cache of objects."""

    @property
    def url(self) -> str:
        """URL for messages."""

    def objects(self) -> list[Object]:
        """All objects, ordered by id."""

    def object(self, object_id: int, /) -> Object:
        """One object; raises ObjectNotFoundError for an unknown id."""


def find_objects(store: HasObjects, words: Words) -> list[Object]:
    """Objects selected by ids, names, patterns and attributes, each once, ordered by id.

    The store lists all objects once, and only for a word other than an id. An int, or a text of
    digits, is an id; ``3,4`` is several. Any other text, such as ``007``, is a name or a pattern as
    of `fnmatch`; case counts. Names are paths, such as ``body/door/handle``: a text without ``/``
    is compared with every element of the path, one with ``/`` with the path from its beginning. A
    sub-assembly selects everything below it. Names are compared in Unicode's normal form C. A text
    equal to a name is no pattern. A text with ``=`` and without a matching name is
    ``attribute=value``: see `hapticdb.store.attributes.having_attribute`. ``name=3`` is a name,
    too. A text with commas is several words, unless it matches as a whole.

    Raises `ObjectNotFoundError` for a word without a match; `UsageError` for a word other than an
    int or a text.
    """
    checked = checked_words(words)
    if all(isinstance(word, int) for word in checked):
        found = []
        for object_id in sorted({word for word in checked if isinstance(word, int)}):
            if not -MOST_IDS <= object_id < MOST_IDS:
                raise no_object(object_id, store.url)
            found.append(store.object(object_id))
        return found
    return Listing(store.objects(), store.url).chosen(checked)


class Listing:
    """All objects of one revision, in order, for `find_objects`; url : for messages."""

    def __init__(self, objects: Sequence[Object], url: str) -> None:
        self._objects = objects
        self._by_id = {obj.id: obj for obj in objects}
        self._url = url

    def chosen(
        self, words: Words, missing: list[ObjectNotFoundError] | None = None
    ) -> list[Object]:
        """Objects selected by words, each once.

        missing : receives the errors of words without a match; without it, the first one is raised.
        """
        errors: list[ObjectNotFoundError] = []
        found: set[int] = set()
        for word in words:
            found.update(self._ids_of(word, errors))
        if missing is not None:
            missing.extend(errors)
        elif errors:
            raise errors[0]
        return [obj for obj in self._objects if obj.id in found]

    def _ids_of(self, word: int | str, errors: list[ObjectNotFoundError]) -> list[int]:
        if isinstance(word, int):
            if word not in self._by_id:
                errors.append(no_object(word, self._url))
                return []
            return [word]
        pieces = [piece.strip() for piece in word.split(",")]
        if not all(is_id(piece) for piece in pieces):
            # as a whole first: a name may contain commas
            if found := self._fitting(word):
                return [obj.id for obj in found]
            if len(pieces) == 1:
                errors.append(_nothing_like(word, self._objects, self._url))
                return []
        elif len(pieces) == 1:  # more digits than any id
            errors.append(ObjectNotFoundError(f"no object {word[:40]}... in {self._url}"))
            return []
        return [
            i
            for piece in pieces
            for one in checked_words([piece])
            for i in self._ids_of(one, errors)
        ]

    def _fitting(self, word: str) -> list[Object]:
        found = _named_like(self._objects, word) or having_attribute(self._objects, word)
        if not found and word.startswith(NAME):
            return _named_like(self._objects, word.removeprefix(NAME))
        return found


def checked_words(words: Words, what: str = "objects") -> tuple[int | str, ...]:
    """Words as ids and texts, texts of digits as ids; UsageError naming `what` otherwise."""
    if isinstance(words, (str, bytes, bytearray, memoryview)) or not isinstance(words, Iterable):
        raise UsageError(f"{what} {words!r}: give ids, names and patterns in a list")
    checked: list[int | str] = []
    for word in words:
        try:
            if isinstance(word, bool):
                raise TypeError  # noqa: TRY301 - to Python a bool is an int, but it is no id
            # `index` takes NumPy's integers and refuses floats
            checked.extend(_read(word) if isinstance(word, str) else [index(word)])
        except TypeError:
            raise UsageError(
                f"{what}: {word!r}: give an id, a name or a pattern, as objects() lists them"
            ) from None
    return tuple(checked)


def _read(text: str) -> list[int | str]:
    """Ids of a text of ids alone, such as ``3,4``; otherwise the text."""
    pieces = [piece.strip() for piece in text.split(",")]
    if all(is_id(piece) and len(piece) <= len(str(MOST_IDS)) for piece in pieces):
        return [int(piece) for piece in pieces]
    return [text]


def is_id(piece: str) -> bool:
    """Whether a text is an object id: digits without leading zeros."""
    return piece.isascii() and piece.isdecimal() and (piece[0] != "0" or piece == "0")


def _named_like(objects: Sequence[Object], pattern: str) -> list[Object]:
    """Objects matching a name or pattern, by the rules of `find_objects`, in their order."""
    pattern = composed(pattern.rstrip("/") or pattern)
    branches = [_branches(composed(obj.name), is_path="/" in pattern) for obj in objects]
    # an equal name wins over the pattern: names may contain * or [
    as_it_stands = [obj for obj, some in zip(objects, branches, strict=True) if pattern in some]
    if as_it_stands:
        return as_it_stands
    fits: Callable[[str], object] = re.compile(translate(pattern)).match
    return [obj for obj, some in zip(objects, branches, strict=True) if any(map(fits, some))]


def composed(text: str) -> str:
    """Text in Unicode's normal form C: macOS writes file names with letters and accents apart."""
    return text if text.isascii() else unicodedata.normalize("NFC", text)


def _branches(name: str, *, is_path: bool) -> list[str]:
    """Texts to match with a pattern: a path's elements, or each beginning of the path."""
    elements = name.split("/")
    if not is_path:
        return elements
    return ["/".join(elements[: n + 1]) for n in range(len(elements))]


def _nearest_names(objects: Sequence[Object], word: str) -> str:
    """Hint at up to three names, or elements of their paths, that differ in few letters."""
    branches = (_branches(obj.name, is_path="/" in word) for obj in objects)
    names = {text.casefold(): text for texts in branches for text in texts}
    near = [repr(names[one]) for one in get_close_matches(word.casefold(), names, 3, 0.7)]
    return f"; did you mean {' or '.join(near)}?" if near else ""


def _nothing_like(word: str, objects: Sequence[Object], url: str) -> ObjectNotFoundError:
    """Build the error for a name or pattern without a match."""
    folded = [replace(obj, name=obj.name.casefold()) for obj in objects]
    names = {obj.id: obj.name for obj in objects}
    if alike := _named_like(folded, word.casefold()):
        hint = f", where case counts: there is {names[alike[0].id]!r}"
    elif word.strip("*/ ") and (alike := _named_like(folded, f"*{word.strip('*/ ').casefold()}*")):
        hint = f", but {names[alike[0].id]!r}" + (f" and {len(alike) - 1} more" * (len(alike) > 1))
    else:
        hint = attribute_hint(objects, word) or _nearest_names(objects, word)
    return ObjectNotFoundError(
        f"no object {word[:80]!r} in {url}{hint}; 'hapticdb objects {url}' lists the names"
    )
