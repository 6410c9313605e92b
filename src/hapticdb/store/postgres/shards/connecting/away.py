"""Shards that are away: left out by reads that can do without them, and connected again meanwhile.

A thread for each such shard tries to connect, so no read waits for a server that does not answer.
"""

import contextlib
import threading
import time
from collections.abc import Callable, Sequence

from hapticdb.errors import HapticDBError
from hapticdb.store.postgres.shards.connecting.links import (
    Answer,
    ShardConnection,
    ShardQuery,
    Shards,
)

PATIENCE_MS = 500
"""Milliseconds that shards may take to answer before they count as away. A larger value bears
slower shards; but while one is waited for, the cells of all others wait, too, and no cell is proved
to be up to date: it must be well below a session's staleness, 1 s unless the user gives another."""
FIRST_WAIT_S = 1.0
"""Seconds that the first read waits for its connections."""
PAUSE_S = 0.25
"""Seconds between two tries to connect. A larger value asks a struggling server less often, and
notices later that it is back."""


class AwayShards:
    """Which shards of an environment are away, for reads that leave them out.

    prepared : statements of these reads, and the types of their parameters. They are prepared while
    the threads connect, so that no read waits for that.
    """

    def __init__(self, shards: Shards, prepared: Sequence[tuple[str, Sequence[int]]]) -> None:
        self._shards = shards
        self._prepared = prepared
        self._revivals: dict[int, _Revival] = {}
        self._has_begun = False

    def names(self) -> tuple[str, ...]:
        """Shards that are away, as messages name them; no round trip."""
        return tuple(
            self._shards.name(shard)
            for shard, revival in sorted(self._revivals.items())
            if revival.connection is None and not self._shards.is_connected(shard)
        )

    def ask(
        self, asks: Sequence[ShardQuery], first: str | None
    ) -> tuple[Answer, list[Answer | None]]:
        """Answers as of `Shards.ask`; None for a shard that is away."""
        self._begin_all()
        for ask in asks:
            if self._shards.is_to_leave_primary(ask.shard) and ask.shard not in self._revivals:
                self._revive(ask.shard)  # the primary goes on until the standby is connected
        there = [ask for ask in asks if self._is_there(ask.shard)]
        found, answers = self._shards.ask_once(there, first, PATIENCE_MS)
        by_shard = {ask.shard: answer for ask, answer in zip(there, answers, strict=True)}
        for shard, answer in by_shard.items():
            if answer is None:
                self._shards.try_another_server(shard)
                self._begin(shard)
        return found, [by_shard.get(ask.shard) for ask in asks]

    def catch_up(self, shard: int, writes: int) -> None:
        """Have a shard whose standby was behind answer with so many writes, or count as away."""
        if not self._shards.has_replayed(shard, writes, PATIENCE_MS):
            self._shards.turn_to_primary(shard)
            self._begin(shard)

    def close(self) -> None:
        """Give up all shards that are away."""
        for revival in self._revivals.values():
            revival.stop()
        self._revivals.clear()

    def _begin_all(self) -> None:
        """Connect to all shards when the first is asked; later that would hold up others' cells."""
        if self._has_begun:
            return
        self._has_begun = True
        for shard in range(len(self._shards)):
            if not self._shards.is_connected(shard):
                self._begin(shard)
        deadline = time.monotonic() + FIRST_WAIT_S
        for revival in self._revivals.values():
            revival.wait(max(deadline - time.monotonic(), 0.0))

    def _is_there(self, shard: int) -> bool:
        """Whether a shard is connected; takes over a connection that a thread has made."""
        revival = self._revivals.get(shard)
        if revival is None:
            return True
        connection = revival.connection
        if connection is None:
            return self._shards.is_connected(shard)
        self._shards.exchange(shard, connection)
        del self._revivals[shard]
        return True

    def _begin(self, shard: int) -> None:
        """Leave a shard out until a thread has connected to it."""
        self._shards.exchange(shard, None)
        if (before := self._revivals.pop(shard, None)) is not None:
            before.stop()
        self._revive(shard)

    def _revive(self, shard: int) -> None:
        """Begin a thread that connects to a shard."""

        def connect() -> ShardConnection:
            try:
                made = self._shards.connected(shard)
            except BaseException:
                self._shards.try_another_server(shard)
                raise
            try:
                for text, oids in self._prepared:
                    made.prepare(text, oids)
            except BaseException:
                made.close()
                raise
            return made

        self._revivals[shard] = _Revival(connect)


class _Revival:
    """A thread that connects to one shard, however long that takes."""

    def __init__(self, connect: Callable[[], ShardConnection]) -> None:
        self.connection: ShardConnection | None = None
        self._connect = connect
        self._lock = threading.Lock()
        self._is_stopped = threading.Event()
        self._is_done = threading.Event()
        threading.Thread(target=self._run, name="hapticdb-away", daemon=True).start()

    def wait(self, seconds: float) -> None:
        """Wait until connected, or for so many seconds."""
        self._is_done.wait(seconds)

    def stop(self) -> None:
        """Stop trying; a connection that is being made is closed when it is there."""
        self._is_stopped.set()
        with self._lock:
            if self.connection is not None:
                self.connection.close()

    def _run(self) -> None:
        while not self._is_stopped.is_set():
            with contextlib.suppress(HapticDBError, OSError):
                made = self._connect()
                with self._lock:
                    if self._is_stopped.is_set():
                        made.close()
                    self.connection = made
                self._is_done.set()
                return
            self._is_stopped.wait(PAUSE_S)
