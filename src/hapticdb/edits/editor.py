"""Editor: one person's edits of a scene that others edit, too, with undo and redo."""

import os
from collections.abc import Set as AbstractSet
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.environment import Environment
from hapticdb.errors import (
    ConflictError,
    EnvironmentExistsError,
    ObjectNotFoundError,
    UsageError,
)
from hapticdb.poses import as_floats
from hapticdb.store.base import Object
from hapticdb.store.connect import open_store

MOST_STEPS = 1000
"""Greatest number of steps that can be undone. A larger value keeps more records in memory."""
Kind = Literal["move", "take out", "put back"]


@dataclass(frozen=True, eq=False)
class _EditStep:
    """One edit of one object, which was one transaction.

    before : the object before it; for "put back", as it was when it was taken out;
    transform (4, 4) : world_from_part after it, metres; for "take out", where the object was.
    """

    kind: Kind
    before: Object
    transform: NDArray[np.float64]

    @property
    def object_id(self) -> int:
        return self.before.id

    def describe(self) -> str:
        """One line for people: what was done, to which object."""
        whom = f"{self.before.id} ({self.before.name})"
        if self.kind == "take out":
            return f"took out {whom}"
        if self.kind == "put back":
            return f"put back {whom}"
        way = self.transform[:3, 3] - self.before.transform[:3, 3]
        turned = self.transform[:3, :3] @ np.linalg.inv(self.before.transform[:3, :3])
        angle = np.degrees(np.arccos(np.clip((np.trace(turned) - 1.0) / 2.0, -1.0, 1.0)))
        told = f"moved {whom} by {1000 * float(np.linalg.norm(way)):.4g} mm"
        return f"{told}, turned it by {angle:.3g} degrees" if angle > 0.01 else told


