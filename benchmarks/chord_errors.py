"""Time, triangles and chord errors of STEP files, by the chord error that is asked for.

    python benchmarks/chord_errors.py FILE.step ... [--finer 4]

Seconds are processor time of the reader's process. With --finer the distance of the vertices of a
tessellation so many times finer, which lie on the CAD surfaces, from the triangles is beside the
stored chord error: the greatest of a part, and the stored one of that part.
"""

import argparse
import resource
import sys
from pathlib import Path

import numpy as np

from hapticdb.kernels.triangles.surface_distance import nearest
from hapticdb.mesh import MeshFile, read_file
from hapticdb.pointshell.shape import bvh_of

MILLIMETRES = (0.1, 0.05, 0.02, 0.01, 0.005)


def read(path: Path, chord: float) -> tuple[MeshFile, float]:
    """File at a chord error in millimetres, and processor seconds of its reader."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    file = read_file(path, chord=chord * 1e-3, time_limit=600)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return file, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def sampled(file: MeshFile, finer: MeshFile) -> float:
    """Greatest share of a part's chord error that vertices of a finer tessellation show."""
    shares = [0.0]
    for part, other in zip(file.parts, finer.parts, strict=True):
        if part.chord:
            points = other.world_points()
            poses = np.tile(np.eye(4), (len(points), 1, 1))  # of a single point
            poses[:, :3, 3] = points
            tree, far = bvh_of(part.triangles()), np.full(len(points), np.inf)
            found = nearest(tree, bvh_of(np.zeros((1, 3, 3))), poses, far)
            shares.append(found.at_most.max() / part.chord)
    return max(shares)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("files", nargs="+", type=Path)
    parser.add_argument("--finer", type=float)
    chosen = parser.parse_args()
    head = "sampled / stored" if chosen.finer else ""
    print(f"{'file':>24} {'asked mm':>9} {'stored mm':>10} {'triangles':>10} {'s':>7} {head}")
    for path in chosen.files:
        for chord in MILLIMETRES:
            file, seconds = read(path, chord)
            stored = 1e3 * max(part.chord for part in file.parts)
            n = sum(len(part.triangles()) for part in file.parts)
            share = ""
            if chosen.finer:
                share = f"{sampled(file, read(path, chord / chosen.finer)[0]):.2f}"
            line = (
                f"{path.stem[:24]:>24} {chord:>9} {stored:>10.5f} {n:>10,} {seconds:>7.2f} {share}"
            )
            print(line)
            sys.stdout.flush()


if __name__ == "__main__":
    main()
