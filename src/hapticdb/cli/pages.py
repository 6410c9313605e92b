"""Which objects a listing shows: by name and place, in which order, a page at a time."""

import re
import sys
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from hapticdb.errors import UsageError

if TYPE_CHECKING:
    from hapticdb.store.base import Object, Store

Order = Literal["id", "name", "voxels", "size"]
Corners = tuple[float, float, float, float, float, float]
PAGE = 40
"""Objects on a page of a terminal, unless asked otherwise."""


class ListingPage(NamedTuple):
    """A part of a listing.

    objects : what the page shows; first : number of the first of them, counted from 1;
    total : how many objects the listing has.
    """

    objects: "Sequence[Object]"
    first: int
    total: int


def selected(
    store: "Store", names: Sequence[str] | None, box: Corners | None, order: Order, *, reverse: bool
) -> "list[Object]":
    """Objects that any of the names chooses and whose bounds meet the box, in that order.

    The box is closed: lower corner, upper corner, metres, world frame.
    """
    from hapticdb.store.finding import find_objects

    if box is not None and not all(a <= b for a, b in zip(box[:3], box[3:], strict=True)):
        corners = " ".join(f"{x:.6g}" for x in box)
        raise UsageError(f"--box {corners}: give X0 Y0 Z0 X1 Y1 Z1, the lower corner first, metres")
    objects = find_objects(store, names) if names else store.objects()
    if box is not None:
        objects = [obj for obj in objects if _meets(obj, box)]
    key, is_descending = ORDERS[order]
    return sorted(objects, key=key, reverse=is_descending != reverse)


def _meets(obj: "Object", box: Corners) -> bool:
    low, high = obj.bounds.tolist()
    return all(low[k] <= box[k + 3] and box[k] <= high[k] for k in range(3))


def _in_order_of_names(obj: "Object") -> tuple[list[tuple[int, str]], int]:
    """Key by which bolt_2 comes before bolt_10."""
    words = re.split(r"(\d+)", obj.name, flags=re.ASCII)
    return [
        (len(word.lstrip("0")), word) if word.isdigit() else (0, word) for word in words
    ], obj.id


def _longest_side(obj: "Object") -> float:
    """Longest side of an object's bounding box, metres."""
    return float((obj.bounds[1] - obj.bounds[0]).max())


ORDERS: dict[Order, tuple[Callable[["Object"], Any], bool]] = {
    "id": (lambda obj: obj.id, False),
    "name": (_in_order_of_names, False),
    "voxels": (lambda obj: (obj.voxels, -obj.id), True),
    "size": (lambda obj: (_longest_side(obj), -obj.id), True),
}
"""Key of each order, and whether the largest comes first."""


def page_of(objects: "Sequence[Object]", limit: int | None, page: int | None) -> ListingPage:
    """One page of a listing; all objects if no page is asked for and no terminal shows them."""
    if limit is not None and limit < 0:
        raise UsageError(f"--limit {limit}: give 1 or more, or 0 for all")
    if page is not None and page < 1:
        raise UsageError(f"--page {page}: pages count from 1")
    if limit == 0 and page is not None:
        raise UsageError("--limit 0 shows all on one page: leave --page out")
    if limit is None:
        is_whole = page is None and not sys.stdout.isatty()
        limit = 0 if is_whole else PAGE
    if limit == 0:
        return ListingPage(objects, 1, len(objects))
    first = limit * ((page or 1) - 1)
    if first >= len(objects) and first:
        last = -(-len(objects) // limit)
        raise UsageError(f"--page {page}: the last page of {len(objects):,} objects is {last}")
    return ListingPage(objects[first : first + limit], first + 1, len(objects))
