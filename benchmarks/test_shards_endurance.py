"""A few seconds of edits beside readers on servers that are killed: nothing is torn or lost."""

import tempfile
from pathlib import Path

from shards_endurance import check, endure

SECONDS = 8.0


def test_nothing_is_torn_or_lost_while_servers_and_writers_are_killed() -> None:
    with tempfile.TemporaryDirectory(prefix="endurance-") as name:
        check(endure(Path(name), SECONDS, seed=1))
