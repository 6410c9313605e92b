"""Quantiles of the index: from the server's own statistics, or computed exactly."""

import numpy as np
from numpy.typing import NDArray

from hapticdb.store.base import LAYOUTS, Keys, Layout
from hapticdb.store.postgres.connecting import wire
from hapticdb.store.postgres.connecting.connection import ServerConnection

SERVER_RESOLUTION = 10_000
"""Buckets of the server's histogram: the most that it keeps, and the paper's best resolution."""
ENOUGH_ROWS = 10 * SERVER_RESOLUTION
"""Rows from which the server's statistics are used. With fewer, an exact histogram is quick."""

# returns one row, which holds NULLs before the first ANALYZE
STATISTICS = """
SELECT histogram_bounds::text::bigint[], most_common_vals::text::bigint[],
       most_common_freqs::float8[],
       (SELECT reltuples::bigint FROM pg_class
         WHERE oid = to_regclass(quote_ident(schemaname) || '.' || quote_ident(tablename)))
  FROM (SELECT) AS one LEFT JOIN pg_stats
    ON schemaname = $1::text::name AND tablename = $2::text::name AND attname = 'z_val'"""
# (r - 0.5) / N, because r / N may be rounded to the neighbour of rank r
EXACT = {
    layout: f"""
SELECT percentile_disc((SELECT array_agg((r - 0.5) / $2 ORDER BY n)
                          FROM unnest($1) WITH ORDINALITY AS rank(r, n)))
         WITHIN GROUP (ORDER BY z_val)
  FROM {layout}"""
    for layout in LAYOUTS
}


def server_histogram(connection: ServerConnection, layout: Layout) -> tuple[Keys, int] | None:
    """Bounds (10,001,) from `pg_stats` and the rows behind them; None before the first ANALYZE."""
    bounds, common, frequencies, n_rows = connection.fetch(
        STATISTICS,
        wire.text(connection.address.environment),
        wire.text(layout),
    )
    rows = wire.read_int8(n_rows) if n_rows is not None else 0
    if rows <= 0:
        return None
    shares = wire.read_float8s(frequencies) if frequencies else np.empty(0)
    return (
        with_common_values(
            wire.read_int8s(bounds), wire.read_int8s(common), shares, SERVER_RESOLUTION
        ),
        rows,
    )


def with_common_values(
    bounds: Keys, common: Keys, shares: NDArray[np.float64], resolution: int
) -> Keys:
    """Equi-count bounds (R + 1,) of all rows, from a histogram without the most common keys.

    bounds (B + 1,) : of the rows whose keys are not among the common ones; may be empty; common,
    shares (C,) : most common keys, and the share of all rows that each has; resolution : R.

    The rows of a bucket count at its upper bound, those of a common key at that key. Bound i is the
    least key up to which the share of rows is i / R, right to within a bucket of the histogram.
    """
    keys = np.concatenate([bounds[1:], common])
    if not len(keys):
        return np.zeros(resolution + 1, dtype=np.int64)
    rest = max(1.0 - float(shares.sum()), 0.0)
    in_buckets = np.full(len(bounds[1:]), rest / max(len(bounds) - 1, 1))
    order = np.argsort(keys, kind="stable")
    up_to = np.cumsum(np.concatenate([in_buckets, shares])[order])
    targets = np.arange(resolution + 1) / resolution * up_to[-1]
    found: Keys = keys[order][np.searchsorted(up_to, targets)]
    found[0] = np.append(keys, bounds[:1]).min()
    return found


def exact_histogram(
    connection: ServerConnection, layout: Layout, resolution: int
) -> tuple[Keys, int]:
    """Bounds (R + 1,) by Definition 2 of the paper, over all rows, and their number N.

    Bound i is the key of the row of rank ceil(i N / R), bound 0 the lowest key.
    """
    with connection.snapshot(), connection.without_limit():
        counted = connection.execute(f"SELECT count(*) FROM {layout}").fetchone()
        n_rows = int(counted[0]) if counted else 0
        if n_rows == 0:
            return np.zeros(2, dtype=np.int64), 0
        ranks = -(-np.arange(resolution + 1, dtype=np.int64) * n_rows // resolution)
        (bounds,) = connection.fetch(
            EXACT[layout], wire.int8s(np.maximum(ranks, 1)), wire.float8(float(n_rows))
        )
    return wire.read_int8s(bounds), n_rows
