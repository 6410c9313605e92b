"""Statistics of an environment on several servers: those of the shards together."""

import contextlib

import numpy as np

from hapticdb.errors import BusyError, ConnectionLostError, ShardAwayError
from hapticdb.store import believed
from hapticdb.store.base import Histogram, Keys, Layout, Size
from hapticdb.store.postgres.connecting import wire
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.shards import statements
from hapticdb.store.postgres.shards.connecting.links import ShardQuery, Shards
from hapticdb.store.postgres.shards.reading import ShardedReader
from hapticdb.store.postgres.shards.sweeping import Sweeper
from hapticdb.store.postgres.shards.view import LiveView
from hapticdb.store.postgres.tables.histogram import (
    ENOUGH_ROWS,
    EXACT,
    SERVER_RESOLUTION,
    server_histogram,
)
from hapticdb.store.postgres.tables.reading import PostgresReader
from hapticdb.store.postgres.tables.statistics import PostgresStatistics, bytes_of
from hapticdb.store.sharding import Shard

COUNT_ALL = {
    table: f"""
SELECT array_agg(id), array_agg(version), array_agg(n), {statements.MARK}
  FROM (SELECT id, version, count(*) AS n
          FROM {table}
         WHERE z_val BETWEEN $1 AND $2
         GROUP BY id, version) AS counted"""
    for table in statements.TABLES
}
EXACT_ON_SHARD = {
    layout: f"""{text.replace(f"FROM {layout}", "").rstrip()}, {statements.MARK}
  FROM {layout} JOIN unnest($3, $4) AS live(id, version) USING (id, version)
 WHERE z_val BETWEEN $5 AND $6"""
    for layout, text in EXACT.items()
}
LAST = np.iinfo(np.int64).max

PUBLISHED = "SELECT writes FROM shard WHERE number = %s"
LOOK = """
SELECT greatest(reltuples, 0)::bigint, writes
  FROM pg_class, mark WHERE pg_class.oid = %s::regclass"""


