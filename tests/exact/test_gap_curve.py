"""The gap as a curve, proved below and measured above on each interval; clouds with a radius."""

import csv
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import hapticdb
from contact_scenes import MM, ball, box, imported, shell_of
from hapticdb import Environment, PointShell
from hapticdb.errors import UsageError
from hapticdb.exact.gap_curve import TOLERANCE
from hapticdb.exact.movers import shapes_of
from hapticdb.exact.sweep import sweep
from hapticdb.exact.swept import Swept
from hapticdb.pointshell.tool_surface import ToolSurface

Floats = NDArray[np.float64]

WITHIN, SAMPLES = 0.05, 3000
CUBE, BLADE, NEEDLE = (shell_of(box(edges)) for edges in ((40, 40, 40), (60, 2, 30), (30, 2, 2)))
PARTS = {
    "plate": box((300, 300, 20), (0, 0, -10)),
    "foil": box((0.1, 300, 300), (50, 0, 160)),
    "wall": box((20, 300, 200), (150, 0, 100)),
    "ball": ball(50, (-100, 100, 120), 2),
    "tank": box((400, 400, 400), (2000, 0, 0)),
}
BETWEEN = np.hypot(9.0, 9.0) * MM
"""Distance of the needle's edges from the nearest points as it passes between four."""


def line(*places: Any) -> Floats:  # noqa: ANN401 - any triple, millimetres
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, 3] = MM * np.array(places)
    return poses


def turning(seed: int) -> Floats:
    rng = np.random.default_rng(seed)
    poses = line(*rng.random((4, 3)) * 300.0 - (150.0, 150.0, 0.0))
    poses[:, :3, :3] = Rotation.random(4, rng=rng).as_matrix()
    return poses


@pytest.fixture(scope="module")
def env(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Environment]:
    with imported(tmp_path_factory.mktemp("curves") / "parts.db", PARTS) as made:
        yield made


@pytest.fixture(scope="module")
def scan(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Environment]:
    """A wall of points 20 mm apart, at x 100."""
    folder = tmp_path_factory.mktemp("scan")
    y, z = (axis.ravel() for axis in np.meshgrid(*[np.arange(-100, 101, 20)] * 2))
    trimesh.PointCloud(MM * np.stack([np.full(y.size, 100), y, z], axis=1)).export(
        folder / "scan.ply"
    )
    options = hapticdb.ImportOptions(
        grid=hapticdb.GridOptions(bits=3), distances=False, unit="m", jobs=1
    )
    hapticdb.import_files(folder / "scan.db", [folder / "scan.ply"], options)
    with hapticdb.open(folder / "scan.db", read_only=True) as made:
        yield made


def through(scan: Environment, radius: float, shell: PointShell = NEEDLE) -> Swept:
    """Sweep along the middle of four points."""
    path = line((0, 10, 10), (200, 10, 10))
    return sweep(scan, shell, path, cloud_radius=radius, within=WITHIN)


@pytest.mark.parametrize(
    ("shell", "path"),
    [
        (CUBE, line((-100, 0, 60.4), (130, 0, 60.4))),
        (CUBE, line((0, 0, 20.1), (-100, 0, 20.1))),
        (CUBE, line((0, 0, 70))),
        (BLADE, turning(3)),
        (BLADE, turning(4)),
    ],
    ids=["across a foil", "along a plate", "one pose", "turns", "other turns"],
)
def test_gap_curve_bounds_all_samples(env: Environment, shell: PointShell, path: Floats) -> None:
    found = sweep(env, shell, path, within=WITHIN)
    assert found.gaps is not None
    parameters = np.linspace(0.0, found.path.length, SAMPLES)
    numbers = np.interp(parameters, found.path.parameters, np.arange(len(path)))
    poses, far = found.path.at(parameters), np.full(SAMPLES, np.inf)
    for obj, shape in shapes_of(env.store, env.objects()):
        gaps = ToolSurface(shell).nearest(shape.tree, poses, far).at_most
        has_row = np.zeros(SAMPLES, dtype=bool)
        for one in found.gaps.intervals:
            here = (one.object.id == obj.id) & (one.begin <= numbers) & (numbers <= one.end)
            has_row |= here
            if here.any() and one.at_most > 0.0:  # 0: inside a closed body
                least = float(gaps[here].min())
                assert one.at_least <= least + 1e-12
                assert one.at_most <= least + found.path.length / SAMPLES
                assert one.at_most - one.at_least <= max(TOLERANCE, 0.01 * one.at_most)
        assert gaps[~has_row].min(initial=np.inf) >= WITHIN


