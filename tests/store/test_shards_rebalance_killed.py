"""A rebalance whose process, or whose coordinator, is killed before any step loses nothing.

The next rebalance goes on from there, and ends with the rows spread evenly.
"""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import multiprocessing
import os
import signal
from collections.abc import Iterator
from contextlib import closing, suppress

import numpy as np
import pytest

from children import exit_code
from hapticdb import ConnectionLostError
from hapticdb.store.base import CELL_SHIFT
from hapticdb.store.postgres.connecting import connection
from hapticdb.store.postgres.shards.borders import carrying, rebalancing
from hapticdb.store.postgres.shards.store import ShardedStore
from rebalanced import Contents, assert_only_own_rows, contents, made
from servers import Place
from sharded import ShardedServers
from steps import MOST_STEPS, Steps, steps  # noqa: F401 - a fixture among them

SOON_S = 0.3
"""Seconds that a rebalance waits for a coordinator that does not come back."""
ALL_ON_THE_FIRST = np.array([0, 64, 64], dtype=np.int64) << CELL_SHIFT
"""Borders with which the first shard has the whole scene."""


@pytest.fixture(autouse=True)
def _few_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two batches or three a border, so that a rebalance has some hundred steps at most."""
    monkeypatch.setattr(carrying, "BATCH_ROWS", {"voxel": 5000, "brick": 400, "band": 1200})
    monkeypatch.setattr(rebalancing, "PAUSE_SECONDS", 0.0)
    monkeypatch.setattr(connection, "RECONNECT_SECONDS", SOON_S)


@pytest.fixture
def url(sharded_place: Place) -> Iterator[str]:
    where = sharded_place()
    with made(where, distances=True):
        yield where


def expected(url: str) -> Contents:
    """All rows, which lie on the first shard afterwards as in the beginning."""
    with closing(ShardedStore.open(url)) as store:
        number = store._rebalancer._begun()
        while store._rebalancer._moved(ALL_ON_THE_FIRST, number) is not None:
            pass
        store._rebalancer._deleted(number)
        return contents(store)


def assert_goes_on(servers: ShardedServers, url: str, before: Contents) -> None:
    """Assert that all rows are there, now and after a rebalance to its end."""
    with closing(ShardedStore.open(url)) as store:
        assert contents(store) == before
        report = store.rebalance()
        assert contents(store) == before
        assert max(report.rows_after) < sum(report.rows_after) / 2
        assert_only_own_rows(servers, store)
        assert not list(store.checker().findings())


# --- its process --------------------------------------------------------------------------------


def rebalance_and_die(url: str, at: int) -> None:
    """Rebalance in a process that ends before step `at`, as kill -9 ends it."""
    with pytest.MonkeyPatch.context() as patch:
        steps = Steps(patch)
        store = ShardedStore.open(url)
        steps.before(at, lambda: os.kill(os.getpid(), signal.SIGKILL))
        store.rebalance()
        os._exit(0)


def process_killed_at(servers: ShardedServers, url: str, at: int) -> bool:
    """Kill a rebalance before step `at`, check all; whether there was such a step."""
    before = expected(url)
    process = multiprocessing.get_context("fork").Process(target=rebalance_and_die, args=(url, at))
    process.start()
    assert process.pid is not None
    code = exit_code(process.pid)
    assert code in (0, -signal.SIGKILL)
    assert_goes_on(servers, url, before)
    return code != 0


def test_a_rebalance_killed_at_a_step_is_taken_up(
    sharded_servers: ShardedServers, url: str
) -> None:
    for at in (20, 40):
        assert process_killed_at(sharded_servers, url, at)


@pytest.mark.long
def test_a_rebalance_killed_at_any_step_is_taken_up(
    sharded_servers: ShardedServers, url: str
) -> None:
    for at in sharded_servers.steps_tried:
        if not process_killed_at(sharded_servers, url, at):
            break
    assert 40 < at < MOST_STEPS - 1


# --- the coordinator ----------------------------------------------------------------------------


def coordinator_killed_at(
    servers: ShardedServers, url: str, steps: Steps, at: int, *, back: bool
) -> bool:
    """Kill the coordinator before step `at`, check all; whether there was such a step."""
    before = expected(url)

    def event() -> None:
        servers.coordinator.kill()
        if back:
            servers.coordinator.start()

    with closing(ShardedStore.open(url)) as store:
        steps.before(at, event)
        with suppress(ConnectionLostError):
            store.rebalance()
        n_seen = len(steps.seen)
        steps.none()
        servers.coordinator.start()
    assert_goes_on(servers, url, before)
    return n_seen >= at


@pytest.mark.long
def test_a_rebalance_whose_coordinator_is_killed_at_any_step_is_taken_up(
    sharded_servers: ShardedServers, url: str, steps: Steps
) -> None:
    """Before every other step it is back at once, as after a crash; else it stays away."""
    for at in sharded_servers.steps_tried:
        if not coordinator_killed_at(sharded_servers, url, steps, at, back=at % 2 == 0):
            break
    assert 40 < at < MOST_STEPS - 1
