"""Edits that people make on the page: one thread, one writable connection, undo for each person."""

from collections.abc import Callable
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from hapticdb.clashes.run import accept_clash
from hapticdb.edits.editor import Editor
from hapticdb.environment import Environment
from hapticdb.errors import AccessError, ConflictError, HapticDBError, UsageError
from hapticdb.page.database import DatabaseThread
from hapticdb.page.wording import error_text, short_name
from hapticdb.store.base import Object

Answer = TypeVar("Answer")


class PersonsEdits:
    """Edits of one person in an environment, each one transaction, and their undo."""

    def __init__(self, env: Environment) -> None:
        self._env = env
        self._editor = Editor(env)

    def move(self, obj: Object, way: NDArray[np.float64]) -> Object:
        """Displace an object, as the person saw it, by (4, 4); returns it as it is now.

        ConflictError if somebody has written the object since.
        """
        self._check(obj)
        return self._editor.move(obj.id, way @ obj.transform)

    def take_out(self, obj: Object) -> str:
        """Take an object, as the person saw it, out of the scene; errors as for `move`."""
        self._check(obj)
        return f"{short_name(self._editor.take_out(obj.id).name)} is out"

    def put_back(self) -> str:
        """Put back the object that this person took out last."""
        out = self._editor.taken_out
        if not out:
            raise UsageError("you have taken no part out")
        return f"{short_name(self._editor.put_back(out[-1].id).name)} is back"

    def undo(self) -> str:
        """Undo the person's last step; ConflictError if somebody has written its object since."""
        return self._editor.undo()

    def accept(self, a: int, b: int, because: str | None) -> str:
        """Accept a pair of objects that are near, or no longer without a reason."""
        accept_clash(self._env, [a], [b], because)
        return "the pair is no longer accepted" if because is None else "the pair is accepted"

    def _check(self, obj: Object) -> None:
        """Base the next step on an object as the person saw it, if nobody has written it since.

        The editor looks at the object only then. After a look at what another has written, an undo
        would be based on that, too.
        """
        now = self._env.object(obj.id)
        if now.revision == obj.revision:
            now = self._editor.look(obj.id)[0]
        if now.revision != obj.revision:
            raise ConflictError(
                f"{short_name(obj.name)}: somebody has moved it since you saw it; it is shown "
                "where it is now"
            )


class Edits:
    """Edits of all people of a page, at the environment's address for one who may write."""

    def __init__(self, url: str) -> None:
        self._url = url
        self._database = DatabaseThread(url, read_only=False)
        self._of: dict[int, PersonsEdits] = {}

    def ask(
        self,
        person: int,
        job: Callable[[PersonsEdits], Answer],
        then: Callable[[Answer], Any],
        failed: Callable[[HapticDBError], Any],
    ) -> None:
        """Do an edit of a person later; then call `then` or `failed`. Waits for no database.

        person : a number that nobody else ever gets. The error names neither the environment's
        address nor its user.
        """

        def refused(error: HapticDBError) -> None:
            failed(self._without_address(error))

        def work(env: Environment) -> Answer:
            own = self._of.get(person)
            if own is None:
                own = self._of[person] = PersonsEdits(env)
            return job(own)

        self._database.ask(work, then, refused)

    def _without_address(self, error: HapticDBError) -> HapticDBError:
        """Return an error as people elsewhere may read it."""
        if isinstance(error, AccessError):
            return AccessError("the server may only read its database: nothing was changed")
        text = error_text(error, (self._url,))
        return error if text == str(error) else HapticDBError(text)

    def forget(self, person: int) -> None:
        """Forget a person's moves."""
        self._of.pop(person, None)

    def close(self) -> None:
        """End the thread."""
        self._database.close()
