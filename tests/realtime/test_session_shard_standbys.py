"""A session whose cells come from the standby of a shard, whose primary is killed."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import numpy as np
import pytest

import hapticdb
from hapticdb import PointShell
from hapticdb.realtime.resident_cells import ResidentCells
from hapticdb.realtime.session import Session
from realtime import sessions
from realtime.test_session_shards import BY_DEFAULT, LAST, meets, over, write_blocks
from realtime.worlds import move
from spread import Spread, spread  # noqa: F401 - a fixture
from standbys import pair  # noqa: F401 - a fixture


@pytest.mark.long
def test_a_session_feels_a_shard_whose_primary_is_away_by_its_standby(
    spread: Spread, sphere: PointShell
) -> None:
    with hapticdb.open(spread.url) as env:
        write_blocks(env)
        spread.pair.await_replay()
        with (
            ResidentCells(spread.url_of_standbys, budget_bytes=4 << 20) as cells,
            Session(cells, sphere, over(0.064), **BY_DEFAULT) as session,
        ):
            sessions.until(lambda: meets(session, "contacts"), session)
            (last,) = (one.id for one in env.objects() if one.name == "last")
            move(env.store, last, LAST + np.array([0, 1, 0]))  # felt through the standby
            revision = env.store.revision()
            sessions.until(lambda: cells.table.revision == revision, session)
            spread.pair.primary.kill()
        with (
            ResidentCells(spread.url_of_standbys, budget_bytes=4 << 20) as cells,
            Session(cells, sphere, over(0.064), **BY_DEFAULT) as session,
        ):
            sessions.until(lambda: meets(session, "contacts"), session)
            assert not cells.shards_away
            report = session.stop()
    assert report.contact_frames > 0
