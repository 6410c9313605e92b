"""`objects_at` returns the objects that were written into a voxel."""

from pathlib import Path

import numpy as np
import pytest

from hapticdb.grid import CurveName
from hapticdb.store.base import Layout
from hapticdb.store.objects_at import ids_of_voxels, pairs_of_voxels
from realtime.worlds import HIERARCHICAL, ids_by_voxel, make, scatter


@pytest.mark.parametrize("bits", [2, 5])
@pytest.mark.parametrize(("layout", "curve"), HIERARCHICAL)
def test_ids_are_those_of_the_voxels(
    tmp_path: Path, layout: Layout, curve: CurveName, bits: int
) -> None:
    """For voxels of several objects, for free voxels, and with some objects left out."""
    env = make(tmp_path, bits, layout, curve)
    scatter(env, n_objects=4, n_voxels=4000)
    ids = ids_by_voxel(env)
    assert any(len(found) > 1 for found in ids.values())
    rng = np.random.default_rng(1)
    for exclude in ([], [2, 3]):
        ijk = np.unique(rng.integers(0, env.grid.side, (60, 3)), axis=0)
        order = np.argsort(env.grid.encode(ijk))
        ijk, keys = ijk[order], env.grid.encode(ijk)[order]
        left_out = np.array(exclude, dtype=np.int64)
        wanted = [
            (n, i)
            for n, (x, y, z) in enumerate(ijk.tolist())
            for i in sorted(ids.get((x, y, z), []))
            if i not in exclude
        ]
        pairs = pairs_of_voxels(env.store, keys, left_out)
        assert [(n, i) for n, i in pairs.tolist()] == wanted
        found = ids_of_voxels(env.store, keys, left_out).tolist()
        assert found == sorted({i for _, i in wanted})


def test_no_voxels_have_no_objects(tmp_path: Path) -> None:
    env = make(tmp_path)
    none = np.empty(0, dtype=np.int64)
    assert not len(ids_of_voxels(env.store, none, none))