class ShardedStatistics(PostgresStatistics):
    """Sizes and statistics of the rows on all shards; kept figures are the coordinator's."""

    def __init__(
        self,
        connection: ServerConnection,
        layout: Layout,
        objects: PostgresReader,
        reader: ShardedReader,
        shards: Shards,
        sweeper: Sweeper,
    ) -> None:
        super().__init__(connection, layout, objects)
        self._rows = reader
        self._shards = shards
        self._sweeper = sweeper
        self._counted_table = ""  # no server counts the changes on all of them

    def size(self) -> Size:
        """Live rows of all shards, bytes of all servers, leaf blocks of the shards' indexes."""
        with self._shards.unlimited(), self._rows.snapshot(), self._connection.without_limit():
            rows = int(self._counts(self._layout).sum())
            band = int(self._counts("band").sum()) if self._layout == "brick" else 0
            total, _ = bytes_of(self._connection, self._layout)
        sizes = self._shards.each(lambda _, shard: bytes_of(shard, self._layout))
        of_band = "SELECT pg_total_relation_size('band')"
        band_bytes = 0
        if self._layout == "brick":
            found = self._shards.each(lambda _, shard: shard.rows(of_band))
            band_bytes = sum(int(one[0][0]) for one in found)
        total += sum(size for size, _ in sizes)
        return Size(rows, total, max(sum(pages for _, pages in sizes), 1), band, band_bytes)

    def shards(self) -> list[Shard]:
        """All shards in the order of their keys; those that are away, too."""
        return [self._shard(at) for at in range(len(self._shards))]

    def _shard(self, at: int) -> Shard:
        name, number = self._shards.name(at), self._shards.places[at].number
        ((known,),) = self._connection.rows(PUBLISHED, (number,))
        try:
            (found,) = self._shards.each(lambda _, shard: self._looked_at(shard), [at])
        except ConnectionLostError as error:
            return Shard(name, None, None, str(error))
        rows, writes, n_bytes, is_standby = found
        return Shard(name, rows, n_bytes, behind=max(known - writes, 0) if is_standby else None)

    def _looked_at(self, shard: ServerConnection) -> tuple[int, int, int, bool]:
        """Rows, writes and bytes of a shard, and whether a standby has answered."""
        ((rows, writes),) = shard.rows(LOOK, (self._layout,))
        return int(rows), int(writes), bytes_of(shard, self._layout)[0], shard.is_standby

    def quantiles(self, resolution: int) -> Histogram:
        """Histogram as on one server; an older one that is kept while a shard is away.

        The shards' own statistics are kept at the coordinator, so that a reader need not ask all
        shards; like any server's, they may be some writes old.
        """
        kept = self._kept(resolution)
        if kept and resolution == SERVER_RESOLUTION and kept.n_rows >= ENOUGH_ROWS:
            return Histogram(kept.bounds, kept.n_rows, "server statistics")
        try:
            return super().quantiles(resolution)
        except ShardAwayError:
            if kept is None:
                raise
            return kept

    def _kept(self, resolution: int) -> Histogram | None:
        """Histogram that is kept at the coordinator, of whatever revision."""
        kept = self._connection.rows(
            "SELECT bounds, n_rows FROM quantile WHERE resolution = %s AND bounds IS NOT NULL",
            (resolution,),
        )
        return believed.histogram_of(self._connection.shown, *kept[0]) if kept else None

    def analyze(self, resolution: int, *, anew: bool = False) -> None:
        """Renew the statistics, and delete rows on the shards that nobody needs any more."""
        with contextlib.suppress(BusyError):  # somebody is writing: the next one sweeps
            self._sweeper.sweep()
        super().analyze(resolution, anew=anew)
        found = self._server_histogram() if resolution == SERVER_RESOLUTION else None
        if found is not None and found[1] >= ENOUGH_ROWS:  # for the time when a shard is away
            self._save(
                "UPDATE quantile SET bounds = %s WHERE resolution = %s AND bounds IS NULL",
                (found[0].tolist(), resolution),
            )

    def rows_of_shards(self) -> Keys:
        """Live rows of the index table on each shard (S,), counted."""
        with self._shards.unlimited(), self._rows.snapshot(), self._connection.without_limit():
            return self._counts(self._layout)

    def exact_histogram(self, resolution: int) -> tuple[Keys, int]:
        """Equi-count bounds (R + 1,) of the keys of all live rows, and their number; computed."""
        return self._exact_histogram(resolution)

    def refresh(self) -> None:
        """Renew the statistics of all shards' servers."""
        self._refresh()

    def _counts(self, table: str) -> Keys:
        """Live rows of each shard (S,)."""

        def plan(view: LiveView) -> list[ShardQuery]:
            text = COUNT_ALL[table]  # type: ignore[index]
            return [ShardQuery(shard, text, ends) for shard, ends in enumerate(_own_ranges(view))]

        view, answers = self._rows.ask(plan)
        counts = np.zeros(len(answers), np.int64)
        for shard, answer in enumerate(answers):
            ids, versions, found = (wire.read_int8s(value) for value in answer[:3])
            counts[shard] = found[view.are_live(ids, versions)].sum()
        return counts

    def _server_histogram(self) -> tuple[Keys, int] | None:
        """Bounds (10,001,) of all rows by the shards' own statistics; shards are ordered by key."""
        found = self._shards.each(lambda _, shard: server_histogram(shard, self._layout))
        known = [one for one in found if one is not None]
        if not known:
            return None
        return joined_histograms([one[0] for one in known], [one[1] for one in known])

    def _exact_histogram(self, resolution: int) -> tuple[Keys, int]:
        """Bounds (R + 1,) by Definition 2 of the paper, over the live rows of all shards."""
        with self._shards.unlimited(), self._rows.snapshot(), self._connection.without_limit():
            counts = self._counts(self._layout)
            n_rows = int(counts.sum())
            if not n_rows:
                return np.zeros(2, dtype=np.int64), 0
            ranks = -(-np.arange(resolution + 1, dtype=np.int64) * n_rows // resolution)
            ranks = np.maximum(ranks, 1)
            before = np.cumsum(counts) - counts

            def plan(view: LiveView) -> list[ShardQuery]:
                ranges = _own_ranges(view)
                live = wire.int8s(view.ids), wire.int8s(view.versions)
                return [
                    ShardQuery(
                        shard,
                        EXACT_ON_SHARD[self._layout],
                        (
                            wire.int8s(some - before[shard]),
                            wire.float8(float(counts[shard])),
                            *live,
                            *ranges[shard],
                        ),
                    )
                    for shard, some in enumerate(_ranks_of(ranks, before, counts))
                    if len(some)
                ]

            _, answers = self._rows.ask(plan)
        return np.concatenate([wire.read_int8s(answer[0]) for answer in answers]), n_rows

    def _refresh(self) -> None:
        def refresh(_: int, shard: ServerConnection) -> None:
            with shard.without_limit("statement_timeout", "lock_timeout"):
                shard.execute("SELECT refresh_statistics()")

        self._shards.each(refresh)


def _own_ranges(view: LiveView) -> list[tuple[wire.Parameter, wire.Parameter]]:
    """Lowest and highest row key that each shard holds."""
    ends = np.append(view.firsts[1:], LAST).tolist()
    return [
        (wire.int8(first), wire.int8(end - 1))
        for first, end in zip(view.firsts.tolist(), ends, strict=True)
    ]


def _ranks_of(ranks: Keys, before: Keys, counts: Keys) -> list[Keys]:
    """Ranks, from 1, among all rows that fall on each shard."""
    pairs = zip(before.tolist(), (before + counts).tolist(), strict=True)
    return [ranks[(ranks > low) & (ranks <= high)] for low, high in pairs]


def joined_histograms(bounds: list[Keys], rows: list[int]) -> tuple[Keys, int]:
    """Equi-count bounds (R + 1,) of shards together, and their rows.

    bounds : those of each shard (R + 1,), shards in the order of their keys; rows : of each shard.
    A bound of the result is a bound of a shard: its share of the rows is wrong by less than 1 / R
    of that shard's rows.
    """
    n_rows = sum(rows)
    ends = np.cumsum(rows)
    ranks = np.arange(SERVER_RESOLUTION + 1) * n_rows / SERVER_RESOLUTION
    of_shard = np.minimum(np.searchsorted(ends, ranks, "left"), len(rows) - 1)
    shares = (ranks - (ends - rows)[of_shard]) / np.array(rows)[of_shard]
    places = np.round(shares * SERVER_RESOLUTION).astype(np.int64)
    found = np.array([bounds[s][at] for s, at in zip(of_shard, places, strict=True)])
    return np.sort(found), n_rows  # statistics can be older than the borders
