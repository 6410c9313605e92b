"""Checks the table of pairs against the surfaces."""

import re
from collections.abc import Iterator, Mapping, Sequence
from itertools import groupby
from typing import NamedTuple

import numpy as np

from hapticdb.clashes.search import BUDGET, PairQuery, PairSearch, is_same
from hapticdb.store.base import Object, Store
from hapticdb.store.pairs import PairRow
from hapticdb.verdicts import Kind

NUMBER = r"(inf|\d+(?:\.\d+)?(?:e[-+]?\d+)?)"
SETTING = re.compile(rf"within {NUMBER} contact {NUMBER} by motions, holes")
"""`PairQuery.setting`, read back."""
SHARE = 1e-4
"""Tolerance of a length on another machine, a share."""
NEAR = 1e-6
"""Tolerance of places, metres."""


class PairFault(NamedTuple):
    """A fault, and the row; None of a missing one."""

    text: str
    row: PairRow | None


def pair_faults(store: Store, objects: Mapping[int, Object]) -> Iterator[PairFault]:
    """Foreign rows of the table `pair`, and missing ones.

    Each row valid for `find_clashes` is judged again, with its own setting. After a search of
    everything there is a row for each pair of near boxes.
    """
    kept, revision = store.pairs(), store.revision()
    known = {change.id for change in store.changes()} if kept.rows else set()
    digests = store.surface_digests()
    bare = {obj.id for obj in objects.values() if obj.digest not in digests}
    believed: list[PairRow] = []
    for row in kept:
        if text := _misfit(row, known, bare, revision):
            yield PairFault(f"pair {row.a}, {row.b}: {text}", row)
        elif row.revision >= _written((row.a, row.b), objects):
            believed.append(row)
    believed.sort(key=lambda row: row.setting)
    for setting, rows in groupby(believed, key=lambda row: row.setting):
        search = _search(store, setting)
        yield from _measured_again(search, list(rows), objects, revision)
    setting, since = kept.mark
    if not SETTING.fullmatch(setting):
        return
    if since > revision or not kept.fit(setting):
        yield PairFault("pairs are not as many as their last search has left", None)
    there = {(row.a, row.b) for row in kept}
    near = _search(store, setting).near(store.outlines(), None, None)
    for (a, b), newest in near.items():
        if newest <= since and (a, b) not in there:
            yield PairFault(f"pair {a}, {b} has no row, and their boxes are near", None)


def _search(store: Store, setting: str) -> PairSearch:
    found = SETTING.fullmatch(setting)
    assert found is not None  # noqa: S101 - `_misfit` has refused others
    within, contact = map(float, found.groups())
    return PairSearch(store, PairQuery(within, contact, (), (), np.inf, BUDGET, None))


def _written(pair: tuple[int, int], objects: Mapping[int, Object]) -> float:
    """Later revision of two objects; infinite if one is gone, as its row may be until a search."""
    return max(objects[i].revision if i in objects else np.inf for i in pair)


def _misfit(row: PairRow, known: set[int], bare: set[int], revision: int) -> str | None:
    """Contradiction of a row, without its surfaces; None if none.

    known : ids of all objects ever; bare : of those without a surface.
    """
    if not {row.a, row.b} <= known:
        return "there was never such an object"
    if bare & {row.a, row.b}:
        return "one of the two has no surface"
    if row.revision > revision:
        return f"it is of revision {row.revision}, the environment of {revision}"
    if not SETTING.fullmatch(row.setting):
        return "its setting is that of no search"
    if (row.because is None) != (row.shapes is None):
        return "it is accepted without a reason, or without shapes"
    return None


def _measured_again(
    search: PairSearch, rows: Sequence[PairRow], objects: Mapping[int, Object], revision: int
) -> Iterator[PairFault]:
    old = {(row.a, row.b): row for row in rows}
    pairs = [(objects[row.a], objects[row.b]) for row in rows]
    for row in search.measured(pairs, {}, revision):
        kept = old[row.a, row.b]
        if not is_same(row, kept, SHARE):
            yield PairFault(
                f"pair {row.a}, {row.b}: it is {kept.kind} by {kept.at_least:.6g} m, and measured "
                f"again {row.kind} by {row.at_least:.6g} m",
                kept,
            )
        elif kept.kind != Kind.FAR and not _is_there(kept, objects):
            yield PairFault(f"pair {row.a}, {row.b}: its place is not where the two meet", kept)


def _is_there(row: PairRow, objects: Mapping[int, Object]) -> bool:
    """Whether the places are in the boxes of both, and as far apart as the surfaces."""
    places = np.array(row.place).reshape(2, 3)
    boxes = np.array([objects[i].bounds for i in (row.a, row.b)])
    slack = NEAR + SHARE * float(np.ptp(boxes, axis=1).max())
    is_in = (places >= boxes[:, 0] - slack) & (places <= boxes[:, 1] + slack)
    apart = float(np.linalg.norm(places[1] - places[0]))
    least, most = (
        (0.0, 0.0) if row.kind == Kind.OVERLAPPING else (row.at_least, row.at_most or np.inf)
    )
    return (
        bool(is_in.all()) and least - NEAR <= apart * (1.0 + SHARE) <= most + NEAR + SHARE * apart
    )
