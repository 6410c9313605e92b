"""Search for clashes: every pair of objects nearer than a length, with its kind.

Broad phase by boxes, never too few of them; narrow phase by surfaces. The table `pair` has a row
for each pair of near boxes, also for far surfaces, so a later call measures only pairs of objects
written since. Each row is written soon after its measurement, so a stopped call goes on from there.
"""

import os
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from functools import partial
from itertools import chain, product
from typing import NamedTuple

import numpy as np

from hapticdb.array_types import Floats
from hapticdb.clashes.broad_phase import FEW, near_pairs
from hapticdb.clashes.clash_results import Clash, Clashes, Known, accepted, clash_of, shapes_of
from hapticdb.clashes.rules import Rules, check_clearances
from hapticdb.cluster.environment_address import EnvironmentAddress
from hapticdb.cluster.scheduler import Cluster, connected
from hapticdb.environment import Environment
from hapticdb.errors import ReadOnlyError, UsageError
from hapticdb.exact.clash import PairResult, PlacedPair, classify_pair, measure_placed
from hapticdb.exact.separation import CONTACT
from hapticdb.exact.shape_cache import Shapes, relative_poses
from hapticdb.store.base import Object, Progress, Store
from hapticdb.store.finding import Words, find_objects
from hapticdb.store.pairs import BECAUSE, KIND, Mark, Outlines, PairRow, Status, StoredPairs
from hapticdb.verdicts import Kind

WITHIN = 1e-3
"""Default of the greatest distance of a pair, metres."""
BUDGET = 256 << 20
"""Default of the memory for shapes, bytes."""
SAME = 1e-9
"""Tolerance of the figures of an unchanged pair, metres: rounding of placements."""
ROUNDING = 2.0**-40
"""Rounding of the relative placement of two shapes, metres, and share of one in a rotation.
Coarser: more pairs are placed alike, and lengths are less exact."""
ONE_PLACE = 1e-6
"""Greatest distance of any place of a part from that of its duplicate, metres: exports in single
precision. Larger: thin sheets in a stack are duplicates."""
DUPLICATE = PairResult(Kind.DUPLICATE, 0.0, 0.0, np.zeros(3), np.zeros(3))
"""Judgement of equal shapes at one place."""
PIECE = 128
"""Pairs of one task of a worker. More: fewer reads of shapes, and a lost worker costs more."""
THREADS = min(os.cpu_count() or 1, 8)
"""Threads of the narrow phase. Kernels run without the interpreter's lock, the rest does not."""
IN_FLIGHT = 32
"""Pairs in the threads or before them: enough beside a slow one, with few shapes in memory."""
SECONDS_BETWEEN = 2.0
"""Greatest loss of work at an end without warning, seconds, but for the pair under way."""


def find_clashes(
    env: Environment,
    *,
    within: float = WITHIN,
    contact: float = CONTACT,
    of: Words = (),
    against: Words = (),
    seconds: float | None = None,
    budget: int = BUDGET,
    progress: Progress | None = None,
    on: str | None = None,
) -> Clashes:
    """Find every pair of objects near one another, and its kind.

    Parameters
    ----------
    env : Environment
        With the surfaces of its objects. Opened to write, it keeps what is found, and a later call
        measures only pairs of objects that were written since.
    within : float
        Greatest distance of a pair, metres, unless one lies inside the other.
    contact : float
        Contact tolerance, metres: for distances, and for separating motions.
    of, against : iterable of int or str
        One object of each pair is of the first, the other of the second; all unless given. Words as
        for `Environment.find`.
    seconds : float or None
        Time of the search; a later call goes on with the rest.
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
    ObjectNotFoundError
        If a word chooses no object; if an object's surface is not in the database.
    """
    if not 0.0 < contact <= within < np.inf:
        raise UsageError(
            f"within {within} m, contact {contact} m: give lengths above 0, contact the lesser one"
        )
    if seconds is not None and not seconds > 0.0:
        raise UsageError(f"a search of {seconds} seconds: give more than 0")
    began = time.monotonic()
    until = np.inf if seconds is None else began + seconds
    request = PairQuery(within, contact, tuple(of), tuple(against), until, budget, progress)
    with connected(on) as workers:
        return PairSearch(env.store, request, env.address, workers).found(began)


def accept_clash(env: Environment, a: Words, b: Words, because: str | None) -> list[PairRow]:
    """Accept the pairs between objects a and b, until either changes its shape.

    because : why; None takes an acceptance back. Returns the rows of the pairs.

    Raises
    ------
    UsageError
        If there is no such pair, or the reason is empty.
    """
    ones, others = ({obj.id: obj for obj in find_objects(env.store, words)} for words in (a, b))
    known = {obj.id: (obj.name, obj.digest) for obj in (ones | others).values()}
    rows = [
        row
        for row in env.store.pairs()
        if row.kind != Kind.FAR
        and ((row.a in ones and row.b in others) or (row.b in ones and row.a in others))
    ]
    if not rows:
        raise UsageError("no pair between these objects is known: run 'hapticdb clashes' first")
    accept_pairs(env.store, [(row.a, row.b) for row in rows], known, because)
    return rows


