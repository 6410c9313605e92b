"""Exact quantiles of the index by one scan inside SQLite.

The paper takes quantiles from the engine's statistics. SQLite's own (``sqlite_stat4``) hold only 24
samples, so hapticdb computes the quantiles and keeps them.
"""

import numpy as np

from hapticdb.store import believed
from hapticdb.store.base import Keys, Layout
from hapticdb.store.sqlite.connection import FileConnection


def exact_quantiles(
    connection: FileConnection, layout: Layout, resolution: int
) -> tuple[Keys, int]:
    """Bounds (v + 1,) of the v-quantile vector (the paper's Definition 2), and the rows N.

    Bound i is the key of the row of rank j = ceil(i N / v), i = 1 .. v; bound 0 is the lowest key.
    Each step skips, inside the engine, from the row of one rank to the row of the next, in the
    order of (z_val, id). Rows with the same key count one by one.
    """

    def row_of(sql: str, *bindings: int) -> tuple[int, int]:
        found = connection.fetch(sql, bindings)
        if not found:
            raise believed.damaged(connection.url, "fewer rows than are counted")
        key, object_id = found[0]
        return key, object_id

    ((n_rows,),) = connection.fetch(f"SELECT count(*) FROM {layout}")
    if n_rows == 0:
        return np.zeros(2, dtype=np.int64), 0
    key, object_id = row_of(f"SELECT z_val, id FROM {layout} ORDER BY z_val, id LIMIT 1")
    step = (
        f"SELECT z_val, id FROM {layout} WHERE (z_val, id) >= (?1, ?2)"
        " ORDER BY z_val, id LIMIT 1 OFFSET ?3"
    )
    bounds = [key]
    rank = 1
    for i in range(1, resolution + 1):
        target = max(1, -(-i * n_rows // resolution))
        if target > rank:
            key, object_id = row_of(step, key, object_id, target - rank)
            rank = target
        bounds.append(key)
    return np.array(bounds, dtype=np.int64), n_rows
