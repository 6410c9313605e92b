"""Frames of an opened environment: the law, the objects and the revision that belong to each."""

from collections.abc import Callable
from typing import TypeVar

from numpy.typing import ArrayLike

from hapticdb.errors import ConnectionLostError
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.figures import QueryFigures
from hapticdb.query.frame import Answer, HapticQuery, Strategy
from hapticdb.query.known_objects import KnownObjects
from hapticdb.query.law import PLANE, ForceLaw
from hapticdb.query.touches import Touch
from hapticdb.ready import make_ready
from hapticdb.store.base import Store
from hapticdb.store.filtering import Filter

_Felt = TypeVar("_Felt")


class Touching:
    """Runs frames against a store; `hapticdb.environment.Environment` says what arguments mean.

    Attributes
    ----------
    known : KnownObjects
        Objects of the revision that the last frame has read.
    """

    def __init__(self, store: Store, figures: QueryFigures) -> None:
        self._store = store
        self._figures = figures
        self._query = HapticQuery(store, figures.both)
        self.known = KnownObjects(store)

    def learn_first(self) -> None:
        """List the objects, unless a frame has, and no edit came after it."""
        if self.known.version is None:
            with self._store.snapshot():
                self._store.revision()  # `version` then tells of this snapshot
                self.known.learn()

    def law_now(self, law: ForceLaw | None) -> ForceLaw:
        """The law of a frame at the newest revision, whose objects are loaded."""

        def chosen() -> ForceLaw:
            with self._store.snapshot():
                return self._law_of_snapshot(law)

        return _twice(chosen)

    def touch(
        self,
        shell: PointShell,
        pose: ArrayLike,
        strategy: Strategy,
        maxgap: int,
        felt: Filter,
        law: ForceLaw | None,
    ) -> Touch:
        """Compute one frame."""
        make_ready("touch")
        answer = _twice(lambda: self._answer(shell, pose, strategy, maxgap, felt, law))
        self.known.check_words(felt)
        self.known.check_answer(answer.ids)
        return Touch(answer, self.known.by_id)

    def _answer(
        self,
        shell: PointShell,
        pose: ArrayLike,
        strategy: Strategy,
        maxgap: int,
        felt: Filter,
        law: ForceLaw | None,
    ) -> Answer:
        """Answer of a frame; also loads the objects of the revision that the frame read."""
        known = self.known
        fitting = known.fits(law)
        chosen = known.law_of(law) if fitting else PLANE
        answer = self._query.run(shell, pose, strategy, maxgap, known.left_out(felt), chosen)
        if not fitting or self._store.version() != known.version:
            with self._store.snapshot():
                chosen = self._law_of_snapshot(law)
                answer = self._query.run(
                    shell, pose, strategy, maxgap, known.left_out(felt), chosen
                )
        return answer

    def _law_of_snapshot(self, law: ForceLaw | None) -> ForceLaw:
        """The law of a frame in this snapshot; also loads the snapshot's objects."""
        self._store.revision()  # `version` then tells of this snapshot
        if self.known.learn():
            self._figures.drop_empty_statistics()
        return self.known.law_of(law)


def _twice(work: Callable[[], _Felt]) -> _Felt:
    """Result of `work`; if a connection is lost inside its snapshot, all of it is repeated once."""
    try:
        return work()
    except ConnectionLostError:
        return work()
