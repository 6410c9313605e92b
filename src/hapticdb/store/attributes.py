"""What objects say: the words ``attribute=value``; a scene's box, and which axis points up."""

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
MOST_TOLD = 5
"""Most values or names of attributes that an error lists. Larger: longer lines."""


def scene_bounds(objects: Iterable[Object]) -> NDArray[np.float64] | None:
    """Lower and upper corner (2, 3) of all objects, metres, world frame; None without any."""
    boxes = np.array([obj.bounds for obj in objects])
    return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)]) if len(boxes) else None


def up_axis(objects: Iterable[Object]) -> int:
    """Axis that points up in a scene, 0 to 2: that of most voxels; z for files that name none."""
    votes = np.zeros(3)
    for obj in objects:
        said = obj.attributes.get("up")
        votes["xyz".find(said) if isinstance(said, str) and said in AXES else 2] += obj.voxels
    return 2 - int(np.argmax(votes[::-1]))


def having_attribute(objects: Sequence[Object], word: str) -> list[Object]:
    """Objects that ``attribute=value`` chooses, in their order; none if the word has no ``=``.

    The attribute ends at the first ``=``; ``outer.inner`` enters an object of JSON, unless it is a
    whole name. The value is compared with the attribute's text, then as a pattern of `fnmatch`. A
    number equals every way to write it; true, false and null are written so; of a list any element
    may fit; anything else is compared as JSON without spaces.
    """
    attribute, equals, wanted = word.partition("=")
    if not equals or not attribute:
        return []
    fits = _test_of(wanted)
    return [obj for obj in objects if any(map(fits, _values_of(obj, attribute)))]


def attribute_hint(objects: Sequence[Object], word: str) -> str:
    """What there is instead of ``attribute=value``, for an error; empty without a ``=``."""
    attribute, equals, _ = word.partition("=")
    if not equals or not attribute:
        return ""
    values = sorted({_text_of(v) for obj in objects for v in _values_of(obj, attribute)})
    if values:
        return f"; {attribute} is {_some(values)}"
    names = sorted({name for obj in objects for name in obj.attributes})
    return f"; attributes are {_some(names)}" if names else "; no object has attributes"


def _some(texts: Sequence[str]) -> str:
    shown = ", ".join(repr(text[:40]) for text in texts[:MOST_TOLD])
    more = len(texts) - MOST_TOLD
    return f"{shown} and {more} more" if more > 0 else shown


def _values_of(obj: Object, attribute: str) -> Iterator[object]:
    """Values of an object's attribute: each element of a list, and nothing where it has none."""
    value: object = obj.attributes
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
    """Text that stands for a value of JSON."""
    if isinstance(value, str):
        return value
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False, default=str)


def _test_of(wanted: str) -> Callable[[object], bool]:
    """Build the test of one value."""
    pattern = re.compile(translate(wanted))
    number = _number_of(wanted)

    def fits(value: object) -> bool:
        if isinstance(value, (int, float)) and not isinstance(value, bool) and number is not None:
            return value == number
        text = _text_of(value)
        return text == wanted or pattern.match(text) is not None

    return fits


def _number_of(text: str) -> float | None:
    """The number that a text writes, as JSON would; None if it writes none."""
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        return None
    if type(value) not in {int, float} or not math.isfinite(value):
        return None
    return cast("float", value)
