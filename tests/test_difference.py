"""`diff_environments` reports every difference between two environments, and nothing else."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import hapticdb
from assemblies import PAIRS, Kind, make, placement, voxel_set
from hapticdb import Environment, Grid, diff_environments
from hapticdb.difference import farthest_corner, moved_by
from hapticdb.grid import CurveName
from hapticdb.ingest import geometry
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.store.base import Band
from hapticdb.testing import blob, voxel_object, with_distances

PLACE = (12, 12, 12)


def write(env: Environment, ijk: NDArray[np.int64], name: str, **fields: object) -> int:
    """Add an object with the given voxels; the digest of its geometry is always "same"."""
    record = replace(voxel_object(env.grid, ijk, name), digest="same")
    rows = rows_of_voxels(ijk, env.grid, env.layout)
    return env.store.add(replace(record, **fields), rows)  # type: ignore[arg-type]


@pytest.mark.parametrize("most_rows", [1, 1 << 19])
@pytest.mark.parametrize(("kind", "other"), PAIRS, ids=str)
def test_every_voxel_that_differs_is_counted(
    monkeypatch: pytest.MonkeyPatch, kind: Kind, other: Kind, most_rows: int
) -> None:
    """Counts equal those of Python sets, in one batch and in many; another object shares voxels."""
    monkeypatch.setattr(geometry, "MOST_ROWS", most_rows)

    @settings(max_examples=3, deadline=None)
    @given(bits=st.integers(1, 7), seed=st.integers(0, 2**32 - 1), share=st.floats(0, 1))
    def counted(bits: int, seed: int, share: float) -> None:
        rng = np.random.default_rng(seed)
        every = np.unique(rng.integers(0, 1 << bits, (80, 3)), axis=0)
        chosen = [every[:1], every[:1]]
        for n in range(2):
            chosen[n] = np.concatenate([every[:1], every[1:][rng.random(len(every) - 1) < share]])
        with TemporaryDirectory() as folder:
            urls = Path(folder) / "a.db", Path(folder) / "b.db"
            for url, ijk, of_kind in zip(urls, chosen, (kind, other), strict=True):
                with make(url, of_kind, bits) as env:
                    write(env, every, "beside")
                    write(env, ijk, "one")
            found = diff_environments(*urls)
        in_a, in_b = map(voxel_set, chosen)
        assert found.is_equal == (in_a == in_b)
        assert [(v.a.id, v.only_in_a, v.only_in_b) for v in found.voxels] == (
            [] if in_a == in_b else [(2, len(in_a - in_b), len(in_b - in_a))]
        )
        assert [v.shared for v in found.voxels] == ([] if in_a == in_b else [len(in_a & in_b)])
        assert found.totals == (
            len(in_a - in_b),
            len(in_b - in_a),
            len(every) + len(in_a & in_b),
            int(in_a != in_b),
        )
        assert found.compared == 2

    counted()


def test_parts_are_told_apart_by_what_differs(tmp_path: Path) -> None:
    ijk = blob(1, PLACE)
    with make(tmp_path / "a.db") as env:
        for name in ("same", "gone", "changed", "moved", "described", "renumbered"):
            write(env, ijk, name)
    with make(tmp_path / "b.db", ("voxel", "hilbert")) as env:
        write(env, ijk, "same", id=1)
        write(env, ijk, "changed", id=3, digest="other", transform=placement(1, 0, 0))
        write(env, ijk, "moved", id=4, transform=placement(1, 0, 0))
        write(env, ijk, "described", id=5, attributes={"paint": "green"})
        write(env, ijk, "renumbered", id=60)
        write(env, ijk, "new", id=61)
        write(env, ijk, "same", id=62, link="of another file")
    found = diff_environments(tmp_path / "a.db", tmp_path / "b.db")
    assert [obj.name for obj in found.only_in_a] == ["gone"]
    assert [obj.name for obj in found.only_in_b] == ["new", "same"]
    for word in ("changed", "moved", "described", "renumbered"):
        assert [pair[0].name for pair in getattr(found, word)] == [word]
    assert (found.voxels, found.compared) == ((), 3)
    assert not found.is_equal
    assert found.n_voxels == 3 * len(ijk)
    assert [(one.a.name, one.only_in_a, one.shared) for one in found.elsewhere] == [
        ("changed", 0, len(ijk)),
        ("moved", 0, len(ijk)),
    ]
    assert found.totals == (len(ijk), 2 * len(ijk), 5 * len(ijk), 5)


def test_ids_and_attributes_are_felt_by_nobody(tmp_path: Path) -> None:
    """The difference is reported, and the environments still count as equal."""
    ijk = blob(1, PLACE)
    for n, name in enumerate(("a", "b"), start=1):
        with make(tmp_path / f"{name}.db") as env:
            write(env, ijk, "part", id=n, attributes={"n": n})
    found = diff_environments(tmp_path / "a.db", tmp_path / "b.db")
    assert found.is_equal
    assert len(found.renumbered) == len(found.described) == 1


def test_how_far_a_part_has_moved_is_told(tmp_path: Path) -> None:
    """The way of its bounding box in metres, and the voxels that only one environment has."""
    ijk = blob(1, PLACE)
    shift = np.array([3, 0, -2])
    for name, voxels, transform in (
        ("a", ijk, placement(0, 0, 0)),
        ("b", ijk + shift, placement(0.03, 0, -0.02)),
    ):
        with make(tmp_path / f"{name}.db") as env:
            write(env, voxels, "part", transform=transform)
    found = diff_environments(tmp_path / "a.db", tmp_path / "b.db")
    ((a, b),) = found.moved
    np.testing.assert_allclose(moved_by(a, b), 0.01 * shift, atol=1e-12)
    assert farthest_corner(a, b) == pytest.approx(0.01 * 13**0.5)
    (one,) = found.elsewhere
    here, there = voxel_set(ijk), voxel_set(ijk + shift)
    assert one[2:] == (len(here - there), len(there - here), len(here & there))
    assert one.share == pytest.approx(len(here & there) / len(here | there))
    assert found.voxels == ()


@pytest.mark.parametrize("most_rows", [1, 1 << 19])
@pytest.mark.parametrize("curve", ["z", "hilbert"])
def test_distances_are_compared_where_both_have_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, curve: CurveName, most_rows: int
) -> None:
    """On any curve. Objects that have them on one side alone do not differ."""
    monkeypatch.setattr(geometry, "MOST_ROWS", most_rows)
    ijk = blob(3, PLACE)
    rows = with_distances(ijk, Grid(0.01, (-0.1, 0.2, -0.3), 5), "brick", seed=1)
    assert rows.distances is not None
    data = rows.distances.data.copy()
    data[0] ^= 1
    data[-1] ^= 1
    other = rows.having(Band(data, rows.distances.ends))
    fewer = rows.picked(np.flatnonzero(rows.occupied().keys[0] <= rows.keys))
    found = {}
    for name, some in {"a": rows, "b": other, "c": rows.occupied(), "d": fewer}.items():
        with make(tmp_path / f"{name}.db") as env:
            env.store.add(voxel_object(env.grid, ijk), some)
        target = tmp_path / f"{name}-{curve}.db"
        grid = Grid(0.01, (-0.1, 0.2, -0.3), 5, curve)
        hapticdb.create(target, grid, distances=True).close()
        hapticdb.copy_environment(tmp_path / f"{name}.db", target)
        found[name] = diff_environments(tmp_path / "a.db", target)
        assert found[name].voxels == ()
    assert found["a"].is_equal
    assert (found["a"].with_distances, found["a"].distances) == ((1, 1), ())
    assert [one.n_rows for one in found["b"].distances] == [2]
    assert not found["b"].is_equal
    assert (found["c"].with_distances, found["c"].distances) == ((1, 0), ())
    assert found["c"].is_equal
    assert len(fewer) < len(rows)
    assert [one.n_rows for one in found["d"].distances] == [len(rows) - len(fewer)]