def accept_pairs(
    store: Store, pairs: Iterable[tuple[int, int]], known: Known, because: str | None
) -> None:
    """Accept pairs of ids, or take it back for None; known : names and digests of the objects."""
    if because is not None and not because.strip():
        raise UsageError("an empty reason: say why the pair is accepted")
    for a, b in pairs:
        store.accept_pair(a, b, because, None if because is None else shapes_of(known, a, b))


class PairQuery(NamedTuple):
    """Arguments as for `find_clashes`; until : end, `time.monotonic`."""

    within: float
    contact: float
    of: tuple[int | str, ...]
    against: tuple[int | str, ...]
    until: float
    budget: int
    progress: Progress | None

    @property
    def setting(self) -> str:
        """Dependencies of a row, apart from its objects."""
        return f"within {self.within!r} contact {self.contact!r} by motions, holes"


class PairSearch:
    """State of one search."""

    def __init__(
        self, store: Store, request: PairQuery, address: str = "", workers: Cluster | None = None
    ) -> None:
        self._store, self._request = store, request
        self._address, self._workers = address, workers
        self._is_kept = not store.is_read_only
        self._waiting: list[PairRow] = []
        self._wrote = time.monotonic()
        self._shapes = Shapes(store, request.budget)
        self._setting = request.setting
        self._mark: Mark | None = None  # as this search has read or left it; None if it is another
        self._known: Known = {}

    def found(self, began: float) -> Clashes:
        """Search."""
        store, request = self._store, self._request
        # one snapshot: rows, outlines and rules must be of the revision that the rows will name
        with store.snapshot():
            revision, kept, outlines = store.revision(), store.pairs(), store.outlines()
            of, against = (
                {obj.id for obj in find_objects(store, words)} if words else None
                for words in (request.of, request.against)
            )
            given = store.rules()
            rules = Rules(given, store.objects() if given else (), store.url)
            check_clearances(given, request.within)
            # without rows of ignored pairs the table is not whole
            self._mark = kept.mark
            is_whole = of is None and against is None and not rules.ignores
            rest = kept.none()
            # incremental: of a marked table only pairs with an object written since are read again
            if is_whole and (of := self._changed(kept, revision)) is not None:
                kept, rest = kept.parted(of)
            rows = {(row.a, row.b): row for row in kept}
            near = self.near(outlines, of, against)
            ignored = rules.ignored(chain(rows, near))
            passed = tuple(key for key in near if key in ignored)
            for key in ignored:
                rows.pop(key, None)
                near.pop(key, None)
            measured_keys = {
                key for key, later in near.items() if self._is_fresh(rows.get(key), later)
            }
            keys = [key for key in near if key not in measured_keys]
            by_id = {obj.id: obj for obj in store.objects({i for key in keys for i in key})}
        n_kept = len(measured_keys) + sum(
            row[KIND] != Kind.FAR or row[BECAUSE] is None for row in rest.rows
        )
        known = zip(outlines.names, outlines.digests, strict=True)
        self._known = dict(zip(outlines.ids.tolist(), known, strict=True))
        stale = [(by_id[a], by_id[b]) for a, b in keys]
        shown = {key: row for key, row in rows.items() if _is_requested(*key, of, against)}
        try:
            for row in self.measured(stale, rows, revision):
                shown[row.a, row.b] = row
                measured_keys.add((row.a, row.b))
        finally:  # of an error or an interrupt, too
            self._write()
        left = [key for key in keys if key not in measured_keys]
        current = tuple(self._clashes(shown, measured_keys, left))
        # statuses move on only when all is measured: an interrupted search must not lose a "new"
        if not left:
            self._settle(shown, measured_keys, Mark(self._setting, revision) if is_whole else None)
        return Clashes(
            current, rest, self._known, rules, passed, len(keys) - len(left), n_kept,
            len(left), request.within, request.contact, revision, time.monotonic() - began,
            self._is_kept,
        )  # fmt: skip

    def _changed(self, kept: StoredPairs, revision: int) -> set[int] | None:
        """Objects written since the table had all pairs; None if anything may be missing."""
        setting, since = kept.mark
        # a negative difference: the database was put back to an older state
        if setting != self._setting or not 0 <= revision - since <= FEW or not kept.fit(setting):
            return None
        return {change.id for change in self._store.changes(since)}

    def near(
        self, outlines: Outlines, of: set[int] | None, against: set[int] | None
    ) -> dict[tuple[int, int], int]:
        """Keys of pairs of near boxes of the filter, and the later revision of both."""
        ids, written = outlines.ids, outlines.revisions
        is_of, is_against = (
            np.ones(len(ids), dtype=np.bool_) if some is None else np.isin(ids, list(some))
            for some in (of, against)
        )
        near = near_pairs(outlines.bounds, self._request.within, is_of, is_against)
        newest = written[near].max(axis=1, initial=0).tolist()
        return dict(zip(map(tuple, ids[near].tolist()), newest, strict=True))

    def _is_fresh(self, row: PairRow | None, newest: int) -> bool:
        return row is not None and row.revision >= newest and row.setting == self._setting

    def measured(
        self,
        stale: Sequence[tuple[Object, Object]],
        rows: dict[tuple[int, int], PairRow],
        revision: int,
    ) -> Iterator[PairRow]:
        """Measure pairs and write their rows, but for objects written meanwhile."""
        alike: dict[object, list[tuple[Object, Object]]] = {}
        placed, same = [], []
        for (one, other), pose in zip(stale, self._poses(stale), strict=True):
            if _are_same(one, other):
                same.append((one, other))
                continue
            a, b = (self._shapes.placement(obj)[0] for obj in (one, other))
            # equal shapes in one relative placement, as repeated screws are:
            # one narrow phase for all
            group = alike.setdefault((a, b, pose.tobytes()), [])
            if not group:
                placed.append(PlacedPair(one, other, pose))
            group.append((one, other))
        n_done = 0
        # not strict: at the deadline the results end before the groups
        measured_pairs = zip(self._classified(placed), alike.values(), strict=False)
        for classified, pairs in chain([(DUPLICATE, same)], measured_pairs):
            for one, other in pairs:
                n_done += 1
                if classified is not None:
                    row = _compared(
                        self._row(one, other, classified, revision), rows.get((one.id, other.id))
                    )
                    self._waiting.append(row)
                    yield row
                    if time.monotonic() - self._wrote > SECONDS_BETWEEN:
                        self._write()
                if self._request.progress is not None:
                    self._request.progress(n_done, len(stale))

    def _poses(self, pairs: Sequence[tuple[Object, Object]]) -> Floats:
        """Poses (P, 4, 4) of second shapes in the frames of the first, rounded to `ROUNDING`.

        So equal shapes in equal relative placement are the same pair everywhere.
        """
        world_from_a, world_from_b = (
            np.array([self._shapes.placement(pair[n])[1] for pair in pairs]).reshape(-1, 4, 4)
            for n in (0, 1)
        )
        poses = relative_poses(world_from_a, world_from_b)
        # + 0.0: a minus zero has other bytes, and would make a group of its own
        return np.asarray(np.round(poses / ROUNDING) * ROUNDING + 0.0)

    def _row(self, one: Object, other: Object, classified: PairResult, revision: int) -> PairRow:
        """Row of a pair."""
        world_from_a = self._shapes.placement(one)[1]
        turn, shift = world_from_a[:3, :3], world_from_a[:3, 3]
        on_a, on_b = turn @ classified.on_a + shift, turn @ classified.on_b + shift
        if classified is DUPLICATE:
            on_a = on_b = one.bounds.mean(axis=0)
        return PairRow(
            one.id, other.id, classified.kind, classified.at_least,
            classified.at_most if classified.at_most < np.inf else None,
            (*on_a.tolist(), *on_b.tolist()), "new", revision, self._setting,
        )  # fmt: skip

    def _classified(self, placed: Sequence[PlacedPair]) -> Iterator[PairResult | None]:
        """Judge pairs, here or by workers, as long as there is time."""
        request = self._request
        if self._workers is None:
            yield from self._measured_here(placed)
            return
        work = partial(measure_placed, within=request.within, contact=request.contact)
        there = EnvironmentAddress.of(self._store, self._address)
        pieces = [placed[first : first + PIECE] for first in range(0, len(placed), PIECE)]
        with closing(
            self._workers.each(partial(_piece, there, request.budget, work), pieces)
        ) as done:
            for classified in done:
                yield from classified
                if time.monotonic() > request.until:
                    return

    def _measured_here(self, placed: Sequence[PlacedPair]) -> Iterator[PairResult | None]:
        """Judge pairs in threads over shared shapes; only this thread reads the database."""
        work = partial(classify_pair, within=self._request.within, contact=self._request.contact)
        waiting: deque[Future[PairResult] | None] = deque()
        pool = ThreadPoolExecutor(THREADS, "clashes")
        try:
            for one in placed:
                if time.monotonic() > self._request.until:
                    break
                # read here: a store belongs to the thread that opened it
                a, b = self._shapes.shape(one.one), self._shapes.shape(one.other)
                waiting.append(pool.submit(work, a, b, one.pose) if a and b else None)
                # results in order of submission, from a bounded queue:
                # shapes in flight stay in memory
                if len(waiting) > IN_FLIGHT:
                    yield first.result() if (first := waiting.popleft()) else None
            while waiting:
                yield first.result() if (first := waiting.popleft()) else None
        finally:
            # an interrupt must not wait for pairs that have not begun
            pool.shutdown(cancel_futures=True)

    def _write(self, gone: Sequence[tuple[int, int]] = (), mark: Mark | None = None) -> None:
        """Write the rows that wait, and the mark of a table with all pairs, if this user may."""
        is_new = mark is not None and self._mark not in {mark, None}
        if self._is_kept and (self._waiting or gone or is_new):
            try:
                self._mark = self._store.put_pairs(self._waiting, gone, self._mark, mark)
            except ReadOnlyError:
                self._is_kept = False
        self._waiting = []
        self._wrote = time.monotonic()

    def _clashes(
        self,
        shown: dict[tuple[int, int], PairRow],
        measured_keys: set[tuple[int, int]],
        left: Sequence[tuple[int, int]],
    ) -> Iterator[Clash]:
        """Clashes: present ones, gone ones since the last call, and unmeasured ones."""
        waiting = set(left)
        for key, row in shown.items():
            status: Status = row.status
            if key not in measured_keys:
                if row.kind == Kind.FAR or key in waiting:
                    continue
                status = "gone"
            elif row.kind == Kind.FAR and status != "gone":
                continue
            yield clash_of(row, status, self._known)
        for a, b in left:
            names = self._known[a][0], self._known[b][0]
            yield Clash(a, b, *names, Kind.NOT_KNOWN, 0.0, None, None, "not looked at")

    def _settle(
        self,
        shown: dict[tuple[int, int], PairRow],
        measured_keys: set[tuple[int, int]],
        mark: Mark | None,
    ) -> None:
        """Write statuses for the next call: a new pair is the same then."""
        self._waiting = [
            shown[key]._replace(status="same")
            for key in measured_keys
            if shown[key].status != "same"
        ]
        gone = []
        for key, row in shown.items():
            if key in measured_keys:
                continue
            # an acceptance outlives its pair: it counts again if the parts come back
            if accepted(row, self._known) is not None:
                self._waiting.append(row._replace(kind=Kind.FAR, status="same"))
            else:
                gone.append(key)
        self._write(gone, mark)


