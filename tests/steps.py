"""The steps of a process on several servers, counted, so that a test can kill something at each.

A step is a statement, a COMMIT or a COPY, on the coordinator or on a shard.
"""

import threading
from collections.abc import Callable, Iterator
from typing import Any

import pytest

from hapticdb.store.postgres.connecting import wire
from hapticdb.store.postgres.connecting.connection import ServerConnection
from hapticdb.store.postgres.connecting.link import Link
from hapticdb.store.postgres.shards.borders import carrying

MOST_STEPS = 200
Killed = Callable[[], object]


class Steps:
    """Counts the steps of all connections of this process; calls a function before one of them."""

    def __init__(self, patch: pytest.MonkeyPatch) -> None:
        self.seen: list[str] = []
        self._at = -1
        self._event: Killed = lambda: None
        self._lock = threading.RLock()
        for owner, name in [
            (Link, "command"),
            (Link, "run"),
            (ServerConnection, "execute"),
        ]:
            patch.setattr(owner, name, self._counted(getattr(owner, name), 1))
        patch.setattr(wire, "copy_rows", self._counted(wire.copy_rows, -1))
        patch.setattr(carrying, "_copied", self._counted(carrying._copied, -1))

    def _counted(self, method: Callable[..., Any], place: int) -> Callable[..., Any]:
        def called(*args: Any, **keywords: Any) -> Any:  # noqa: ANN401 - any method
            with self._lock:
                text = "COPY" if place < 0 else str(args[place])
                self.seen.append(" ".join(text.split())[:60])
                if len(self.seen) == self._at:
                    self._event()
            return method(*args, **keywords)

        return called

    def before(self, at: int, event: Killed) -> None:
        """Call a function before step `at`, from 1, counted from now."""
        self.seen = []
        self._at, self._event = at, event

    def none(self) -> None:
        self._at = -1


@pytest.fixture
def steps() -> Iterator[Steps]:
    with pytest.MonkeyPatch.context() as patch:
        yield Steps(patch)
