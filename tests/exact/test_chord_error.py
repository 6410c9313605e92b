"""The chord error of tessellations in gaps, depths and verdicts; lengths in millimetres."""

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from contact_scenes import MM, Triple, box, imported, pulls, shell_of, swept
from hapticdb import Environment, PointShell
from hapticdb.exact.clash import PairResult, classify_pair
from hapticdb.exact.sweep_report import verdict_line
from hapticdb.exact.swept import Swept
from hapticdb.mesh import read_file
from hapticdb.pointshell.shape import CollisionShape
from step_files import cylinder

ERROR = 0.02
EXACT = shell_of(box((40.0, 40.0, 40.0), (0.0, 0.0, 20.0)))
BLUNT = replace(EXACT, chord=MM * ERROR)


@pytest.fixture(scope="module")
def env(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Environment]:
    plate = {"plate": box((300.0, 300.0, 20.0), (0.0, 0.0, -10.0))}
    with imported(tmp_path_factory.mktemp("chord") / "plate.db", plate) as made:
        yield made


def passing(env: Environment, tool: PointShell, gap: float) -> Swept:
    """Sweep down to a gap over the plate, and along it."""
    poses = pulls((0.0, 0.0, gap), (50.0, 0.0, gap))
    poses[0, 2, 3] = 80.0
    return swept(env, tool, poses, ["plate"], contact=1e-3)


def moving(env: Environment, tool: PointShell, by: Triple, contact: float = 0.05) -> str:
    """Verdict of a tool that stands on the plate and moves."""
    return swept(env, tool, pulls(by), ["plate"], contact=contact).verdict


def test_sweep_gap_less_chord_error(env: Environment) -> None:
    exact, found = (passing(env, tool, 1.0) for tool in (EXACT, BLUNT))
    assert (exact.gap.error, found.gap.error) == (0.0, MM * ERROR)
    assert found.gap.at_least == pytest.approx(exact.gap.at_least - MM * ERROR, abs=1e-9)
    assert verdict_line(found, BLUNT).endswith("±20 µm by tessellation")


@pytest.mark.parametrize(
    ("gap", "verdict"),
    [(0.05, "clear"), (0.015, "not decided"), (-0.01, "not decided"), (-1.0, "hits")],
)
def test_sweep_hit_within_chord_error_undecided(env: Environment, gap: float, verdict: str) -> None:
    found = passing(env, BLUNT, gap)
    assert found.verdict == verdict
    assert (found.undecided != ()) == (verdict == "not decided")
    if verdict == "not decided":
        assert "plate within the chord error" in verdict_line(found, BLUNT)
        assert passing(env, EXACT, gap).verdict == ("clear" if gap > 0.0 else "hits")


def test_sweep_contact_tolerance_less_chord_error(env: Environment) -> None:
    along, into, little = (50.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 0.0, -0.05)
    assert moving(env, BLUNT, along) == "slides"
    assert moving(env, BLUNT, along, contact=0.015) == "not decided"
    assert moving(env, BLUNT, into) == moving(env, BLUNT, into, contact=0.015) == "hits"
    assert moving(env, EXACT, little) == "clear"
    assert moving(env, BLUNT, little) == "not decided"


def judged(gap: float) -> PairResult:
    """Two blocks of 20 over one another."""
    blocks = [CollisionShape(MM * box((20.0,) * 3), chord=0.5 * MM * ERROR) for _ in range(2)]
    pose = np.eye(4)
    pose[:3, 3] = MM * np.array([1.0, 2.0, 20.0 + gap])
    return classify_pair(blocks[0], blocks[1], pose, MM, 0.05 * MM)


@pytest.mark.parametrize(
    ("gap", "kind"),
    [
        (0.1, "apart"), (0.045, "not known"), (0.01, "touching"), (0.0, "touching"),
        (-0.02, "touching"), (-0.045, "not known"), (-1.0, "overlapping"),
    ],
)  # fmt: skip
def test_classify_pair_chord_error_bounds(gap: float, kind: str) -> None:
    found = judged(gap)
    assert found.kind == kind
    if kind == "apart":
        assert found.at_least / MM == pytest.approx(gap - ERROR, abs=1e-6)
        assert found.at_most / MM == pytest.approx(gap + ERROR, abs=1e-6)
    if kind == "overlapping":
        assert 0.97 * (-gap - ERROR) <= found.at_least / MM <= -gap - ERROR + 1e-6
        assert found.at_most / MM >= -gap + ERROR


def test_part_bounds_include_chord_error(tmp_path: Path) -> None:
    part = read_file(cylinder(tmp_path / "rod.step", 10.0, 20.0)).parts[0]
    points, chord = part.world_points(), part.placed_chord
    assert chord > 0.0
    grown = np.stack([points.min(axis=0) - chord, points.max(axis=0) + chord])
    np.testing.assert_array_equal(part.bounds, grown)
