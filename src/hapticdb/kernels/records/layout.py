"""Layouts of records, and views of their fields."""

from collections import namedtuple
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Layout = np.dtype[np.void]

LINE = 64
"""Bytes of a cache line: writers of the same line slow each other down (false sharing)."""


def record(fields: Sequence[tuple[object, ...]]) -> Layout:
    """Aligned layout of those fields; records have them as attributes in plain Python, too."""
    return np.dtype((np.record, np.dtype(list(fields), align=True)))


def record_in_lines(groups: Sequence[Sequence[tuple[object, ...]]], size: int = 0) -> Layout:
    """Layout of groups of fields, each from a new cache line on; of `size` bytes at least."""
    names, formats, offsets = [], [], []
    start = 0
    for group in groups:
        part = record(group)
        assert part.names is not None  # noqa: S101 - it was made of names
        for name in part.names:
            names.append(name)
            formats.append(part[name])
            offsets.append(start + part.fields[name][1])  # type: ignore[index]
        start += -(-part.itemsize // LINE) * LINE
    layout = {"names": names, "formats": formats, "offsets": offsets, "itemsize": max(size, start)}
    return np.dtype((np.record, np.dtype(layout, align=True)))  # type: ignore[call-overload]


def views_of(record: NDArray[np.void]) -> Any:  # noqa: ANN401 - its fields are the layout's
    """Views of the fields of a record () by name, nested for nested records.

    A number is a view (): ``views.hits.item()`` reads it, ``views.hits[()] = 1`` writes it.
    """
    names = record.dtype.names or ()
    views = [record[name] for name in names]
    kind = namedtuple("Views", names)  # type: ignore[misc]  # noqa: PYI024 - fields of a layout
    return kind(*(views_of(view) if view.dtype.names else view for view in views))


def pose_numbers(record: NDArray[np.void]) -> NDArray[np.float64]:
    """View (7,) of position and unit quaternion of a record ()."""
    fields = record.dtype.fields
    assert fields is not None  # noqa: S101 - it is a record
    start = fields["position"][1]
    assert fields["quaternion"][1] == start + 24  # noqa: S101 - side by side in every layout
    return np.ndarray((7,), np.float64, record, start)
