"""Sessions on real servers, one of which is killed and started again, or hangs and goes on."""

from collections import Counter
from collections.abc import Callable
from typing import Any

import numpy as np
import psycopg
import pytest

import hapticdb
from children import until
from frozen import frozen
from hapticdb import Environment, Grid, PointShell
from hapticdb.devices.scripted import Player
from hapticdb.realtime.resident_cells import ResidentCells
from hapticdb.realtime.session import Session
from hapticdb.store.postgres.private_server import PrivateServer
from hapticdb.testing import write_voxels
from realtime import sessions
from realtime.hands import at
from realtime.sessions import NEVER_STALE
from realtime.worlds import SIZE, block, move
from servers import Place
from sharded import ShardedServers

RATE = 1000.0
"""Frames a second."""
BY_DEFAULT: dict[str, Any] = {"rate": RATE, "has_baseline": False}
"""Options of sessions with the usual staleness."""
STALE_S = 5.0
"""Seconds that forces may be zero in all because of a busy machine: a fetching process that waited
for a server that hangs as long as other clients do would make them zero for longer."""
GRID = Grid(SIZE, (-64 * SIZE,) * 3, 7)
FIRST = block((24, 24, 58), (40, 40, 63))
"""Voxels in the first quarter of the keys, so on the first shard of three."""
LAST = FIRST + np.array([64, 64, 0])
"""Voxels in the last quarter, on the last shard."""


def over(x: float) -> Player:
    """A hand that goes 2 mm deep into a block at (x, x), and out, again and again."""
    heights = [0.02, 0.010, 0.010, 0.02]
    return Player([0.0, 0.1, 0.2, 0.3], [at(x, x, z) for z in heights], loops=True)


def meets(session: Session, what: str) -> bool:
    """Whether the last frame has met unknown cells, or contacts."""
    last = session.last()
    return last is not None and bool(last[what][0])


def write_blocks(env: Environment) -> None:
    """Write a block on the first shard and one on the last."""
    write_voxels(env.store, FIRST, "first")
    write_voxels(env.store, LAST, "last")


@pytest.mark.long
def test_a_session_goes_on_while_a_server_elsewhere_is_killed_and_started_again(
    sharded_place: Place, sharded_servers: ShardedServers, sphere: PointShell
) -> None:
    url, server = sharded_place(), sharded_servers.shards[-1]
    options: dict[str, Any] = {"rate": RATE, "staleness": NEVER_STALE, "has_baseline": False}
    with hapticdb.create(url, GRID, layout="brick") as env:
        write_blocks(env)
        with (
            ResidentCells(env.url, budget_bytes=4 << 20) as cells,
            Session(cells, sphere, over(-0.064), **options) as first,
        ):
            sessions.until(lambda: meets(first, "contacts"), first)
            server.kill()
            with Session(cells, sphere, over(0.064), **options) as last:
                sessions.until(lambda: meets(last, "unknown"), last)
                until(lambda: len(cells.shards_away) == 1)
                assert cells.shards_away[0].startswith("shard 3 (")
                assert not cells.is_away
                move(env.store, 1, FIRST - np.array([0, 0, 1]))  # on a shard that is there
                revision = env.store.revision()
                sessions.until(lambda: cells.table.revision == revision, first)
                n_frames = first.n_frames
                sessions.until(lambda: first.n_frames > n_frames + 500, first)
                server.start()
                sessions.until(lambda: meets(last, "contacts"), last)
                until(lambda: not cells.shards_away)
                reports = first.stop(), last.stop()
    assert [report.unknown_frames > 0 for report in reports] == [False, True]
    assert [report.contact_frames > 0 for report in reports] == [True, True]
    for report in reports:
        assert (report.stale_frames, report.cache.losses, report.cache.restarts) == (0, 0, 0)
        (shard,) = report.cache.shards
        assert (shard.times, shard.is_away) == (1, False)
        assert shard.seconds > 0.5


def test_a_session_goes_on_while_a_server_elsewhere_hangs(
    sharded_place: Place, sharded_servers: ShardedServers, sphere: PointShell
) -> None:
    url = sharded_place()
    with hapticdb.create(url, GRID, layout="brick") as env:
        write_blocks(env)
        with (
            ResidentCells(env.url, budget_bytes=4 << 20) as cells,
            Session(cells, sphere, over(-0.064), **BY_DEFAULT) as first,
        ):
            sessions.until(lambda: meets(first, "contacts"), first)
            with (
                frozen(sharded_servers.shards[-1]),
                Session(cells, sphere, over(0.064), **BY_DEFAULT) as last,
            ):
                sessions.until(lambda: meets(last, "unknown"), last)
                until(lambda: len(cells.shards_away) == 1)
                assert cells.shards_away[0].startswith("shard 3 (")
                assert not cells.is_away
                move(env.store, 1, FIRST - np.array([0, 0, 1]))  # on a shard that answers
                revision = env.store.revision()
                sessions.until(lambda: cells.table.revision == revision, first)
                n_frames = first.n_frames
                sessions.until(lambda: first.n_frames > n_frames + 1500, first)
                stopped = last.stop()
            with Session(cells, sphere, over(0.064), **BY_DEFAULT) as again:
                sessions.until(lambda: meets(again, "contacts"), again)
                until(lambda: not cells.shards_away)
                reports = first.stop(), again.stop()
    assert stopped.unknown_frames > 0
    assert [report.contact_frames > 0 for report in (stopped, *reports)] == [False, True, True]
    assert reports[0].unknown_frames == 0
    assert reports[0].stale_frames < STALE_S * RATE
    for report in reports:
        assert (report.cache.losses, report.cache.restarts) == (0, 0)
        (shard,) = report.cache.shards
        assert (shard.times, shard.is_away) == (1, False)


