"""The paper's Figure 3 on SQLite: a frame's wrench by one statement and the aggregate `force`.

The PointShell is bound as parallel arrays in the order of its points: ordinal and key through
``carray`` (its rowid and its value), point and normal through a pointer, indexed by `force` with
the ordinal. On bricks the key is an address: the brick's key, and nine bits for the voxel in it.
"""

from typing import Any, cast

import apsw
import numpy as np
from numpy.typing import NDArray

from hapticdb.grid import Grid
from hapticdb.kernels import force_law as laws
from hapticdb.kernels.query import refining
from hapticdb.store import parsing
from hapticdb.store.base import Keys, Layout, LocatedShell, row_shift

TEST: dict[Layout, str] = {
    "voxel": "z_val = shell.value",
    "brick": "z_val = shell.value >> 9"
    " AND occupancy IS NOT NULL AND has_voxel(occupancy, shell.value & 511)",
}
"""Condition of the statements on a row."""
WRENCH: dict[Layout, str] = {
    layout: f"""
SELECT force(?1, shell.rowid, shell.value)
  FROM carray(?2) AS shell
 WHERE EXISTS (SELECT 1 FROM {layout} WHERE {test})"""
    for layout, test in TEST.items()
}
HITS: dict[Layout, str] = {
    layout: f"""
SELECT shell.rowid, id
  FROM carray(?1) AS shell CROSS JOIN {layout}
 WHERE {test}"""
    for layout, test in TEST.items()
}


def wrench_statement(layout: Layout, frame: LocatedShell) -> tuple[str, tuple[Any, ...]]:
    """Text and bindings of the wrench's statement."""
    bindings = (apsw.pyobject(frame), apsw.carray(frame.addresses))
    return _without_excluded(WRENCH[layout], layout, bindings, frame)


def hits_statement(layout: Layout, frame: LocatedShell) -> tuple[str, tuple[Any, ...]]:
    """Text and bindings of the statement for ordinal and object id of each hit."""
    return _without_excluded(HITS[layout], layout, (apsw.carray(frame.addresses),), frame)


def register(connection: apsw.Connection, grid: Grid, layout: Layout) -> None:
    """Register the statements' functions on a connection."""

    def force() -> _Force:
        return _Force(grid, layout)

    def has_voxel(occupancy: bytes, voxel: int) -> int:
        try:
            if not occupancy[voxel >> 6] >> (voxel >> 3 & 7) & 1:
                return 0
            # rank by popcount: eight bytes of marks, then only the bytes that are not zero
            before = int.from_bytes(occupancy[:8], "little") & ((1 << (voxel >> 3)) - 1)
            return occupancy[8 + before.bit_count()] >> (voxel & 7) & 1
        except (TypeError, IndexError) as error:
            cause = "a brick of the wrong length"
            raise parsing.damaged(connection.filename, cause) from error

    last: Keys | None = None
    excluded: frozenset[int] = frozenset()

    def is_included(exclude: Keys, object_id: int) -> bool:
        nonlocal last, excluded
        # by identity, since most frames exclude the same array: called for each row
        if exclude is not last:
            last, excluded = exclude, frozenset(exclude.tolist())
        return object_id not in excluded

    connection.create_aggregate_function("force", cast("Any", force), 3)
    connection.create_scalar_function("is_included", cast("Any", is_included), 2)
    connection.create_scalar_function("has_voxel", cast("Any", has_voxel), 2, deterministic=True)


class _Force:
    """The user-defined aggregate ``force(shell, ordinal, key)``.

    It sums at the end, in order of the ordinals: SQLite would drop a bound pointer in a sort.
    """

    def __init__(self, grid: Grid, layout: Layout) -> None:
        self._grid = grid
        self._layout = layout
        self._frame: LocatedShell | None = None
        self._hits: list[tuple[int, int]] = []

    def step(self, frame: LocatedShell, ordinal: int, address: int) -> None:
        """Collect one hit; ordinals count from 1 here, like rowids."""
        self._frame = frame
        self._hits.append((ordinal - 1, address))

    def final(self) -> bytes:
        """Wrench of all hits: six doubles."""
        if self._frame is None:
            return bytes(48)
        # in the shell's order: float sums round alike for every plan of the engine
        hits = np.array(sorted(self._hits), dtype=np.int64)
        wrench: NDArray[np.float64] = refining.wrench_of_addresses(
            self._frame.placed,
            hits[:, 0].copy(),
            hits[:, 1].copy(),
            self._grid.for_kernels(row_shift(self._layout)),
            laws.TangentPlaneLaw(self._frame.stiffness),
            np.empty(len(hits)),
        )
        return wrench.tobytes()


def _without_excluded(
    sql: str, layout: Layout, bindings: tuple[Any, ...], frame: LocatedShell
) -> tuple[str, tuple[Any, ...]]:
    """Statement without excluded objects, by one more condition on the row's id.

    A set in Python: SQLite's index of thousands of ids takes longer than the frame.
    """
    if not frame.exclude.size:
        return sql, bindings
    test = TEST[layout]
    included = f"{test} AND is_included(?{len(bindings) + 1}, id)"
    # at the row's own condition, which is inside EXISTS in one of the statements
    return sql.replace(test, included), (*bindings, apsw.pyobject(frame.exclude))