class Editor:
    """Moves objects, takes them out and puts them back; each step is one transaction.

    A step is based on the revision of its object that this editor has seen last: when it began, in
    `look`, or by its own last step. If somebody else has written the object since then, nothing is
    written, and `ConflictError` says so; `look` at the object, then decide. Only the thread that
    made the editor may use it. Also a context manager.

    Parameters
    ----------
    environment : Environment, str or path
        The scene; an environment that is given stays open when the editor is closed.

    Raises
    ------
    ReadOnlyError
        If the scene cannot be written.
    DatabaseError
        If it cannot be opened.
    """

    def __init__(self, environment: Environment | str | os.PathLike[str]) -> None:
        self._owns = not isinstance(environment, Environment)
        self._env = (
            environment
            if isinstance(environment, Environment)
            else Environment(open_store(environment))
        )
        self._seen: dict[int, int] = {}
        self._out: dict[int, Object] = {}
        self._done: list[_EditStep] = []
        self._undone: list[_EditStep] = []
        self._history: list[str] = []
        self.look()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Close the environment, if the editor has opened it. What was done stays."""
        if self._owns:
            self._env.close()

    # -- what is there -----------------------------------------------------------------------

    def look(self, object_id: int | None = None) -> list[Object]:
        """Read an object, or all; later steps are based on what is read here.

        Undo and redo keep the same rule as other steps: nothing of another is lost. They would put
        an object back to a placement from before the other's write, so if somebody else has written
        an object since this editor has seen it, its steps so far can be neither undone nor done
        again, and what this editor has taken out is no longer its own to put back.

        Raises
        ------
        ObjectNotFoundError
            If there is no object of that id.
        """
        some = self._env.objects() if object_id is None else [self._env.object(object_id)]
        written = {obj.id for obj in some if self._seen.get(obj.id) != obj.revision}
        self._drop(written)
        self._out = {i: obj for i, obj in self._out.items() if i not in written}
        self._seen.update((obj.id, obj.revision) for obj in some)
        return some

    @property
    def taken_out(self) -> tuple[Object, ...]:
        """Objects that this editor has taken out and can put back, as they were."""
        return tuple(self._out.values())

    @property
    def history(self) -> tuple[str, ...]:
        """What was done, undone and refused: lines for people, the oldest first."""
        return tuple(self._history)

    # -- steps -------------------------------------------------------------------------------

    def move(self, object_id: int, transform: ArrayLike) -> Object:
        """Move an object to a new placement.

        Parameters
        ----------
        transform : (4, 4) array
            world_from_part, metres, as for `Environment.move`.

        Raises
        ------
        ConflictError
            If somebody else has moved the object or taken it out since this editor has seen it.
        NoSurfaceError, OutsideGridError, UsageError
            As for `Environment.move`.
        """
        before, place = self._present(object_id), as_floats(transform, "a transform").copy()
        moved = self._move(before, place)
        return self._note(_EditStep("move", before, place), moved)

    def take_out(self, object_id: int) -> Object:
        """Take an object out of the scene; returns it as it was.

        Raises
        ------
        ConflictError
            As for `move`.
        """
        before = self._take_out(self._present(object_id))
        return self._note(_EditStep("take out", before, before.transform), before)

    def put_back(self, object_id: int) -> Object:
        """Put an object back that this editor has taken out: where it was, with its id.

        Raises
        ------
        UsageError
            If this editor has not taken it out.
        ConflictError
            If somebody else has put the part back, or has imported it again.
        """
        if object_id not in self._out:
            raise UsageError(f"object {object_id} was not taken out by this editor")
        before = self._out[object_id]
        now = self._put_back(before)
        return self._note(_EditStep("put back", before, before.transform), now)

    def undo(self) -> str:
        """Undo the last step, as a new transaction; returns a line for people.

        Raises
        ------
        UsageError
            If there is no step to undo.
        ConflictError
            If somebody else has written the object since. The object stays as it is, and this
            editor's earlier steps of that object can be undone no more.
        """
        if not self._done:
            raise UsageError("there is nothing to undo")
        step = self._done[-1]
        self._again(step, "undo", undone=True)
        self._undone.append(self._done.pop())
        return self._tell(f"undid: {step.describe()}")

    def redo(self) -> str:
        """Do the step that was undone last again; returns a line for people.

        Raises
        ------
        UsageError
            If no step was undone, or another step was done after that.
        ConflictError
            As for `undo`.
        """
        if not self._undone:
            raise UsageError("there is nothing to do again")
        step = self._undone[-1]
        self._again(step, "do again", undone=False)
        self._done.append(self._undone.pop())
        return self._tell(f"did again: {step.describe()}")

    # -- transactions ------------------------------------------------------------------------

    def _again(self, step: _EditStep, what: str, *, undone: bool) -> None:
        """Do a step, or undo it; a conflict drops all steps of its object."""
        inverse: dict[Kind, Kind] = {
            "move": "move", "take out": "put back", "put back": "take out",
        }  # fmt: skip
        kind = inverse[step.kind] if undone else step.kind
        try:
            if kind == "move":
                place = step.before.transform if undone else step.transform
                self._move(self._present(step.object_id), place)
            elif kind == "take out":
                self._take_out(self._present(step.object_id))
            else:
                self._put_back(self._out.get(step.object_id, step.before))
        except ConflictError as error:
            self._drop({step.object_id})
            refused = f"cannot {what} ({step.describe()}): {error}"
            self._tell(refused)
            raise ConflictError(refused) from error

    def _present(self, object_id: int) -> Object:
        """The object as it is; ConflictError if others have taken it out since it was seen."""
        try:
            return self._env.object(object_id)
        except ObjectNotFoundError:
            if object_id not in self._seen or object_id in self._out:
                raise
            raise self._gone(object_id) from None

    def _gone(self, object_id: int) -> ConflictError:
        seen = self._seen[object_id]
        writes = [c for c in self._env.store.changes(seen) if c.id == object_id]
        when = f" (revision {writes[-1].revision}, seen at {seen})" if writes else ""
        return ConflictError(
            f"object {object_id} of {self._env.url} was taken out by another meanwhile{when}"
        )

    def _move(self, before: Object, place: NDArray[np.float64]) -> Object:
        seen = self._seen.get(before.id, before.revision)
        try:
            moved = self._env.move(before.id, place, revision=seen)
        except ObjectNotFoundError:
            raise self._gone(before.id) from None
        self._seen[moved.id] = seen
        self._see(moved, place)
        return moved

    def _take_out(self, before: Object) -> Object:
        seen = self._seen.get(before.id, before.revision)
        try:
            removed = self._env.remove(before.id, revision=seen)
        except ObjectNotFoundError:
            raise self._gone(before.id) from None
        self._out[removed.id] = removed
        return removed

    def _put_back(self, removed: Object) -> Object:
        try:
            now = self._env.restore(removed)
        except EnvironmentExistsError as error:
            self._out.pop(removed.id, None)
            raise ConflictError(f"another has put it back meanwhile: {error}") from None
        self._out.pop(removed.id, None)
        self._see(now, removed.transform)
        return now

    def _drop(self, ids: AbstractSet[int]) -> None:
        """Forget the steps of objects that somebody else has written."""
        self._done = [step for step in self._done if step.object_id not in ids]
        self._undone = [step for step in self._undone if step.object_id not in ids]

    def _see(self, written: Object, place: NDArray[np.float64]) -> None:
        """Note the revision of an own write, unless another write came before it was read."""
        if np.array_equal(written.transform, place):
            self._seen[written.id] = written.revision

    def _note(self, step: _EditStep, result: Object) -> Object:
        """Add a new step; what was undone before cannot be done again."""
        self._done = [*self._done, step][-MOST_STEPS:]
        self._undone.clear()
        self._tell(step.describe())
        return result

    def _tell(self, line: str) -> str:
        self._history.append(line)
        return line