def clients_of(server: PrivateServer) -> set[int]:
    """Process ids of a server that serve connections of hapticdb."""
    with psycopg.connect(server.conninfo(), autocommit=True) as asking:
        found = asking.execute(
            "SELECT pid FROM pg_stat_activity WHERE application_name = 'hapticdb'"
        )
        return {int(pid) for (pid,) in found}


@pytest.fixture
def at_once(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """For each connection that this process makes: the most that it then has to one server.

    Counted here, not at the server, which may notice late that a connection was closed.
    """
    connect: Callable[..., psycopg.Connection[object]]
    connect = psycopg.Connection.connect.__func__  # type: ignore[attr-defined]
    made: list[tuple[str, psycopg.Connection[object]]] = []
    counts: list[int] = []

    def counted(*args: object, **options: object) -> psycopg.Connection[object]:
        one = connect(*args, **options)
        made.append((f"{one.info.host}:{one.info.port}", one))
        open_ones = Counter(server for server, other in made if not other.closed)
        counts.append(max(open_ones.values()))
        return one

    monkeypatch.setattr(psycopg.Connection, "connect", classmethod(counted))
    return counts


@pytest.mark.long
def test_an_opened_store_has_one_connection_to_each_server_at_most(
    sharded_place: Place,
    sharded_servers: ShardedServers,
    sphere: PointShell,
    at_once: list[int],
) -> None:
    """A session, a sweep, reads and writes; one after another and at the same time.

    The session's fetching process is another store: its connections are counted before and after.
    """
    url = sharded_place()
    servers = (sharded_servers.coordinator, *sharded_servers.shards)
    before = [clients_of(server) for server in servers]

    def are(n: int) -> bool:
        pairs = zip(servers, before, strict=True)
        return all(len(clients_of(server) - others) == n for server, others in pairs)

    poses = [at(x, x, 0.02 - abs(x) / 8) for x in np.linspace(-0.09, 0.09, 400)]
    with hapticdb.create(url, GRID, layout="brick") as env:
        write_blocks(env)
        until(lambda: are(1))  # a server takes a moment to notice a goodbye
        assert set(at_once) == {1}
        with (
            ResidentCells(env.url, budget_bytes=4 << 20) as cells,
            Session(cells, sphere, over(-0.064), **BY_DEFAULT) as session,
        ):
            sessions.until(lambda: meets(session, "contacts"), session)
            until(lambda: are(2))
            at_once.clear()  # a session reads at its start what its environment is
            assert hapticdb.sweep(env, sphere, poses).hits
            move(env.store, 1, FIRST - np.array([0, 0, 1]))
            env.touch(sphere, at(0.064, 0.064, 0.01))
            env.size()
            sessions.until(lambda: cells.table.revision == env.store.revision(), session)
            until(lambda: are(2))
            assert set(at_once) <= {1}
            session.stop()
        until(lambda: are(1))
    until(lambda: are(0))


@pytest.mark.long
def test_a_session_is_felt_again_when_a_coordinator_that_hung_goes_on(
    sharded_place: Place, sharded_servers: ShardedServers, sphere: PointShell
) -> None:
    url = sharded_place()
    with hapticdb.create(url, GRID, layout="brick") as env:
        write_blocks(env)
        with (
            ResidentCells(env.url, budget_bytes=4 << 20) as cells,
            Session(cells, sphere, over(-0.064), **BY_DEFAULT) as session,
        ):
            sessions.until(lambda: meets(session, "contacts"), session)
            with frozen(sharded_servers.coordinator):
                sessions.until(lambda: cells.figures().losses > 0, session)
                last = session.last()
                assert last is not None
                assert not last["applied"].any()  # no force without proof that cells are true
            sessions.until(lambda: not cells.is_away, session)
            n_frames = session.n_frames
            sessions.until(lambda: session.n_frames > n_frames + 500, session)
            sessions.until(lambda: meets(session, "contacts"), session)
            report = session.stop()
    assert report.stale_frames > RATE
    assert report.cache.restarts == 0
    assert report.cache.losses >= 1
