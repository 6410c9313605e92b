"""Edits of the page's editors: one thread, one writable connection, undo per person."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray

from hapticdb.clashes.clash_results import Known
from hapticdb.clashes.groups import Group
from hapticdb.clashes.rules import add_rules
from hapticdb.clashes.search import accept_pairs
from hapticdb.environment import Environment
from hapticdb.errors import (
    AccessError,
    ConflictError,
    EnvironmentExistsError,
    HapticDBError,
    ObjectNotFoundError,
    UsageError,
)
from hapticdb.page.database import DatabaseThread
from hapticdb.page.wording import short_name
from hapticdb.store.base import Object

Answer = TypeVar("Answer")
Floats = NDArray[np.float64]


MOST_STEPS = 1000
"""Greatest length of a person's undo history."""


@dataclass(frozen=True, eq=False)
class _Step:
    """One edit of one object, one transaction.

    before : the object before it; for "put back", before its removal; place (4, 4) :
    world_from_part after it, metres; for "take out", before the removal.
    """

    kind: Literal["move", "take out", "put back"]
    before: Object
    place: Floats

    def describe(self) -> str:
        """One line for people: the edit and its object."""
        whom = f"{self.before.id} ({self.before.name})"
        if self.kind != "move":
            return f"{'took out' if self.kind == 'take out' else self.kind} {whom}"
        shift = self.place[:3, 3] - self.before.transform[:3, 3]
        turned = self.place[:3, :3] @ np.linalg.inv(self.before.transform[:3, :3])
        # clipped: rounding may bring the cosine beyond 1
        angle = np.degrees(np.arccos(np.clip((np.trace(turned) - 1.0) / 2.0, -1.0, 1.0)))
        text = f"moved {whom} by {1000 * float(np.linalg.norm(shift)):.4g} mm"
        return f"{text}, turned it by {angle:.3g} degrees" if angle > 0.01 else text


class PersonsEdits:
    """Edits of one person, each one transaction, and their undo.

    An edit is based on the revision of the object as shown to the person, an undo on the revision
    of the person's last write of it. A newer write by another person raises ConflictError, and
    nothing is written. It also ends the undo of earlier edits of the object, which would revert it.
    """

    def __init__(self, env: Environment) -> None:
        self._env = env
        self._done: list[_Step] = []
        self._revisions: dict[int, int] = {}
        """Revision of the person's last write of each object, by id."""
        self._out: dict[int, Object] = {}

    def move(self, obj: Object, displacement: Floats) -> Object:
        """Displace an object by (4, 4), world frame; ConflictError after another person's write."""
        place = displacement @ obj.transform
        moved = self._move(obj, place, obj.revision)
        self._note(_Step("move", obj, place))
        return moved

    def take_out(self, obj: Object) -> str:
        """Remove an object at the revision shown to the person; errors as for `move`."""
        before = self._take_out(obj, obj.revision)
        self._note(_Step("take out", before, before.transform))
        return f"{short_name(obj.name)} is out"

    def put_back(self) -> str:
        """Restore the object removed last; UsageError without one, or ConflictError."""
        if not self._out:
            raise UsageError("you have taken no part out")
        # dicts keep the order of insertion: the last one taken out
        before = [*self._out.values()][-1]
        self._put_back(before)
        self._note(_Step("put back", before, before.transform))
        return f"{short_name(before.name)} is back"

    def undo(self) -> str:
        """Undo the person's last edit; ConflictError after another person's write of its object."""
        if not self._done:
            raise UsageError("there is nothing to undo")
        # popped after success: an edit that fails for another reason can be undone again
        step = self._done[-1]
        before = step.before
        try:
            if step.kind == "take out":
                self._put_back(before)
            elif step.kind == "put back":
                self._take_out(before, self._revisions[before.id])
            else:
                self._move(before, before.transform, self._revisions[before.id])
        except ConflictError as error:
            self._drop(before.id)
            raise ConflictError(f"cannot undo ({step.describe()}): {error}") from error
        self._done.pop()
        return f"undid: {step.describe()}"

    def accept(self, group: Group, known: Known, because: str | None) -> str:
        """Accept the pairs of a group for a reason; None withdraws the acceptance."""
        accept_pairs(self._env.store, [(one.a, one.b) for one in group.pairs], known, because)
        return "the pairs are " + ("no longer accepted" if because is None else "accepted")

    def add_rule(self, text: str, within: float) -> str:
        """Append a rule for pairs within a distance, metres."""
        add_rules(self._env.store, [text], within)
        return "the rule is kept: look again"

    def _move(self, obj: Object, place: Floats, revision: int) -> Object:
        with _conflicts_named(obj):
            moved = self._env.move(obj.id, place, revision=revision)
        self._wrote(moved, place, revision)
        return moved

    def _take_out(self, obj: Object, revision: int) -> Object:
        with _conflicts_named(obj):
            removed = self._env.remove(obj.id, revision=revision)
        self._out[removed.id] = removed
        self._wrote(removed, removed.transform, revision)
        return removed

    def _put_back(self, removed: Object) -> None:
        try:
            now = self._env.restore(removed)
        except EnvironmentExistsError as error:
            self._out.pop(removed.id, None)
            raise ConflictError(f"another has put it back meanwhile: {error}") from None
        self._out.pop(removed.id, None)
        self._wrote(now, removed.transform, self._revisions[removed.id])

    def _wrote(self, obj: Object, place: Floats, base: int) -> None:
        """Record the revision of a write; another person's base revision ends the undo before it.

        `obj` was read after the write, so it may include a later write by another person.
        """
        # optimistic locking: another base means that another person wrote between
        if base != self._revisions.get(obj.id, base):
            self._drop(obj.id)
        # another place: another person wrote after this commit;
        # with the base an undo ends as a conflict
        self._revisions[obj.id] = obj.revision if np.array_equal(obj.transform, place) else base

    def _drop(self, object_id: int) -> None:
        self._done = [step for step in self._done if step.before.id != object_id]

    def _note(self, step: _Step) -> None:
        self._done = [*self._done, step][-MOST_STEPS:]


@contextmanager
def _conflicts_named(obj: Object) -> Iterator[None]:
    """Replace conflicts by messages for people."""
    try:
        yield
    except (ConflictError, ObjectNotFoundError) as error:
        what = "moved it since you saw it; it is shown where it is now"
        if isinstance(error, ObjectNotFoundError):
            what = "taken it out since you saw it"
        raise ConflictError(f"{short_name(obj.name)}: somebody has {what}") from None


class Edits:
    """Edits of all people, at the address of the role editor."""

    def __init__(self, url: str) -> None:
        self._database = DatabaseThread(url, read_only=False)
        self._of: dict[int, PersonsEdits] = {}

    def submit(
        self,
        person: int,
        job: Callable[[PersonsEdits], Answer],
        then: Callable[[Answer], Any],
        failed: Callable[[HapticDBError], Any],
    ) -> None:
        """Queue an edit of a person, a unique number; then `then` or `failed` is called."""

        def refused(error: HapticDBError) -> None:
            if isinstance(error, AccessError):
                error = AccessError("the server may only read its database: nothing was changed")
            failed(error)

        def work(env: Environment) -> Answer:
            # made in the database's thread: a store belongs to the thread that opened it
            return job(self._of.setdefault(person, PersonsEdits(env)))

        self._database.submit(work, then, refused)

    def forget(self, person: int) -> None:
        """Drop a person's undo history."""
        self._of.pop(person, None)

    def close(self) -> None:
        """End the thread."""
        self._database.close()
