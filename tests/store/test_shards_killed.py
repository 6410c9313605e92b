"""Whatever dies at any step of a write, its object is there whole, before or after, and goes on.

Killed are a shard, the coordinator (as a crash does) and the writing process itself, before each
step (`steps`).
"""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import multiprocessing
import os
import random
import signal
import threading
from contextlib import closing, suppress
from typing import Any

import psycopg
import pytest
from psycopg import sql

from children import exit_code
from hapticdb import ConnectionLostError
from hapticdb.check import check_environment
from hapticdb.store.base import Store
from hapticdb.store.postgres.address import parse
from hapticdb.store.postgres.connecting import connection
from hapticdb.store.postgres.connecting.link import Link
from hapticdb.store.postgres.private_server import PrivateServer
from hapticdb.store.postgres.shards.store import ShardedStore
from hapticdb.testing.scenes import EVERYWHERE
from labelled import GRID, Labels, contents_of, labelled_object, labelled_rows, labels_of
from servers import Place
from sharded import ShardedServers
from steps import MOST_STEPS, Steps, steps  # noqa: F401 - a fixture among them

SOON_S = 0.3
"""Seconds that a writer waits for a server that does not come back."""
N_OBJECTS = 5
"""Objects that the environment has before a kill."""
KINDS = ["replace", "add", "remove"]


@pytest.fixture
def url(sharded_place: Place) -> str:
    """An environment with objects and labels from 1 to `N_OBJECTS`."""
    where = sharded_place()
    with closing(ShardedStore.create(where, GRID, "brick", distances=True)) as store:
        for label in range(1, 1 + N_OBJECTS):
            store.add(labelled_object(label), labelled_rows(label))
    return where


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connection, "RECONNECT_SECONDS", SOON_S)


def edit(store: Store, kind: str, label: int, before: Labels) -> Labels:
    """Write one object of that label; returns what is there then."""
    object_id = min(before)
    if kind == "add":
        return {**before, store.add(labelled_object(label), labelled_rows(label)): label}
    if kind == "replace":
        store.replace(labelled_object(label, object_id), labelled_rows(label), lambda _: [])
        return {**before, object_id: label}
    store.remove(object_id, lambda _: [])
    return {i: n for i, n in before.items() if i != object_id}


def after_edit(kind: str, label: int, before: Labels, next_id: int) -> Labels:
    """What is there after `edit`."""
    if kind == "add":
        return {**before, next_id: label}
    if kind == "replace":
        return {**before, min(before): label}
    return {i: n for i, n in before.items() if i != min(before)}


def rows_on(server: PrivateServer, url: str, statement: str) -> list[tuple[Any, ...]]:
    """Rows of a statement on one server, in the environment's schema."""
    with psycopg.connect(server.conninfo(), autocommit=True) as client:
        client.execute(
            sql.SQL("SET search_path = {}").format(sql.Identifier(parse(url).environment))
        )
        return client.execute(statement).fetchall()


def dead_on_shards(servers: ShardedServers, url: str) -> list[tuple[int, int]]:
    """Objects and versions that shards have and the coordinator does not name."""
    live = set(rows_on(servers.coordinator, url, "SELECT id, version FROM live"))
    found: set[tuple[int, int]] = set()
    for table in ("brick", "band", "written"):
        for shard in servers.shards:
            found |= set(rows_on(shard, url, f"SELECT DISTINCT id, version FROM {table}"))
    return sorted(found - live)


def assert_goes_on(servers: ShardedServers, url: str, allowed: list[Labels]) -> None:
    """Assert that the environment is sound, holds one of these, and can be written and swept."""
    with closing(ShardedStore.open(url)) as store:
        found = contents_of(store)
        assert found in allowed
        for object_id, label in found.items():
            rows = store.rows_of(object_id, *EVERYWHERE)
            assert labels_of(rows) == {object_id: label}
        highest = max([change.id for change in store.changes()])
        new = store.add(labelled_object(9000 + highest), labelled_rows(9000 + highest))
        assert new == highest + 1
        expected = {**found, new: 9000 + highest}
        if len(expected) > N_OBJECTS:
            del expected[min(expected)]
            store.remove(min(found), lambda _: [])
        store.sweep()
        assert dead_on_shards(servers, url) == []
        assert contents_of(store) == expected
    assert check_environment(url).findings == []


def started(servers: ShardedServers) -> None:
    for server in (servers.coordinator, *servers.shards):
        server.start()


def victims(servers: ShardedServers) -> list[PrivateServer]:
    return [servers.shards[1], servers.coordinator]


