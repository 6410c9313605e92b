"""Disassembly: a sequence of removals, each on a proved path, so that parts come out.

An object is removed after a sweep has proved its path among the objects still in place. Steps
without use for later ones are dropped at the end. The sequence need not be the shortest.
"""

import math
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

from hapticdb.cluster.environment_address import EnvironmentAddress
from hapticdb.cluster.scheduler import Cluster, connected
from hapticdb.environment import Environment
from hapticdb.errors import MissingExtraError, UsageError
from hapticdb.exact.separation import CONTACT
from hapticdb.exact.sweep import sweep
from hapticdb.extraction.extraction_results import Blocker, Extraction, ids_of
from hapticdb.extraction.removal_search import DEFAULT_MOTIONS, extract
from hapticdb.resident.table import DEFAULT_BUDGET
from hapticdb.store.base import Object, Progress
from hapticdb.store.finding import Words
from hapticdb.verdicts import PathVerdict

DEFAULT_ORDER_SECONDS = 600.0
"""Default time of the search for a sequence."""
DEFAULT_DEPTH = 3
"""Default length of the longest chain of objects, each of them blocking the one before."""
MOST_BLOCKERS = 12
"""Objects tried in the way of one part, at most. Larger: more sequences, and a slower failure."""
LEAST = 0.1
"""Seconds of a search after the deadline: enough for one pull."""
SHARE = 0.25
"""Greatest share of the whole time for one search. Larger: fewer searches, each more thorough."""


class Removal(NamedTuple):
    """A step: parts removed together.

    found : the search with its proved path; excluded : ids of the objects absent in this step: the
    parts, the caller's exclusions, and the objects of earlier steps.
    """

    found: Extraction
    excluded: tuple[int, ...]

    @property
    def ids(self) -> tuple[int, ...]:
        """Ids of the removed parts."""
        return ids_of(self.found.parts)


class FailedSearch(NamedTuple):
    """A search without a proved path.

    parts : to be removed; n_gone : number of steps before it; verdict : of the search, or None for
    parts that cannot be moved at all; blockers : objects that stop pulls, most pulls first;
    reason : why the parts cannot be moved, else empty.
    """

    parts: tuple[Object, ...]
    n_gone: int
    verdict: PathVerdict | None
    blockers: tuple[Blocker, ...]
    reason: str = ""


@dataclass(frozen=True, eq=False)
class Disassembly:
    """Result of the search for a sequence of removals.

    Each step is proved. The sequence may be longer than necessary.

    Attributes
    ----------
    parts : tuple of Object
        The parts to be removed, as one rigid body.
    steps : tuple of Removal
        In the order of removal. After success, the last step removes `parts`; otherwise the steps
        were in vain.
    failed : tuple of FailedSearch
        Searches without a proved path, in their order.
    is_out_of_time : bool
        Whether the deadline ended the search.
    seconds : float
        Time of all searches with their proofs.
    seed : int
    """

    parts: tuple[Object, ...]
    steps: tuple[Removal, ...]
    failed: tuple[FailedSearch, ...]
    is_out_of_time: bool
    seconds: float
    seed: int

    @property
    def is_found(self) -> bool:
        """Whether the last step removes the parts."""
        return bool(self.steps) and self.steps[-1].ids == ids_of(self.parts)

    @property
    def verdict(self) -> PathVerdict:
        """Comes out, or overlaps if a step begins with one; otherwise no order, or not decided.

        "no order found" proves nothing.
        """
        if not self.is_found:
            return PathVerdict.NOT_DECIDED if self.is_out_of_time else PathVerdict.NO_ORDER
        overlaps = any(step.found.verdict is PathVerdict.OVERLAPS for step in self.steps)
        return PathVerdict.OVERLAPS if overlaps else PathVerdict.COMES_OUT

    @property
    def blockers(self) -> tuple[Blocker, ...]:
        """Objects in the way of the parts in their last failed search, most stopped pulls first."""
        for failed in reversed(self.failed):
            if ids_of(failed.parts) == ids_of(self.parts):
                return failed.blockers
        return ()


