"""Fits: pegs drawn out of holes, a nut turned on its bolt, and what a hand feels off the axis.

    HAPTICDB_TEST_DATA=... python benchmarks/fits.py     # the folder that holds fits/

A round peg's nominal gap is half the difference of the diameters. A sweep draws each peg out along
its axis, and turns the nut by half a turn. Then a hand holds each where it began, beside the axis.
"""

import argparse
import os
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import hapticdb
import page_tables
import records
from hapticdb import GridOptions, ImportOptions, PointShell

Floats = NDArray[np.float64]
BITS = 7
SEATED, OUT = 1e-3, 60e-3
"""Where a peg begins and ends along its axis, metres; the holes are 9 mm deep."""
ASIDE = 2e-5
"""Metres from the axis at which the hand holds the peg."""
PITCH, TURN, STEPS = 2e-3, np.pi, 48
"""Metres a turn of the thread, how far the nut is turned, radians, and in how many poses."""


class Fit(NamedTuple):
    """Files of a hole and its peg; metres: nominal gap, if known; start along the axis; pitch."""

    hole: str
    peg: str
    nominal_m: float | None = None
    start_m: float = SEATED
    pitch_m: float = 0.0


FITS = {
    "round 8 mm, tight": Fit(
        "round_hole_8mm_subdiv_3x", "round_peg_8mm_tight", 0.5 * (8.1e-3 - 7.995e-3)
    ),
    "round 16 mm, loose": Fit(
        "round_hole_16mm_subdiv_3x", "round_peg_16mm_loose", 0.5 * (16.5e-3 - 15.983e-3)
    ),
    "rectangular 8 mm, tight": Fit(
        "rectangular_hole_8mm_subdiv_3x", "rectangular_peg_8mm_tight_subdiv_3x"
    ),
    "M16 nut, half a turn": Fit(
        "bolt_m16_loose", "nut_m16_loose_subdiv_3x", start_m=PITCH, pitch_m=PITCH
    ),
}


def path(fit: Fit) -> Floats:
    """Poses (M, 4, 4): straight out along the axis, or a screw motion."""
    poses = np.tile(np.eye(4), (STEPS + 1 if fit.pitch_m else 2, 1, 1))
    if not fit.pitch_m:
        poses[:, 2, 3] = fit.start_m, OUT
        return poses
    turns = np.linspace(0.0, TURN, len(poses))
    poses[:, :3, :3] = Rotation.from_euler("z", turns[:, None]).as_matrix()
    poses[:, 2, 3] = fit.start_m + fit.pitch_m * turns / (2.0 * np.pi)
    return poses


def held_at(fit: Fit, aside: float) -> Floats:
    """Pose (4, 4) at the start, so far beside the axis, metres."""
    pose = np.eye(4)
    pose[:3, 3] = aside, 0.0, fit.start_m
    return pose


def measured(folder: Path, data: Path, name: str, bits: int) -> dict[str, Any]:
    """Move a peg twice, of which the second time counts, and hold it beside the axis."""
    fit = FITS[name]
    url = folder / f"{fit.hole}.db"
    options = ImportOptions(grid=GridOptions(bits=bits))
    hapticdb.import_files(url, [data / f"factory_{fit.hole}.obj"], options)
    shell = PointShell.from_file(data / f"factory_{fit.peg}.obj")
    with hapticdb.open(url, read_only=True) as env:
        for _ in range(2):
            began = time.process_time()
            found = hapticdb.sweep(env, shell, path(fit), about=(0.0, 0.0, 0.0))
            spent = time.process_time() - began
        held = [env.touch(shell, held_at(fit, x)).force for x in (0.0, ASIDE)]
        return {
            "fit": name,
            "nominal_m": fit.nominal_m,
            "verdict": found.verdict,
            "gap_m": found.gap.at_least,
            "gap_at_most_m": found.gap.at_most,
            "cpu_s": spent,
            "queries": found.queries,
            "voxel_m": env.grid.voxel_size,
            "force_on_axis_n": float(np.linalg.norm(held[0])),
            "force_aside_n": np.asarray(held[1]).tolist(),
        }


def main() -> None:
    """Measure, print, and fill the table of docs/paths.md."""
    argparse.ArgumentParser(description=records.first_line(__doc__)).parse_args()
    data = Path(os.environ["HAPTICDB_TEST_DATA"], "fits")
    with tempfile.TemporaryDirectory() as folder:
        rows = [measured(Path(folder), data, name, BITS) for name in FITS]
    for row in rows:
        print(row, flush=True)
    inputs = {"bits": BITS, "aside_m": ASIDE}
    found = records.conditions() | {"inputs": inputs, "rows": rows}
    records.write(records.ROOT / "results", {"fits": found})
    page_tables.refill("docs/paths.md", records.ROOT / "results")


if __name__ == "__main__":
    main()