def killed_at(
    servers: ShardedServers, url: str, steps: Steps, at: int, victim: PrivateServer, *, back: bool
) -> bool:
    """Kill a server before step `at` of an edit, check all; whether there was such a step."""
    kind = KINDS[at % len(KINDS)]
    with closing(ShardedStore.open(url)) as store:
        before = contents_of(store)
        highest = max(change.id for change in store.changes())

        def event() -> None:
            victim.kill()
            if back:
                victim.start()

        steps.before(at, event)
        done = None
        if back:  # nobody notices
            done = edit(store, kind, 100 + at, before)
        else:
            with suppress(ConnectionLostError):
                done = edit(store, kind, 100 + at, before)
        n_seen = len(steps.seen)
        steps.none()
        started(servers)
    after = after_edit(kind, 100 + at, before, highest + 1)
    assert done in (None, after)
    assert_goes_on(servers, url, [before, after] if done is None else [after])
    return n_seen >= at


# --- servers ------------------------------------------------------------------------------------


@pytest.mark.parametrize("which", [0, 1], ids=["shard", "coordinator"])
def test_a_server_killed_at_a_step_leaves_an_object_whole(
    sharded_servers: ShardedServers, url: str, steps: Steps, which: int
) -> None:
    for at in (6, 16, 23):
        assert killed_at(
            sharded_servers, url, steps, at, victims(sharded_servers)[which], back=False
        )


@pytest.mark.long
@pytest.mark.parametrize("back", [False, True], ids=["away", "restarted"])
@pytest.mark.parametrize("which", [0, 1], ids=["shard", "coordinator"])
def test_a_server_killed_at_any_step_leaves_an_object_whole(
    sharded_servers: ShardedServers, url: str, steps: Steps, which: int, back: bool
) -> None:
    victim = victims(sharded_servers)[which]
    n_without = 0
    for at in sharded_servers.steps_tried:
        is_there = killed_at(sharded_servers, url, steps, at, victim, back=back)
        n_without = 0 if is_there else n_without + 1
        if n_without == len(KINDS):
            break
    assert 30 < at < MOST_STEPS - 1


@pytest.mark.long
@pytest.mark.parametrize("which", [0, 1], ids=["shard", "coordinator"])
def test_a_server_killed_during_a_commit_leaves_an_object_whole(
    sharded_servers: ShardedServers,
    url: str,
    monkeypatch: pytest.MonkeyPatch,
    which: int,
) -> None:
    victim = victims(sharded_servers)[which]
    target = victim.conninfo()
    rng = random.Random(1)  # noqa: S311 - moments of a test
    timers: list[threading.Timer] = []
    command = Link.command

    def during(link: Link, text: str) -> None:
        is_victim = link._conninfo.split("host=")[1] in target.split("host=")[1]
        if text == "COMMIT" and not timers and is_victim:
            timers.append(threading.Timer(rng.uniform(0, 0.003), victim.kill))
            timers[0].start()
        command(link, text)

    for n in range(12):
        kind = KINDS[n % len(KINDS)]
        with closing(ShardedStore.open(url)) as store:
            before = contents_of(store)
            highest = max(change.id for change in store.changes())
            timers.clear()
            done = None
            with monkeypatch.context() as patch:
                patch.setattr(Link, "command", during)
                with suppress(ConnectionLostError):
                    done = edit(store, kind, 200 + n, before)
            for timer in timers:
                timer.join(10)
            started(sharded_servers)
        after = after_edit(kind, 200 + n, before, highest + 1)
        assert_goes_on(sharded_servers, url, [before, after] if done is None else [after])


# --- the writing process ------------------------------------------------------------------------


def edit_and_die(url: str, kind: str, label: int, at: int) -> None:
    """Edit in a process that ends before step `at`, as kill -9 ends it."""
    with pytest.MonkeyPatch.context() as patch:
        steps = Steps(patch)
        store = ShardedStore.open(url)
        before = contents_of(store)
        steps.before(at, lambda: os.kill(os.getpid(), signal.SIGKILL))
        edit(store, kind, label, before)
        os._exit(0)


def writer_killed_at(servers: ShardedServers, url: str, at: int) -> bool:
    """Kill a writer before step `at`, check all; whether there was such a step."""
    kind = KINDS[at % len(KINDS)]
    with closing(ShardedStore.open(url, read_only=True)) as store:
        before = contents_of(store)
        highest = max(change.id for change in store.changes())
    process = multiprocessing.get_context("fork").Process(
        target=edit_and_die, args=(url, kind, 300 + at, at)
    )
    process.start()
    assert process.pid is not None
    code = exit_code(process.pid)
    assert code in (0, -signal.SIGKILL)
    after = after_edit(kind, 300 + at, before, highest + 1)
    assert_goes_on(servers, url, [after] if code == 0 else [before, after])
    return code != 0


def test_a_writer_killed_at_a_step_leaves_an_object_whole(
    sharded_servers: ShardedServers, url: str
) -> None:
    for at in (6, 14, 19, 24, 27, 33):
        assert writer_killed_at(sharded_servers, url, at)


@pytest.mark.long
def test_a_writer_killed_at_any_step_leaves_an_object_whole(
    sharded_servers: ShardedServers, url: str
) -> None:
    n_without = 0
    for at in sharded_servers.steps_tried:
        n_without = 0 if writer_killed_at(sharded_servers, url, at) else n_without + 1
        if n_without == len(KINDS):
            break
    assert 30 < at < MOST_STEPS - 1