def disassemble(
    env: Environment,
    *words: int | str,
    where: Words = (),
    exclude: Words = (),
    out: float | None = None,
    screw: float | None = None,
    contact: float = CONTACT,
    overlap: float = 0.0,
    seconds: float = DEFAULT_ORDER_SECONDS,
    seed: int = 0,
    motions: int = DEFAULT_MOTIONS,
    depth: int = DEFAULT_DEPTH,
    keep: Words = (),
    budget_bytes: int = DEFAULT_BUDGET,
    progress: Progress | None = None,
    on: str | None = None,
) -> Disassembly:
    """Search for a sequence of removals after which parts come out.

    Without a proved removal path of the parts, the objects in their way are tried, most stopped
    pulls first, then the objects in the way of these. Each object is removed alone, on a path
    proved as in `extract`. Then the parts are tried again.

    Parameters
    ----------
    env, words, where, exclude, out, screw, contact, overlap, seed, budget_bytes, progress
        As for `extract`.
    seconds : float
        Time of all searches together; one search has a quarter of it at most.
    motions : int
        Motion queries of one search, as for `extract`; objects in the way have none at first.
    depth : int
        Length of the longest chain of objects in the way of one another; 0: as `extract`.
    keep : iterable of int or str
        Objects that collide but are never removed, such as a base plate.
    on : str or None
        Scheduler of dask.distributed, ``tcp://host:8786``. Its workers search for all next
        candidates in parallel; `progress` then gets the numbers of searches: done, and in all.

    Raises
    ------
    ObjectNotFoundError, UsageError
        For the parts, as for `extract`. Other objects without their files are not removed.
    MissingExtraError
        If straight pulls give no sequence, and the planner is not installed.
    """
    began = time.monotonic()
    if not (math.isfinite(seconds) and seconds > 0.0) or depth < 0:
        raise UsageError(f"{seconds} seconds, depth {depth}: give more than 0, and 0 or more")
    parts = tuple(env.find(*words))
    stays = {*ids_of(parts), *ids_of(env.select(where, exclude))}
    excluded = tuple(obj.id for obj in env.objects() if obj.id not in stays)
    kept = frozenset(ids_of(env.find(*keep)) if keep else ())
    options = {"out": out, "screw": screw, "contact": contact, "overlap": overlap, "seed": seed,
               "budget_bytes": budget_bytes, "progress": progress}  # fmt: skip
    request = _Request(parts, excluded, kept, seconds, motions, options)
    with connected(on) as workers:
        found = _ordered(env, request, depth, workers)
    return replace(found, seconds=time.monotonic() - began)


def _ordered(
    env: Environment, request: "_Request", depth: int, workers: Cluster | None
) -> Disassembly:
    """Search by straight pulls of the objects in the way, then with the planner; `seconds` is 0."""
    search = _OrderSearch(env, request, time.monotonic() + request.seconds, workers)
    is_found = False
    # all by straight pulls first, without the planner; equal numbers run once
    for motions in dict.fromkeys((0, request.motions)):
        search.motions_of_others = motions
        is_found = search.clear(request.parts, depth, frozenset())
        if is_found:
            search.drop_unneeded()
            break
    if not is_found and search.missing is not None:
        raise search.missing
    return Disassembly(
        request.parts, tuple(search.steps), tuple(search.failed),
        not is_found and search.is_spent, 0.0, request.options["seed"],
    )  # fmt: skip


class _Request(NamedTuple):
    """Options of all searches.

    parts : to be removed in the end; exclude : ids of the caller's exclusions but for `parts`,
    which do block the objects removed before them; keep : ids of objects never removed; options :
    of `extract`, the same for each search.
    """

    parts: tuple[Object, ...]
    exclude: tuple[int, ...]
    keep: frozenset[int]
    seconds: float
    motions: int
    options: dict[str, Any]


def _search_there(
    there: EnvironmentAddress, ids: tuple[int, ...], options: dict[str, Any]
) -> Extraction:
    """Search for a removal path: the task of a worker."""
    with Environment(there.open()) as env:
        return extract(env, *ids, **options)


