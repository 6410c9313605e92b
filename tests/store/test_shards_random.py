"""Writers, sweeps and readers at random: every read is of one published revision.

Writers note what each revision changed. Readers note what they read at which revision. All is
compared at the end, so no thread waits for another.
"""

import contextlib
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing

import numpy as np
import pytest

from children import PATIENCE
from hapticdb import BusyError, OutdatedError
from hapticdb.store.postgres.shards.store import ShardedStore
from hapticdb.testing.scenes import EVERYWHERE
from labelled import (
    GRID,
    N_KEYS,
    Labels,
    contents_of,
    labelled_object,
    labelled_rows,
    labels_of,
)
from servers import Place

N_WRITERS, N_READERS, N_OBJECTS = 2, 3, 4
Edits = dict[int, tuple[int, int]]
"""Object and label that each revision wrote; label 0 for a removal."""
Places = set[tuple[int, int, int]]
Seen = list[tuple[int, Places]]
"""Revision of a read, and key, object and label of each row that it found."""


def write(url: str, number: int, n_edits: int, seed: int) -> Edits:
    """Edit the objects of one writer at random; returns what each revision wrote."""
    rng = np.random.default_rng([seed, number])
    found: Edits = {}
    ids = np.arange(1 + number * N_OBJECTS, 1 + (number + 1) * N_OBJECTS)
    there: dict[int, int] = {}
    with closing(ShardedStore.open(url)) as store:
        for n in range(n_edits):
            object_id, label = int(rng.choice(ids)), 1 + n * N_WRITERS + number
            record, rows = labelled_object(label, object_id), labelled_rows(label)
            before = store.revision()
            if object_id not in there:
                assert store.add(record, rows) == object_id
            elif rng.random() < 0.2:
                store.remove(object_id, lambda _: [])
                label = 0
            else:
                store.replace(record, rows, lambda _: [])
            there[object_id] = label
            if not label:
                del there[object_id]
            (own,) = [c.revision for c in store.changes(before) if c.id == object_id]
            found[own] = object_id, label
    return found


def places_of(labels: Labels, lows: np.ndarray, highs: np.ndarray) -> Places:
    """Key, object and label of the rows of objects in closed ranges."""
    found: Places = set()
    for object_id, label in labels.items():
        keys = labelled_rows(label).keys
        at = np.searchsorted(lows, keys, "right") - 1
        inside = (at >= 0) & (keys <= highs[np.maximum(at, 0)])
        found |= {(key, object_id, label) for key in keys[inside].tolist()}
    return found


def read(url: str, seed: int, is_over: threading.Event) -> tuple[list[tuple[int, Labels]], Seen]:
    """Read all in snapshots, and random ranges outside of them, until the writers have ended."""
    rng = np.random.default_rng(seed)
    whole: list[tuple[int, Labels]] = []
    parts: Seen = []
    with closing(ShardedStore.open(url, read_only=True)) as store:
        while not is_over.is_set() or len(whole) < 3:
            with contextlib.suppress(OutdatedError), store.snapshot():
                before = store.revision()
                whole.append((before, contents_of(store)))
                assert labels_of(store.scan(*EVERYWHERE)) == whole[-1][1]
            ends = np.sort(rng.choice(N_KEYS, 12, replace=False)).astype(np.int64).reshape(-1, 2)
            lows, highs = np.ascontiguousarray(ends[:, 0]), np.ascontiguousarray(ends[:, 1])
            with contextlib.suppress(OutdatedError):
                rows = store.scan(lows, highs)
                labels = rows.occupancy.reshape(-1, 64)[:, :8].copy().view(np.int64).reshape(-1)
                seen = zip(rows.keys.tolist(), rows.ids.tolist(), labels.tolist(), strict=True)
                parts.append((store.version(), set(seen)))
                parts.append((-1, {(int(a), int(b), 0) for a, b in ends}))
    return whole, parts


def sweep(url: str, is_over: threading.Event) -> int:
    """Sweep all shards again and again; returns how many versions were swept."""
    n_swept = 0
    with closing(ShardedStore.open(url)) as store:
        while not is_over.is_set():
            with contextlib.suppress(BusyError):
                n_swept += store.sweep().versions
            is_over.wait(0.05)
    return n_swept


def published(edits: Edits) -> dict[int, Labels]:
    """Labels of all objects at each revision."""
    found: dict[int, Labels] = {0: {}}
    for revision in sorted(edits):
        object_id, label = edits[revision]
        now = {i: n for i, n in found[revision - 1].items() if i != object_id}
        found[revision] = {**now, object_id: label} if label else now
    return found


def check_parts(parts: Seen, known: dict[int, Labels]) -> None:
    """Assert that each read of ranges found the rows of its revision."""
    for (revision, found), (_, ends) in zip(parts[::2], parts[1::2], strict=True):
        ranges = np.array(sorted(ends), dtype=np.int64)
        assert found == places_of(known[revision], ranges[:, 0], ranges[:, 1])


def run(url: str, seed: int, n_edits: int, also: Callable[[threading.Event], object]) -> None:
    """Let all go on beside one another, then compare what was read with what was published."""
    is_over = threading.Event()
    with ThreadPoolExecutor(N_WRITERS + N_READERS + 1) as pool:
        readers = [pool.submit(read, url, 100 * seed + n, is_over) for n in range(N_READERS)]
        other = pool.submit(also, is_over)
        writers = [pool.submit(write, url, n, n_edits, seed) for n in range(N_WRITERS)]
        try:
            edits = {r: e for writer in writers for r, e in writer.result(PATIENCE).items()}
        finally:
            is_over.set()
        seen = [reader.result(PATIENCE) for reader in readers]
        other.result(PATIENCE)
    known = published(edits)
    assert len(known) == N_WRITERS * n_edits + 1
    for whole, parts in seen:
        assert whole
        for revision, labels in whole:
            assert labels == known[revision]
        check_parts(parts, known)
    with closing(ShardedStore.open(url)) as store:
        assert contents_of(store) == known[max(known)]


@pytest.fixture
def url(sharded_place: Place) -> str:
    where = sharded_place()
    ShardedStore.create(where, GRID, "brick", distances=True).close()
    return where


def test_each_read_is_of_one_published_revision(url: str) -> None:
    run(url, 1, 20, lambda is_over: sweep(url, is_over))


@pytest.mark.long
@pytest.mark.parametrize("seed", range(2, 6))
def test_each_read_of_many_is_of_one_published_revision(url: str, seed: int) -> None:
    run(url, seed, 150, lambda is_over: sweep(url, is_over))
