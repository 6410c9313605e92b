"""Clashes: every pair of objects nearer than a length, and what they are.

Boxes say which pairs may be near, never too few; their surfaces decide. The table `pair` keeps a
row for each pair of near boxes, also of those that turned out to be far, so that a later call
measures only pairs of objects that were written since. Each row is written soon after it was
measured, so a call that was stopped goes on where it was.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from functools import partial
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.clashes.judge import Judged, PlacedPair, judge_placed
from hapticdb.clashes.near import near_pairs
from hapticdb.clashes.result import Clash, Clashes, gravity
from hapticdb.clashes.shapes import Shapes
from hapticdb.cluster.place import Whereabouts
from hapticdb.cluster.workers import Cluster, connected
from hapticdb.environment import Environment
from hapticdb.errors import ReadOnlyError, UsageError
from hapticdb.ready import make_ready
from hapticdb.store.base import Object
from hapticdb.store.finding import Words, find_objects
from hapticdb.store.pairs import PairRow, Status

Floats = NDArray[np.float64]
ClashCallback = Callable[[int, int], object]
"""Called with how many pairs are measured, and how many there are to measure."""

WITHIN, CONTACT = 1e-3, 5e-5
"""Defaults of the greatest distance that is told, and of the contact tolerance, metres."""
BUDGET = 256 << 20
"""Default of the memory for shapes, bytes."""
SAME = 1e-9
"""Metres by which a pair's figures may differ and are still the same: rounding of placements."""
ROUNDING = 2.0**-40
"""Metres, and share of one in a rotation, to which the placement of two shapes is rounded. Coarser:
more pairs are found to be placed alike, and lengths are less exact."""
PIECE = 128
"""Pairs of one task of a worker, which reads the shapes anew. More: fewer reads, and a lost worker
costs more."""
SECONDS_BETWEEN = 2.0
"""Seconds of work that an end without warning loses at most, but for the pair under way."""


def find_clashes(
    env: Environment,
    *,
    within: float = WITHIN,
    contact: float = CONTACT,
    of: Words = (),
    against: Words = (),
    seconds: float | None = None,
    budget: int = BUDGET,
    progress: ClashCallback | None = None,
    on: str | None = None,
) -> Clashes:
    """Find every pair of objects that are near one another, and what they are.

    Parameters
    ----------
    env : Environment
        With the surfaces of its objects. Opened to write, it keeps what is found, and a later call
        measures only pairs of objects that were written since.
    within : float
        Metres: pairs that are farther apart are not told, unless one lies inside the other.
    contact : float
        Metres: surfaces that near touch, and so do those that a motion by so much frees.
    of, against : iterable of int or str
        One object of each pair is of the first, the other of the second; all unless given. Words as
        for `Environment.find`.
    seconds : float or None
        Time after which the rest is left; a later call goes on there.
    budget : int
        Bytes for shapes in memory.
    progress : callable or None
        Called with the number of pairs measured, and of all that have to be.
    on : str or None
        Scheduler of dask.distributed, ``tcp://host:8786``, whose workers measure, and reach the
        environment by the URL that opened it.

    Raises
    ------
    UsageError
        If a number is out of range.
    ClusterError, MissingExtraError
        If there are no workers, or they do not reach the environment.
    ObjectNotFoundError, NoSurfaceError
        If a word chooses no object; if an object's surface is not in the database.
    """
    if not 0.0 < contact <= within < np.inf:
        raise UsageError(
            f"within {within} m, contact {contact} m: give lengths above 0, contact the lesser one"
        )
    if seconds is not None and not seconds > 0.0:
        raise UsageError(f"a search of {seconds} seconds: give more than 0")
    make_ready("clashes")
    began = time.monotonic()
    until = np.inf if seconds is None else began + seconds
    asked = _Asked(within, contact, tuple(of), tuple(against), until, budget, progress)
    with connected(on) as workers:
        return _Search(env, asked, workers).found(began)


def accept_clash(env: Environment, a: Words, b: Words, because: str | None) -> list[PairRow]:
    """Accept the pairs between objects a and b, until either changes its shape.

    because : why; None takes an acceptance back. Returns the rows of the pairs.

    Raises
    ------
    UsageError
        If no such pair is known, or the reason is empty.
    """
    if because is not None and not because.strip():
        raise UsageError("an empty reason: say why the pair is accepted")
    ones, others = ({obj.id: obj for obj in find_objects(env.store, words)} for words in (a, b))
    known = ones | others
    rows = [
        row
        for row in env.store.pairs()
        if row.kind != "far"
        and ((row.a in ones and row.b in others) or (row.b in ones and row.a in others))
    ]
    if not rows:
        raise UsageError("no pair between these objects is known: run 'hapticdb clashes' first")
    for row in rows:
        shapes = None if because is None else _shapes(known[row.a], known[row.b])
        env.store.accept_pair(row.a, row.b, because, shapes)
    return rows


class _Asked(NamedTuple):
    """What is asked, as for `find_clashes`; until : time of `time.monotonic`."""

    within: float
    contact: float
    of: tuple[int | str, ...]
    against: tuple[int | str, ...]
    until: float
    budget: int
    progress: ClashCallback | None

    @property
    def setting(self) -> str:
        """What a row depends on beside its objects."""
        return f"within {self.within!r} contact {self.contact!r}"


