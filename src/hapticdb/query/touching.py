"""Frames of an opened environment: the law, the objects and the revision that belong to each."""

from numpy.typing import ArrayLike

from hapticdb.errors import ConnectionLostError
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.figures import QueryFigures
from hapticdb.query.frame import NOTHING_EXCLUDED, HapticQuery, Strategy
from hapticdb.query.known_objects import KnownObjects
from hapticdb.query.law import ForceLaw
from hapticdb.query.touches import Touch
from hapticdb.store.base import Object, Store
from hapticdb.store.filtering import ALL, Filter
from hapticdb.store.parsing import damaged


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
        self.known.forget()
        self.known.learn()  # in no snapshot, which asks servers that have rows alone, too
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
        known = self.known
        try:
            touch = None
            if known.version is not None and (law is None or known.fits(law)):
                exclude = NOTHING_EXCLUDED if felt is ALL else known.left_out(felt)
                chosen = law or known.own_law
                touch = self._query.run(shell, pose, strategy, maxgap, exclude, chosen, known.by_id)
            if touch is None or self._store.version() != known.version:
                touch = self._touch_anew(shell, pose, strategy, maxgap, felt, law)
        except ConnectionLostError:
            touch = self._touch_anew(shell, pose, strategy, maxgap, felt, law)
        for stray in set(touch.ids).difference(known.by_id):
            raise damaged(self._store.url, f"rows of object {stray}, which is not there")
        if not felt.is_empty:
            known.check_words(felt)
        return touch

    def _touch_anew(
        self,
        shell: PointShell,
        pose: ArrayLike,
        strategy: Strategy,
        maxgap: int,
        felt: Filter,
        law: ForceLaw | None,
    ) -> Touch:
        """Compute one frame in a snapshot, whose objects are loaded first."""
        known = self.known
        if known.version is None:  # the first frame: kernels may have to be compiled
            self._query.get_ready(strategy, self.law_now(law))
        with self._store.snapshot():
            chosen = self._law_of_snapshot(law)
            exclude = known.left_out(felt)
            return self._query.run(shell, pose, strategy, maxgap, exclude, chosen, known.by_id)

    def _law_of_snapshot(self, law: ForceLaw | None) -> ForceLaw:
        """The law of a frame in this snapshot; also loads the snapshot's objects.

        UsageError if the law reads distances, and an object has none.
        """
        if self.known.learn():
            self._figures.drop_empty_statistics()
        if law is not None and not self.known.fits(law):
            self.known.check_distances()
        return law or self.known.own_law
