"""Frames of an opened environment: the law, the objects and the revision that belong to each."""

from numpy.typing import ArrayLike

from hapticdb.errors import ConnectionLostError
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.figures import QueryFigures
from hapticdb.query.frame import Answer, HapticQuery, Strategy
from hapticdb.query.known_objects import KnownObjects
from hapticdb.query.law import PLANE, ForceLaw
from hapticdb.query.touches import Touch
from hapticdb.store.base import Object, Store
from hapticdb.store.filtering import Filter


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
            self.newest()

    def newest(self) -> list[Object]:
        """All objects, ordered by id; only those written since the last time are read."""
        self.known.learn_newest()  # in no snapshot, which asks servers that have rows alone, too
        self._figures.drop_empty_statistics()
        return [*self.known.by_id.values()]

    def law_now(self, law: ForceLaw | None) -> ForceLaw:
        """The law of a frame at the newest revision, whose objects are loaded."""
        try:
            with self._store.snapshot():
                return self._law_of_snapshot(law)
        except ConnectionLostError:  # inside a snapshot all is repeated, once
            with self._store.snapshot():
                return self._law_of_snapshot(law)

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
        try:
            answer = self._answer(shell, pose, strategy, maxgap, felt, law)
        except ConnectionLostError:
            answer = self._answer(shell, pose, strategy, maxgap, felt, law)
        if not felt.is_empty:
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
        is_fitting = known.fits(law)
        chosen = (law or known.own_law) if is_fitting else PLANE
        answer = self._query.run(shell, pose, strategy, maxgap, known.left_out(felt), chosen)
        if not is_fitting or self._store.version() != known.version:
            with self._store.snapshot():
                chosen = self._law_of_snapshot(law)
                answer = self._query.run(
                    shell, pose, strategy, maxgap, known.left_out(felt), chosen
                )
        return answer

    def _law_of_snapshot(self, law: ForceLaw | None) -> ForceLaw:
        """The law of a frame in this snapshot; also loads the snapshot's objects.

        UsageError if the law reads distances, and an object has none.
        """
        self._learn()
        if not self.known.fits(law):
            self.known.check_distances()
        return law or self.known.own_law

    def _learn(self) -> None:
        """Load this snapshot's objects."""
        if self.known.learn():
            self._figures.drop_empty_statistics()
