"""Sessions on real servers, one of which is killed and started again."""

from typing import Any

import numpy as np
import pytest

import hapticdb
from children import until
from hapticdb import Grid, PointShell
from hapticdb.devices.scripted import Player
from hapticdb.realtime.resident_cells import ResidentCells
from hapticdb.realtime.session import Session
from hapticdb.testing import write_voxels
from realtime import sessions
from realtime.hands import at
from realtime.sessions import NEVER_STALE
from realtime.worlds import SIZE, block, move
from servers import Place
from sharded import ShardedServers

RATE = 1000.0
"""Frames a second."""
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


@pytest.mark.long
def test_a_session_goes_on_while_a_server_elsewhere_is_killed_and_started_again(
    sharded_place: Place, sharded_servers: ShardedServers, sphere: PointShell
) -> None:
    url, server = sharded_place(), sharded_servers.shards[-1]
    options: dict[str, Any] = {"rate": RATE, "staleness": NEVER_STALE, "has_baseline": False}
    with hapticdb.create(url, GRID, layout="brick") as env:
        write_voxels(env.store, FIRST, "first")
        write_voxels(env.store, LAST, "last")
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