def test_gap_curve_is_zero_in_a_hit_and_inside(env: Environment) -> None:
    found = sweep(env, CUBE, line((2000, 0, -1000), (2000, 0, 0)), within=WITHIN)
    assert found.gaps is not None
    (hit,) = found.hits
    for one in found.gaps.intervals:
        # at the end the cube is inside, and its sides are farther away than `within`
        assert (one.at_least == 0.0) == (one.end >= hit.fraction)
    assert found.gaps.intervals[-1].end == 1.0


def test_gap_curve_time_limit(env: Environment) -> None:
    path = line((0, 0, 50), (-100, 0, 50))
    found = sweep(env, CUBE, path, within=WITHIN, seconds=1e-9)
    assert found.gaps is not None
    assert found.gaps.is_stopped
    assert found.gaps.intervals == ()
    with pytest.raises(UsageError, match="within"):
        sweep(env, CUBE, path, within=0.0)


def test_gap_curve_write_table_or_plot(env: Environment, tmp_path: Path) -> None:
    found = sweep(env, CUBE, line((0, 0, 50), (-100, 0, 50)), within=WITHIN)
    assert found.gaps is not None
    found.gaps.write(tmp_path / "gaps.csv")
    rows = [*csv.DictReader((tmp_path / "gaps.csv").read_text().splitlines())]
    assert len(rows) == len(found.gaps.intervals)
    least = min(float(row["at_least_m"]) for row in rows)
    assert least == pytest.approx(found.gap.at_least, abs=TOLERANCE)
    names = {row["name"] for row in rows}
    assert found.gaps.pairs == len(names) > 1
    found.gaps.write(tmp_path / "gaps.svg")
    texts = " ".join(ET.fromstring((tmp_path / "gaps.svg").read_text()).itertext())  # noqa: S314
    assert all(name in texts for name in names)


def test_sweep_between_points_is_clear_without_a_radius(scan: Environment) -> None:
    found = through(scan, 0.0)
    assert found.verdict == "clear"
    assert found.clouds == tuple(scan.objects())
    assert found.gap.at_most == pytest.approx(BETWEEN, rel=1e-6)


def test_sweep_cloud_radius_is_taken_off_the_gap(scan: Environment) -> None:
    found = through(scan, 0.005)
    assert found.gap.at_most == pytest.approx(BETWEEN - 0.005, abs=1e-6)
    place = found.gap.place
    assert place is not None
    assert np.abs(place.on_tool[1:] - 0.01).max() == pytest.approx(0.001)
    assert np.linalg.norm(place.on_tool - place.on_object) == pytest.approx(BETWEEN - 0.005)
    assert found.gaps is not None
    least = min(one.at_least for one in found.gaps.intervals)
    assert 0.0 <= BETWEEN - 0.005 - least <= TOLERANCE


def test_sweep_cloud_radius_closes_a_wall_of_points(scan: Environment) -> None:
    (hit,) = through(scan, 0.0142).hits
    # the corner of the needle's end meets the balls
    before = np.sqrt(0.0142**2 - BETWEEN**2)
    assert hit.fraction == pytest.approx((0.1 - before - 0.015) / 0.2, abs=1e-4)
    # a tool wholly inside a ball meets no surface
    assert sweep(scan, NEEDLE, line((100, 0, 0)), cloud_radius=0.1).verdict == "hits"
    with pytest.raises(UsageError, match="radius"):
        through(scan, -1.0)


def test_sweep_cloud_radius_is_decided_beyond_chord_errors(scan: Environment) -> None:
    rough = replace(NEEDLE, chord=1e-4)
    assert through(scan, 0.0142, rough).verdict == "hits"
    assert through(scan, BETWEEN + 5e-5, rough).verdict == "not decided"
    assert through(scan, BETWEEN - 2e-4, rough).verdict == "clear"
