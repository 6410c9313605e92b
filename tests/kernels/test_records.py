"""Layouts of records: which process writes which field, and in which cache line."""

import numpy as np
import pytest

from hapticdb.kernels.records import LINE, SESSION

WRITERS = {
    "the loop, now and then": ("sequence", "told", "n_missed", "missed", "n_asked", "asked"),
    "the loop, in every frame": ("n_frames",),
    "the fetching process": ("heard", "n_missing", "n_objects", "objects"),
    "the process that began the session": ("is_asked_to_end",),
}


def lines_of(names: tuple[str, ...]) -> set[int]:
    """Cache lines of a session's row that hold those fields."""
    assert SESSION.fields is not None
    lines: set[int] = set()
    for name in names:
        dtype, start = SESSION.fields[name][:2]
        lines.update(range(start // LINE, (start + dtype.itemsize - 1) // LINE + 1))
    return lines


def test_every_field_of_a_session_has_one_writer() -> None:
    assert sorted(SESSION.names or ()) == sorted(name for own in WRITERS.values() for name in own)


@pytest.mark.parametrize("writer", WRITERS)
def test_no_two_writers_of_a_session_share_a_cache_line(writer: str) -> None:
    own = lines_of(WRITERS[writer])
    for other, names in WRITERS.items():
        assert other == writer or not own & lines_of(names)


def test_rows_of_sessions_share_no_cache_line() -> None:
    assert SESSION.itemsize % LINE == 0
    assert np.zeros(2, SESSION).strides == (SESSION.itemsize,)
