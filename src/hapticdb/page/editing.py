"""Edits that people make on the page: one thread, one writable connection, undo for each person."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticdb.environment import Environment
from hapticdb.errors import HapticDBError, UsageError
from hapticdb.page.database import DatabaseThread
from hapticdb.page.wording import short_name
from hapticdb.store.base import Object

MOST_UNDONE = 50
"""Moves of a person that can be undone. Larger: further back."""


class PersonsEdits:
    """Moves of one person in an environment, and their undo."""

    def __init__(self, env: Environment) -> None:
        self._env = env
        self._done: list[tuple[Object, NDArray[np.float64]]] = []

    def move(self, obj: Object, way: NDArray[np.float64]) -> str:
        """Displace an object, as it was read, by (4, 4); returns what was done, in words."""
        after = self._env.move(obj.id, way @ obj.transform, revision=obj.revision)
        self._done = [*self._done[1 - MOST_UNDONE :], (after, obj.transform)]
        return short_name(obj.name)

    def undo(self) -> str:
        """Put the object of the last move back, unless somebody has moved it since."""
        if not self._done:
            raise UsageError("there is no move of yours to undo")
        after, before = self._done.pop()
        self._env.move(after.id, before, revision=after.revision)
        return f"{short_name(after.name)} is back"


class Edits:
    """Edits of all people of a page.

    Parameters
    ----------
    url : str
        The environment, as one who may write reaches it.
    """

    def __init__(self, url: str) -> None:
        self._url = url
        self._thread: DatabaseThread | None = None
        self._of: dict[int, PersonsEdits] = {}

    def ask(
        self,
        person: int,
        job: Callable[[PersonsEdits], str],
        then: Callable[[str], Any],
        failed: Callable[[HapticDBError], Any],
    ) -> None:
        """Do an edit of a person later; then call `then` or `failed`."""
        if self._thread is None:
            self._thread = DatabaseThread(self._url, read_only=False)

        def work(env: Environment) -> str:
            return job(self._of.setdefault(person, PersonsEdits(env)))

        self._thread.ask(work, then, failed)

    def forget(self, person: int) -> None:
        """Forget a person's moves."""
        self._of.pop(person, None)

    def close(self) -> None:
        """End the thread."""
        if self._thread is not None:
            self._thread.close()
