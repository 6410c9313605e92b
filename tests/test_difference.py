"""`diff_environments` finds every difference between two environments, and nothing else."""

from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import hapticdb
from assemblies import PAIRS, Kind, box, make, placement, small_grid, voxel_set
from hapticdb import Environment, Grid, diff_environments, difference
from hapticdb.difference import farthest_corner, moved_by
from hapticdb.grid import CurveName
from hapticdb.ingest.layout import rows_of_voxels
from hapticdb.mesh import Part
from hapticdb.mesh.surface_packing import pack
from hapticdb.store.base import Band
from voxels import blob, voxel_object, with_distances

PLACE = (12, 12, 12)


def write(env: Environment, ijk: NDArray[np.int64], name: str, **fields: object) -> int:
    """Add an object with the given voxels; the digest of its geometry is always "same"."""
    record = replace(voxel_object(env.grid, ijk, name), digest="same")
    rows = rows_of_voxels(ijk, env.grid, env.layout)
    return env.store.add(replace(record, **fields), rows)  # type: ignore[arg-type]


@pytest.mark.parametrize("rows_at_once", [1, 1 << 14])
@pytest.mark.parametrize(("kind", "other"), PAIRS, ids=str)
def test_diff_rows_equal_voxel_sets(
    monkeypatch: pytest.MonkeyPatch, kind: Kind, other: Kind, rows_at_once: int
) -> None:
    """On every layout and curve, in one batch and in many; another object shares voxels."""
    monkeypatch.setattr(difference, "ROWS_AT_ONCE", rows_at_once)

    @settings(max_examples=3, deadline=None)
    @given(
        bits=st.integers(1, 7),
        seed=st.integers(0, 2**32 - 1),
        n_more=st.sampled_from([(0, 0), (1, 0), (1, 1)]),
    )
    def compared(bits: int, seed: int, n_more: tuple[int, int]) -> None:
        rng = np.random.default_rng(seed)
        every = np.unique(rng.integers(0, 1 << bits, (80, 3)), axis=0)
        chosen = [every[: len(every) - n] for n in n_more]
        with TemporaryDirectory() as folder:
            urls = Path(folder) / "a.db", Path(folder) / "b.db"
            for url, ijk, of_kind in zip(urls, chosen, (kind, other), strict=True):
                with make(url, of_kind, bits) as env:
                    write(env, every, "beside")
                    write(env, ijk, "one", bounds=np.zeros((2, 3)))
            found = diff_environments(*urls)
        in_a, in_b = map(voxel_set, chosen)
        assert found.is_equal == (in_a == in_b)
        assert [(a.id, b.id) for a, b in found.voxels] == ([] if in_a == in_b else [(2, 2)])
        assert found.compared == 2

    compared()


@pytest.mark.parametrize("kind", [("brick", "z"), ("voxel", "hilbert")], ids=str)
def test_diff_kinds_of_difference(tmp_path: Path, kind: Kind) -> None:
    ijk = blob(1, PLACE)
    changed: dict[str, dict[str, object]] = {
        "surfaces": {"digest": "other"},
        "moved": {"transform": placement(1, 0, 0)},
        "attributes": {"attributes": {"paint": "green"}},
        "boxes": {"bounds": np.zeros((2, 3))},
        "renumbered": {"id": 60},
    }
    with make(tmp_path / "a.db") as env:
        for name in ("same", "gone", *changed):
            write(env, ijk, name)
    with make(tmp_path / "b.db", kind) as env:
        write(env, ijk, "same", id=1)
        for n, (name, fields) in enumerate(changed.items(), start=3):
            write(env, ijk, name, **({"id": n} | fields))
        write(env, ijk, "same", id=62, link="of another file")
    found = diff_environments(tmp_path / "a.db", tmp_path / "b.db")
    assert [obj.name for obj in found.only_in_a] == ["gone"]
    assert [obj.link for obj in found.only_in_b] == ["of another file"]
    for name in changed:
        assert [pair[0].name for pair in getattr(found, name)] == [name]
    assert (found.voxels, found.compared, found.n_voxels) == ((), 4, 4 * len(ijk))
    assert not found.is_equal
    ((a, b),) = found.moved
    assert moved_by(a, b).tolist() == [0.0, 0.0, 0.0]


@pytest.mark.parametrize("kept", ["other", "gone"])
def test_diff_altered_surface_same_digest(tmp_path: Path, kept: str) -> None:
    vertices, faces = box((0, 0, 0), (0.05, 0.05, 0.05))
    part = Part("box", vertices, faces, np.eye(4))
    other = pack(2.0 * vertices, faces) if kept == "other" else None
    record = replace(voxel_object(small_grid(), blob(1, PLACE)), digest=part.digest)
    for name, surface in (("a", pack(vertices, faces)), ("b", other)):
        with make(tmp_path / f"{name}.db") as env:
            env.store.add(record, rows_of_voxels(blob(1, PLACE), env.grid, env.layout), surface)
    found = diff_environments(tmp_path / "a.db", tmp_path / "b.db")
    assert [pair[0].digest for pair in found.surfaces] == [part.digest]
    assert not found.is_equal


def test_diff_ids_alone_equal(tmp_path: Path) -> None:
    for n, name in enumerate(("a", "b"), start=1):
        with make(tmp_path / f"{name}.db") as env:
            write(env, blob(1, PLACE), "part", id=n)
    found = diff_environments(tmp_path / "a.db", tmp_path / "b.db")
    assert found.is_equal
    assert len(found.renumbered) == 1


def test_diff_distance_moved(tmp_path: Path) -> None:
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
    assert found.voxels == found.boxes == ()


@pytest.mark.parametrize("rows_at_once", [1, 1 << 14])
@pytest.mark.parametrize("curve", ["z", "hilbert"])
def test_diff_distances_on_both_sides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, curve: CurveName, rows_at_once: int
) -> None:
    """On any curve. Objects that have them on one side alone do not differ."""
    monkeypatch.setattr(difference, "ROWS_AT_ONCE", rows_at_once)
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
    assert len(found["b"].distances) == 1
    assert not found["b"].is_equal
    assert (found["c"].with_distances, found["c"].distances) == ((1, 0), ())
    assert found["c"].is_equal
    assert len(fewer) < len(rows)
    assert len(found["d"].distances) == 1
