"""Counts of shards that were away, on the desk of a table."""

from collections.abc import Iterator

import pytest

from hapticdb.kernels.records import MOST_SHARDS_AWAY, SHARD_NAME_BYTES
from hapticdb.resident.outages import OutageCounter, ShardOutage, outages_of
from hapticdb.resident.table import LEAST_BUDGET, CellTable

ONE, TWO = "shard 1 (a)", "shard 2 (b)"


@pytest.fixture
def table() -> Iterator[CellTable]:
    with CellTable.create(LEAST_BUDGET) as made:
        yield made


def test_each_shard_has_its_seconds_and_times(table: CellTable) -> None:
    counter = OutageCounter(table)
    assert not counter.count((), 9.0)
    assert outages_of(table) == ()
    assert counter.count((TWO,), 9.0)  # these seconds were before
    assert outages_of(table) == (ShardOutage(TWO, 0.0, 1, is_away=True),)
    assert not counter.count((TWO,), 0.5)
    assert counter.count((ONE, TWO), 0.25)
    assert counter.count((ONE,), 2.0)
    assert counter.count((), 1.0)
    assert not counter.count((), 64.0)
    assert outages_of(table) == (
        ShardOutage(TWO, 2.75, 1, is_away=False),
        ShardOutage(ONE, 3.0, 1, is_away=False),
    )
    counter.count((TWO,), 1.0)
    counter.count((), 1.0)
    assert outages_of(table)[0] == ShardOutage(TWO, 3.75, 2, is_away=False)


def test_the_next_process_continues_the_counts(table: CellTable) -> None:
    before = OutageCounter(table)
    before.count((TWO,), 0.0)
    before.count((TWO,), 1.5)
    after = OutageCounter(table)
    assert outages_of(table) == (ShardOutage(TWO, 1.5, 1, is_away=False),)
    after.count((TWO,), 7.0)
    after.count((), 0.5)
    assert outages_of(table) == (ShardOutage(TWO, 2.0, 2, is_away=False),)


def test_no_shard_counts_as_away_while_the_connection_is_lost(table: CellTable) -> None:
    counter = OutageCounter(table)
    counter.count((TWO,), 0.0)
    counter.stop()
    assert outages_of(table) == (ShardOutage(TWO, 0.0, 1, is_away=False),)
    counter.count((), 50.0)
    assert outages_of(table)[0].seconds == 0.0


def test_more_shards_than_rows_and_long_names_do_no_harm(table: CellTable) -> None:
    counter = OutageCounter(table)
    names = tuple(f"shard {n} ({'ü' * SHARD_NAME_BYTES})" for n in range(MOST_SHARDS_AWAY + 5))
    for _ in range(2):
        counter.count(names, 1.0)
    counter.count((), 1.0)
    told = outages_of(table)
    assert [one.name.split()[1] for one in told] == [str(n) for n in range(MOST_SHARDS_AWAY)]
    assert all(one.seconds == 2.0 and one.times == 1 for one in told)
    assert all(len(one.name.encode()) <= SHARD_NAME_BYTES for one in told)