class _Search:
    """State of one search."""

    def __init__(self, env: Environment, asked: _Asked, workers: Cluster | None) -> None:
        store = env.store
        self._store, self._asked = store, asked
        self._address, self._workers = env.address, workers
        self._is_kept = not store.is_read_only
        self._waiting: list[PairRow] = []
        self._wrote = time.monotonic()
        self._shapes = Shapes(store, asked.budget)
        self._setting = asked.setting

    def found(self, began: float) -> Clashes:
        """Search."""
        with self._store.snapshot():
            revision = self._store.revision()
            objects = self._store.objects()
            rows = {(row.a, row.b): row for row in self._store.pairs()}
            chosen = [
                {obj.id for obj in find_objects(self._store, words)} if words else None
                for words in (self._asked.of, self._asked.against)
            ]
        masks = [
            np.array([ids is None or obj.id in ids for obj in objects], dtype=np.bool_)
            for ids in chosen
        ]
        near = near_pairs(objects, self._asked.within, masks[0], masks[1])
        known = np.array([(obj.id, obj.revision) for obj in objects], dtype=np.int64)
        ids, written = known.reshape(-1, 2).T
        keys: list[tuple[int, int]] = list(map(tuple, ids[near].tolist()))
        newest = written[near].max(axis=1, initial=0).tolist()
        looked = {
            key
            for key, later in zip(keys, newest, strict=True)
            if self._is_fresh(rows.get(key), later)
        }
        n_kept = len(looked)
        by_id = {obj.id: obj for obj in objects}
        stale = [(by_id[a], by_id[b]) for a, b in keys if (a, b) not in looked]
        shown = {key: row for key, row in rows.items() if _is_asked(*key, *chosen)}
        with self._keeping():
            for row in self._measured(stale, rows, revision):
                shown[row.a, row.b] = row
                looked.add((row.a, row.b))
        left = [pair for pair in stale if _key(*pair) not in looked]
        told = self._told(by_id, shown, looked, left)
        self._settle(shown, looked, left, by_id)
        return Clashes(
            tuple(sorted(told, key=gravity)), len(stale) - len(left), n_kept, len(left),
            self._asked.within, self._asked.contact, revision,
            time.monotonic() - began, self._is_kept,
        )  # fmt: skip

    def _is_fresh(self, row: PairRow | None, newest: int) -> bool:
        return row is not None and row.revision >= newest and row.setting == self._setting

    def _measured(
        self,
        stale: Sequence[tuple[Object, Object]],
        rows: dict[tuple[int, int], PairRow],
        revision: int,
    ) -> Iterator[PairRow]:
        """Measure pairs, and keep each; leaves out what was written meanwhile."""
        alike: dict[object, list[tuple[Object, Object]]] = {}
        placed = []
        for one, other in stale:
            (a, world_from_a), (b, world_from_b) = map(self._shapes.placement, (one, other))
            pose = _rounded(_inverse(world_from_a) @ world_from_b)
            group = alike.setdefault((a, b, pose.tobytes()), [])
            if not group:
                placed.append(PlacedPair(one, other, pose))
            group.append((one, other))
        n_done = 0
        for judged, pairs in zip(self._judged(placed), alike.values(), strict=False):
            for one, other in pairs:
                n_done += 1
                if judged is not None:
                    row = _compared(
                        self._row(one, other, judged, revision), rows.get((one.id, other.id))
                    )
                    self._waiting.append(row)
                    yield row
                    if time.monotonic() - self._wrote > SECONDS_BETWEEN:
                        self._write()
                if self._asked.progress is not None:
                    self._asked.progress(n_done, len(stale))

    def _row(self, one: Object, other: Object, judged: Judged, revision: int) -> PairRow:
        """What the table keeps of a pair."""
        world_from_a = self._shapes.placement(one)[1]
        on_a, on_b = (
            world_from_a[:3, :3] @ place + world_from_a[:3, 3]
            for place in (judged.on_a, judged.on_b)
        )
        return PairRow(
            one.id, other.id, judged.kind, judged.at_least,
            judged.at_most if np.isfinite(judged.at_most) else None,
            (*on_a.tolist(), *on_b.tolist()), "new", revision, self._setting,
        )  # fmt: skip

    def _judged(self, placed: Sequence[PlacedPair]) -> Iterator[Judged | None]:
        """Judge pairs, here or by workers, as long as there is time."""
        # threads on two processors gained a tenth: most of the time holds the interpreter's lock
        asked = self._asked
        work = partial(judge_placed, within=asked.within, contact=asked.contact)
        if self._workers is None:
            for one in placed:
                if time.monotonic() > asked.until:
                    return
                yield work(self._shapes, one)
            return
        there = Whereabouts.of(self._store, self._address)
        pieces = [placed[first : first + PIECE] for first in range(0, len(placed), PIECE)]
        with closing(
            self._workers.each(partial(_piece, there, asked.budget, work), pieces)
        ) as done:
            for judged in done:
                yield from judged
                if time.monotonic() > asked.until:
                    return

    @contextmanager
    def _keeping(self) -> Iterator[None]:
        """Write what was measured, also when the block ends by an error or an interrupt."""
        try:
            yield
        finally:
            self._write()

    def _write(self, gone: Sequence[tuple[int, int]] = ()) -> None:
        """Write the rows that wait, if this user may."""
        if self._is_kept and (self._waiting or gone):
            try:
                self._store.put_pairs(self._waiting, gone)
            except ReadOnlyError:
                self._is_kept = False
        self._waiting = []
        self._wrote = time.monotonic()

    def _told(
        self,
        by_id: dict[int, Object],
        shown: dict[tuple[int, int], PairRow],
        looked: set[tuple[int, int]],
        left: Sequence[tuple[Object, Object]],
    ) -> Iterator[Clash]:
        """Pairs as they are told: looked at, gone since the last call, and not looked at."""
        names = {i: obj.name for i, obj in by_id.items()}
        waiting = {_key(*pair) for pair in left}
        for key, row in shown.items():
            status: Status = row.status
            if key not in looked:
                if row.kind == "far" or key in waiting:
                    continue
                status = "gone"
            elif row.kind == "far" and status != "gone":
                continue
            because = _accepted(row, by_id)
            yield Clash(
                *key, names.get(row.a), names.get(row.b),
                "apart" if status == "gone" else row.kind, row.at_least, row.at_most, row.place,
                "accepted" if because is not None and status != "gone" else status, because,
            )  # fmt: skip
        for one, other in left:
            yield Clash(
                one.id, other.id, one.name, other.name, "not known", 0.0, None, None,
                "not looked at",
            )  # fmt: skip

    def _settle(
        self,
        shown: dict[tuple[int, int], PairRow],
        looked: set[tuple[int, int]],
        left: Sequence[tuple[Object, Object]],
        by_id: dict[int, Object],
    ) -> None:
        """Note that statuses were told: what is new now is the same next time."""
        if left:
            return
        self._waiting = [
            shown[key]._replace(status="same") for key in looked if shown[key].status != "same"
        ]
        gone = []
        for key, row in shown.items():
            if key in looked:
                continue
            if _accepted(row, by_id) is not None:
                self._waiting.append(row._replace(kind="far", status="same"))
            else:
                gone.append(key)
        self._write(gone)


