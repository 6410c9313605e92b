"""Attributes of objects: selection by ``attribute=value``, a scene's AABB and up axis."""

import json
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from fnmatch import translate
from typing import cast

import numpy as np
from numpy.typing import NDArray

from hapticdb.store.base import Object

AXES = ("x", "y", "z")
MOST_NAMES = 5
"""Values or names of attributes in an error, at most."""


def scene_bounds(objects: Iterable[Object]) -> NDArray[np.float64] | None:
    """AABB (2, 3) of all objects, lower and upper corner, metres, world frame; None without any."""
    boxes = np.array([obj.bounds for obj in objects])
    return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)]) if len(boxes) else None


def up_axis(objects: Iterable[Object]) -> int:
    """Up axis of a scene, 0 to 2: the one of most voxels; z for files without an up axis."""
    votes = np.zeros(3)
    for obj in objects:
        said = obj.attributes.get("up")
        votes["xyz".find(said) if isinstance(said, str) and said in AXES else 2] += obj.voxels
    # reversed: argmax takes the first of equal counts, and a tie is for z
    return 2 - int(np.argmax(votes[::-1]))


def having_attribute(objects: Sequence[Object], word: str) -> list[Object]:
    """Objects selected by ``attribute=value``, in their order; none if the word has no ``=``.

    The attribute ends at the first ``=``; ``outer.inner`` enters a JSON object, unless it is a
    whole name. The value is compared with the attribute's text, then as a pattern of `fnmatch`.
    Numbers compare by value; true, false and null by these words; of a list any element may match;
    anything else is compared as JSON without spaces.
    """
    attribute, equals, wanted = word.partition("=")
    if not equals or not attribute:
        return []
    fits = _test_of(wanted)
    return [obj for obj in objects if any(map(fits, _values_of(obj, attribute)))]


def attribute_hint(objects: Sequence[Object], word: str) -> str:
    """Hint at existing values or names for an error; empty for a word without a ``=``."""
    attribute, equals, _ = word.partition("=")
    if not equals or not attribute:
        return ""
    values = sorted({_text_of(v) for obj in objects for v in _values_of(obj, attribute)})
    if values:
        return f"; {attribute} is {_some(values)}"
    names = sorted({name for obj in objects for name in obj.attributes})
    return f"; attributes are {_some(names)}" if names else "; no object has attributes"


def _some(texts: Sequence[str]) -> str:
    shown = ", ".join(repr(text[:40]) for text in texts[:MOST_NAMES])
    more = len(texts) - MOST_NAMES
    return f"{shown} and {more} more" if more > 0 else shown


def _values_of(obj: Object, attribute: str) -> Iterator[object]:
    """Values of an object's attribute: the elements of a list, too; none without the attribute."""
    value: object = obj.attributes
    # the whole name first: it may contain dots
    if attribute in obj.attributes:
        value = obj.attributes[attribute]
    else:
        for name in attribute.split("."):
            if not isinstance(value, Mapping) or name not in value:
                return
            value = value[name]
    if isinstance(value, (list, tuple)):
        yield from value
    yield value


def _text_of(value: object) -> str:
    """Text of a JSON value."""
    if isinstance(value, str):
        return value
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False, default=str)


def _test_of(wanted: str) -> Callable[[object], bool]:
    """Predicate of one value."""
    pattern = re.compile(translate(wanted))
    number = _number_of(wanted)

    def fits(value: object) -> bool:
        # True equals 1 in Python, but not in JSON
        if isinstance(value, (int, float)) and not isinstance(value, bool) and number is not None:
            return value == number
        text = _text_of(value)
        return text == wanted or pattern.match(text) is not None

    return fits


def _number_of(text: str) -> float | None:
    """Number written as JSON in a text; None for anything else."""
    try:
        # JSON's grammar, not Python's, where 1_000 is a number, too
        value = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if type(value) not in {int, float} or not math.isfinite(value):
        return None
    return cast("float", value)
