"""Time, triangles and chord errors of STEP files, by the chord error that is asked for.

    python benchmarks/chord_errors.py FILE.step ...

Seconds are processor time of the reader's process.
"""

import argparse
import resource
from itertools import product
from pathlib import Path

import records
from hapticdb.mesh import read_file

MILLIMETRES = (0.1, 0.05, 0.02, 0.01, 0.005)


def main() -> None:
    """Read each file at each chord error, and print a table."""
    parser = argparse.ArgumentParser(description=records.first_line(__doc__))
    parser.add_argument("files", nargs="+", type=Path)
    print(f"{'file':>24}  asked mm  stored mm  triangles       s")
    for path, chord in product(parser.parse_args().files, MILLIMETRES):
        before = resource.getrusage(resource.RUSAGE_CHILDREN)
        parts = read_file(path, chord=chord * 1e-3, time_limit=600).parts
        after = resource.getrusage(resource.RUSAGE_CHILDREN)
        seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
        stored = 1e3 * max(part.chord for part in parts)
        n = sum(len(part.triangles()) for part in parts)
        line = f"{path.stem[:24]:>24} {chord:>9} {stored:>10.5f} {n:>10,} {seconds:>7.2f}"
        print(line, flush=True)


if __name__ == "__main__":
    main()