class _Known(NamedTuple):
    """A failed search: steps before it, planner's motions, ids of objects its pulls depend on."""

    n_gone: int
    motions: int
    obstacles: frozenset[int]
    failed: FailedSearch


class _OrderSearch:
    """State of one search for a sequence.

    steps : removals so far; failed : searches without a proved path; motions_of_others : motion
    queries of the planner for objects in the way; missing : error of a missing planner (straight
    pulls only from then on); is_spent : whether the deadline prevented a search.
    """

    def __init__(
        self, env: Environment, request: _Request, until: float, workers: Cluster | None
    ) -> None:
        self.steps: list[Removal] = []
        self.failed: list[FailedSearch] = []
        self.motions_of_others = 0
        self.missing: MissingExtraError | None = None
        self.is_spent = False
        self._env, self._request, self._until = env, request, until
        self._known: dict[tuple[int, ...], _Known] = {}
        self._workers = workers
        self._ahead: dict[tuple[object, ...], Any] = {}
        self._n_searched = 0

    def clear(self, parts: tuple[Object, ...], depth: int, waiting: frozenset[int]) -> bool:
        """Remove parts, if necessary after the objects in their way; return success.

        depth : length of the chains of other objects that may go first; waiting : ids of the
        objects to be removed after these parts, not tried again.
        """
        waiting |= {*ids_of(parts)}
        while True:
            failed = self._take_off(parts)
            if failed is None:
                return True
            if not self._clear_one_of(failed, depth, waiting):
                return False

    def _clear_one_of(self, failed: FailedSearch, depth: int, waiting: frozenset[int]) -> bool:
        """Remove one object in the way, shorter chains first."""
        before = len(self.steps)
        # iterative deepening: a short chain is found before a long one is tried
        for less in range(depth):
            if self._workers is not None and less == 0:
                self._search_ahead(self._workers, failed, waiting)
            for obj in self._candidates(failed, waiting):
                self.clear((obj,), less, waiting)
                # any removal may have freed the parts, so they are tried before the next object
                if len(self.steps) > before:
                    return True
        return False

    def _search_ahead(
        self, workers: Cluster, failed: FailedSearch, waiting: frozenset[int]
    ) -> None:
        """Submit the searches for all objects in the way to the workers."""
        workers.cancel(self._ahead.values())  # they ran before the last removal
        motions = 0 if self.missing is not None else self.motions_of_others
        wanted = [(obj.id,) for obj in self._candidates(failed, waiting)]
        self._ahead = {
            (ids, self._excluded(), motions): self._given(workers, ids, motions)
            for ids in wanted
            if ids not in self._known
        }

    def _candidates(self, failed: FailedSearch, waiting: frozenset[int]) -> Iterator[Object]:
        excluded = waiting | self._gone() | self._request.keep
        blockers = [one.object for one in failed.blockers if one.object.id not in excluded]
        for obj in blockers[:MOST_BLOCKERS]:
            # sticky: the verdict must say that time ended the search, whenever it is read
            self.is_spent |= time.monotonic() > self._until
            if self.is_spent:
                return
            yield obj

    def _gone(self) -> frozenset[int]:
        """Ids of the objects removed so far."""
        return frozenset(i for step in self.steps for i in step.ids)

    def _excluded(self) -> tuple[int, ...]:
        """Ids of all objects absent now."""
        return (*self._request.exclude, *sorted(self._gone()))

    def _take_off(self, parts: tuple[Object, ...]) -> FailedSearch | None:
        """Search for a removal path, and remove the parts on it; return the failure without one."""
        ids = ids_of(parts)
        is_wanted = ids == ids_of(self._request.parts)
        motions = self._request.motions if is_wanted else self.motions_of_others
        # memo of failures: the tree of chains meets the same object often
        known = self._known.get(ids)
        if known is not None and self._would_fail_again(known, motions):
            return known.failed
        n_gone, obstacles = len(self.steps), frozenset[int]()
        excluded = self._excluded()
        try:
            # of two bodies, each comes out of the other or neither does
            gone = {*excluded, *ids, *ids_of(self._request.parts)}
            if not is_wanted and all(obj.id in gone for obj in self._env.objects()):
                raise UsageError(  # noqa: TRY301 - as errors of the search
                    "it is the last object that stands beside what is to come out"
                )
            found = self._searched(ids, motions)
        except UsageError as error:
            if is_wanted:
                raise
            failed = FailedSearch(parts, n_gone, None, (), str(error))
        else:
            if found.is_free:
                self.steps.append(Removal(found, tuple(sorted({*ids, *excluded}))))
                return None
            failed = FailedSearch(parts, n_gone, found.verdict, found.blockers)
            # near ones count, too: a motion may depend on them without a hit
            obstacles |= {*ids_of([one.object for one in failed.blockers]), *ids_of(found.near)}
        # `n_gone` from before the search: only later steps can void the failure
        self._known[ids] = _Known(n_gone, motions, obstacles, failed)
        self.failed.append(failed)
        return failed

    def _would_fail_again(self, known: _Known, motions: int) -> bool:
        """Whether a search would fail again, after the removals since.

        A pull ends at the first object in its way. While all these objects stand, pulls end at the
        same hits. A plan may depend on any object.
        """
        if known.failed.verdict is None:
            return True
        # a larger budget of the planner may find what the smaller one missed
        if motions > known.motions:
            return False
        if motions:
            return known.n_gone == len(self.steps)
        return not any(known.obstacles & {*step.ids} for step in self.steps[known.n_gone :])

    def _searched(self, ids: tuple[int, ...], motions: int) -> Extraction:
        def search(motions: int) -> Extraction:
            if self._workers is None:
                return extract(self._env, *ids, **self._options(motions))
            # the key has all that a result depends on: a task of another state is never taken
            task = self._ahead.pop((ids, self._excluded(), motions), None)
            found: Extraction = self._workers.result(
                task or self._given(self._workers, ids, motions)
            )
            self._n_searched += 1
            if (progress := self._request.options["progress"]) is not None:
                progress(self._n_searched, self._n_searched + len(self._ahead))
            return found

        if self.missing is None:
            try:
                return search(motions)
            except MissingExtraError as error:
                self.missing = error
        return search(0)

    def _options(self, motions: int) -> dict[str, Any]:
        """Options of a search that begins now."""
        left = min(self._until - time.monotonic(), SHARE * self._request.seconds)
        now = {"exclude": self._excluded(), "seconds": max(left, LEAST), "motions": motions}
        return self._request.options | now

    def _given(self, workers: Cluster, ids: tuple[int, ...], motions: int) -> Any:  # noqa: ANN401 - dask's future
        """Submit a search to the workers."""
        there = EnvironmentAddress.of(self._env.store, self._env.address)
        options = self._options(motions) | {"progress": None}
        return workers.submit(partial(_search_there, there, ids, options))

    def drop_unneeded(self) -> None:
        """Drop steps without which all later ones are proved as well, from last to first."""
        # from the end: a late step is needed by few others, and dropping it voids no earlier proof
        for n in range(len(self.steps) - 2, -1, -1):
            if time.monotonic() > self._until:
                return
            kept = self._proved_with(n)
            if kept is not None:
                self.steps[n:] = kept

    def _proved_with(self, n: int) -> list[Removal] | None:
        """Steps after step n, proved again with its objects in place; None if one fails.

        The last step comes first, as the likeliest reason for step n.
        """
        proved: list[Removal] = []
        for step in reversed(self.steps[n + 1 :]):
            found, path = step.found, step.found.path
            assert path is not None  # noqa: S101 - steps are proved
            # the same path among more objects: only a new sweep proves it
            excluded = tuple(i for i in step.excluded if i not in self.steps[n].ids)
            left = max(self._until - time.monotonic(), LEAST)
            again = sweep(
                self._env, found.shell, path.poses, exclude=excluded, contact=path.swept.contact,
                overlap=path.swept.overlap, seated=True, seconds=left,
            )  # fmt: skip
            if not again.is_free:
                return None
            proved.append(Removal(replace(found, path=replace(path, swept=again)), excluded))
        return proved[::-1]
