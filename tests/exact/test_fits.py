"""Pegs in their holes at real tolerances: the gap that is proved, beside the nominal one."""

import os
from pathlib import Path

import numpy as np
import pytest

import hapticdb
from hapticdb import GridOptions, ImportOptions, PointShell
from hapticdb.exact.sweep import sweep

FITS = {
    "rectangular 8 mm": ("rectangular_hole_8mm_subdiv_3x", "rectangular_peg_8mm_tight_subdiv_3x"),
    "round 8 mm": ("round_hole_8mm_subdiv_3x", "round_peg_8mm_tight"),
    "round 16 mm": ("round_hole_16mm_subdiv_3x", "round_peg_16mm_loose"),
}


@pytest.mark.parametrize(
    ("name", "nominal"),
    [
        ("rectangular 8 mm", None),  # no size of its hole is known
        ("round 8 mm", 0.5 * (8.1e-3 - 7.995e-3)),
        ("round 16 mm", 0.5 * (16.5e-3 - 15.983e-3)),
    ],
)
def test_sweep_peg_radial_gap(tmp_path: Path, name: str, nominal: float | None) -> None:
    """8 mm and 16 mm wide; the hole's 8.99 mm are 11 to 18 voxels."""
    hole, peg = (
        Path(os.environ["HAPTICDB_TEST_DATA"], "fits", f"factory_{part}.obj") for part in FITS[name]
    )
    options = ImportOptions(grid=GridOptions(bits=6), distances=False)
    hapticdb.import_files(tmp_path / "hole.db", [hole], options)
    shell = PointShell.from_file(peg)
    path = np.tile(np.eye(4), (2, 1, 1))
    path[:, 2, 3] = (1e-3, 60e-3)
    aside = path.copy()
    aside[:, 0, 3] = 5e-4
    with hapticdb.open(tmp_path / "hole.db") as env:
        found = sweep(env, shell, path)
        refused = sweep(env, shell, aside[::-1])
    assert found.verdict == "clear"
    assert 0.0 < found.gap.at_least <= found.gap.at_most <= found.gap.at_least + 1.1e-6
    if nominal is not None:
        assert found.gap.at_most == pytest.approx(nominal, abs=2e-6)
    assert refused.verdict == "hits"