def _piece(
    there: Whereabouts,
    budget: int,
    work: Callable[[Shapes, PlacedPair], Judged | None],
    placed: Sequence[PlacedPair],
) -> list[Judged | None]:
    """Judge pairs: the task of a worker."""
    make_ready("clashes")
    with closing(there.open()) as store:
        shapes = Shapes(store, budget)
        return [work(shapes, one) for one in placed]


def _key(one: Object, other: Object) -> tuple[int, int]:
    return one.id, other.id


def _is_asked(a: int, b: int, of: set[int] | None, against: set[int] | None) -> bool:
    """Whether one object is of the first, and the other of the second; None is of all."""
    return any(
        (of is None or one in of) and (against is None or other in against)
        for one, other in ((a, b), (b, a))
    )


def _shapes(one: Object, other: Object) -> str:
    """Both shapes, as an acceptance notes them."""
    return f"{one.digest} {other.digest}"


def _accepted(row: PairRow, by_id: dict[int, Object]) -> str | None:
    """Why a pair is accepted; None where it is not, or a shape has changed since."""
    if row.because is None:
        return None
    one, other = by_id.get(row.a), by_id.get(row.b)
    if one is None or other is None or row.shapes != _shapes(one, other):
        return None
    return row.because


def _compared(row: PairRow, old: PairRow | None) -> PairRow:
    """A row with its status, and what the former one says of acceptance."""
    if old is None:
        return row._replace(status="same" if row.kind == "far" else "new")
    # an earlier call that came to no end has left what it would have told
    was_told = (old.kind != "far" and old.status != "new") or old.status == "gone"
    status: Status
    if row.kind == "far":
        status = "gone" if was_told else "same"
    elif not was_told:
        status = "new"
    else:
        status = "same" if old.status == "same" and _is_same(row, old) else "changed"
    return row._replace(status=status, because=old.because, shapes=old.shapes)


def _is_same(row: PairRow, old: PairRow) -> bool:
    if row.kind != old.kind or (row.at_most is None) != (old.at_most is None):
        return False
    now, before = (
        np.array([one.at_least, one.at_most or 0.0], dtype=np.float64) for one in (row, old)
    )
    return bool((np.abs(now - before) <= SAME).all())


def _rounded(pose: Floats) -> Floats:
    """A pose to `ROUNDING`, so that equal shapes placed alike are the same pair everywhere."""
    return np.asarray(np.round(pose / ROUNDING) * ROUNDING + 0.0)


def _inverse(pose: Floats) -> Floats:
    """Inverse of a rigid pose (4, 4)."""
    back = np.eye(4)
    back[:3, :3] = pose[:3, :3].T
    back[:3, 3] = -back[:3, :3] @ pose[:3, 3]
    return back
