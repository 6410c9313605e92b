"""Checks and contents of a valid environment, for tests that interrupt writers."""

from typing import Any

import numpy as np

import hapticdb
from assemblies import index_rows
from hapticdb import Environment

Contents = tuple[list[tuple[Any, ...]], list[tuple[Any, ...]], set[tuple[int, int, bytes]]]


def assert_valid(env: Environment) -> None:
    """Assert that objects have their recorded rows and surfaces and no others, with a whole log."""
    with env.store.snapshot():
        objects = env.objects()
        rows = env.store.scan(np.array([0]), np.array([2**62]))
        changes = list(env.store.changes())
        revision = env.store.revision()
        surfaces = env.store.surface_digests()
    if env.layout == "brick":
        bits = np.unpackbits(rows.occupancy.reshape(-1, 64), axis=1).sum(axis=1)
    else:
        bits = np.ones(len(rows), dtype=np.int64)
    counted = np.zeros(max([0, *rows.ids.tolist(), *(obj.id for obj in objects)]) + 1, np.int64)
    np.add.at(counted, rows.ids, bits)
    assert {i: n for i, n in enumerate(counted.tolist()) if n} == {
        obj.id: obj.voxels for obj in objects
    }
    assert surfaces == {obj.digest for obj in objects if len(obj.digest) == 64}  # of files
    assert [change.revision for change in changes] == list(range(1, revision + 1))
    last = {change.id: change for change in changes}
    assert {i for i, change in last.items() if change.action != "remove"} == {
        obj.id for obj in objects
    }
    assert all(last[obj.id].revision == obj.revision for obj in objects)


def contents(env: Environment) -> Contents:
    """Objects, log and index rows; equal for two environments with the same history."""
    objects = [
        (obj.id, obj.name, obj.digest, obj.transform.tolist(), obj.voxels, obj.revision)
        for obj in env.objects()
    ]
    log = [(c.revision, c.action, c.id, c.ranges.tolist()) for c in env.store.changes()]
    return objects, log, index_rows(env)


def valid_contents(url: str) -> Contents:
    with hapticdb.open(url) as env:
        assert_valid(env)
        return contents(env)