def _piece(
    there: EnvironmentAddress,
    budget: int,
    work: Callable[[Shapes, PlacedPair], PairResult | None],
    placed: Sequence[PlacedPair],
) -> list[PairResult | None]:
    """Judge pairs: the task of a worker."""
    with closing(there.open()) as store:
        shapes = Shapes(store, budget)
        return [work(shapes, one) for one in placed]


def _is_requested(a: int, b: int, of: set[int] | None, against: set[int] | None) -> bool:
    """Whether one object is of the first, and the other of the second; None is of all."""
    return any(
        (of is None or one in of) and (against is None or other in against)
        for one, other in ((a, b), (b, a))
    )


def _are_same(one: Object, other: Object) -> bool:
    """Whether equal shapes are at one place, to `ONE_PLACE`."""
    if one.digest != other.digest or (np.abs(one.bounds - other.bounds) > ONE_PLACE).any():
        return False
    change = other.transform @ np.linalg.pinv(one.transform) - np.eye(4)
    corners = np.array([*product(*one.bounds.T, (1.0,))])
    return bool(np.linalg.norm(corners @ change[:3].T, axis=1).max() <= ONE_PLACE)


def _compared(row: PairRow, old: PairRow | None) -> PairRow:
    """A row with its status, and the acceptance of the former one."""
    if old is None:
        return row._replace(status="same") if row.kind == Kind.FAR else row
    # an earlier call that came to no end has left what it would have told
    was_reported = (old.kind != Kind.FAR and old.status != "new") or old.status == "gone"
    status: Status
    if row.kind == Kind.FAR:
        status = "gone" if was_reported else "same"
    elif not was_reported:
        status = "new"
    else:
        status = "same" if old.status == "same" and is_same(row, old) else "changed"
    return row._replace(status=status, because=old.because, shapes=old.shapes)


def is_same(row: PairRow, old: PairRow, share: float = 0.0) -> bool:
    """Whether kinds are the same, and lengths to `SAME` or a share of them."""
    if row.kind != old.kind or (row.at_most is None) != (old.at_most is None):
        return False
    lengths = (row.at_least, old.at_least), (row.at_most or 0.0, old.at_most or 0.0)
    return all(abs(x - y) <= SAME + share * max(x, y) for x, y in lengths)
