"""Filters: the objects of a query, selected by `where` and `exclude`."""

from collections.abc import Iterable, Sequence
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np

from hapticdb.errors import ObjectNotFoundError
from hapticdb.store.base import Keys, Object
from hapticdb.store.finding import MOST_IDS, Listing, Words, checked_words

Key = TypeVar("Key")
Value = TypeVar("Value")
MOST_CACHED = 16
"""Filters in a cache, at most."""


class ExcludedObjects(NamedTuple):
    """Objects of one revision excluded from a query.

    ids (E,) int64, ascending and distinct; missing : errors of the words without a match.
    """

    ids: Keys
    missing: tuple[ObjectNotFoundError, ...]


class Filter:
    """Selection of objects: those of `where`, or all without it, less those of `exclude`.

    A filter stores words and no objects, and so applies to later objects, names and attributes.

    where, exclude : words of `hapticdb.store.finding.find_objects`, texts of digits as ids;
    is_empty : all objects are selected; is_fixed : excludes by ids alone.

    Raises `UsageError` for a word other than an int or a text.
    """

    def __init__(self, where: Words = (), exclude: Words = ()) -> None:
        self.where = checked_words(where, "where")
        self.exclude = checked_words(exclude, "exclude")
        self.is_empty = not self.where and not self.exclude
        self.is_fixed = not self.where and all(isinstance(word, int) for word in self.exclude)

    def __eq__(self, other: object) -> bool:
        return self is other or (
            isinstance(other, Filter)
            and self.where == other.where
            and set(self.exclude) == set(other.exclude)
        )

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash((self.where, frozenset(self.exclude)))

    @cached_property
    def fixed_ids(self) -> Keys:
        """Excluded ids (E,) of a filter with `is_fixed`, ascending and distinct."""
        ids = {i for i in self.exclude if isinstance(i, int) and 0 < i < MOST_IDS}
        return np.array(sorted(ids), dtype=np.int64)

    def excluded(self, objects: Sequence[Object], url: str) -> ExcludedObjects:
        """Objects excluded from `objects`, all of one revision by id, and words without a match."""
        missing: list[ObjectNotFoundError] = []
        listing = Listing(objects, url)
        out = {obj.id for obj in _chosen(listing, "exclude", self.exclude, missing)}
        if self.where:
            selected = {obj.id for obj in _chosen(listing, "where", self.where, missing)}
            # the others become exclusions: statements and frames know only these
            out.update(obj.id for obj in objects if obj.id not in selected)
        return ExcludedObjects(np.array(sorted(out), dtype=np.int64), tuple(missing))

    def select(self, objects: Sequence[Object], url: str) -> list[Object]:
        """Selected objects, as `excluded`; ObjectNotFoundError for a word without a match."""
        excluded = self.excluded(objects, url)
        for error in excluded.missing:
            raise error
        ids = set(excluded.ids.tolist())
        return [obj for obj in objects if obj.id not in ids]


def _chosen(
    listing: Listing,
    option: str,
    words: Iterable[int | str],
    missing: list[ObjectNotFoundError],
) -> list[Object]:
    """Objects selected by words; the errors name the option."""
    errors: list[ObjectNotFoundError] = []
    found = listing.chosen(words, errors)
    missing.extend(ObjectNotFoundError(f"{option}: {error}") for error in errors)
    return found


NOTHING: Words = ()
"""No words."""
ALL = Filter()
"""The filter of all objects."""


class FiltersOfWords:
    """Cache of filters by their words: thousands of ids take 0.1 ms when repeated."""

    def __init__(self) -> None:
        self._filters: dict[tuple[tuple[object, ...], tuple[object, ...]], Filter] = {}

    def of(self, where: Words, exclude: Words) -> Filter:
        """The filter of these words, cached; UsageError as for `Filter`."""
        # an iterator can be read once: no key for the cache
        if not isinstance(where, (tuple, list)) or not isinstance(exclude, (tuple, list)):
            return Filter(where, exclude)
        if not where and not exclude:
            return ALL
        words = (tuple(where), tuple(exclude))
        if not {*map(type, words[0]), *map(type, words[1])} <= {int, str}:  # 1 equals True
            return Filter(*words)
        found = self._filters.get(words)
        if found is None:
            found = Filter(*words)
            cache_last(self._filters, words, found)
        return found


def cache_last(kept: dict[Key, Value], key: Key, value: Value) -> None:
    """Store a value under a new key; the oldest of more than `MOST_CACHED` is dropped."""
    kept[key] = value
    if len(kept) > MOST_CACHED:
        del kept[next(iter(kept))]
