"""How good the forces feel: the measures of `hapticdb bench --feel`, and the page docs/feel.md.

    make feel                          # results/feel.json, results/feel/, docs/feel.md
    make feel ARGS=--quick             # results-quick/, a first look
    make feel ARGS=--redraw            # plots and page again, from results/feel.json

The walk is over the vintage car in the folder that HAPTICDB_TEST_DATA names; over the sample car
where there is none.
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import hapticdb
from awake import awake
from hapticdb import GridOptions, ImportOptions
from hapticdb.bench import records
from hapticdb.bench.feel.page import missed_lines, table_of, write_feel_page
from hapticdb.bench.feel.plots import draw_feel
from hapticdb.bench.feel.run import NAME, feel

CAR = "demo_vintage_car/vintage_car.glb"
BITS, QUICK_BITS = 11, 9
EXTENT = 1.6
"""Grid of the car: bits an axis, and its edge as a multiple of the car's longest side."""
PAGE = Path("docs/feel.md")
OUT = Path("results")


def car_of(folder: Path, data: Path | None, bits: int) -> str | None:
    """The vintage car imported; None where it is not there."""
    if data is None or not (data / CAR).is_file():
        return None
    url = str(folder / "vintage_car.db")
    options = ImportOptions(grid=GridOptions(bits=bits, extent=EXTENT))
    (report,) = hapticdb.import_files(url, [data / CAR], options)
    if report.error is not None:
        raise report.error
    return url


def main(arguments: list[str] | None = None) -> None:
    """Read the command line, measure, write JSON, plots and the page."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--quick", action="store_true", help="fewer cases, for a first look")
    parser.add_argument("--redraw", action="store_true", help="plots and page from the results")
    given = parser.parse_args(arguments)
    out = Path("results-quick") if given.quick else OUT
    started = time.perf_counter()
    if not given.redraw:
        data = os.environ.get("HAPTICDB_TEST_DATA")
        with awake(), tempfile.TemporaryDirectory(prefix="hapticdb-feeling-") as folder:
            url = car_of(
                Path(folder), Path(data) if data else None, QUICK_BITS if given.quick else BITS
            )
            _, result = feel(
                out,
                url=url,
                quick=given.quick,
                say=lambda line: print(
                    f"{time.perf_counter() - started:6.0f} s  {line}", file=sys.stderr, flush=True
                ),
            )
        print(table_of(result["cells"]), *missed_lines(result["cells"]), sep="\n")
    page = out / f"{NAME}.md" if given.quick else PAGE
    redraw(out, page)
    print(page)


def redraw(out: Path, page: Path) -> None:
    """Draw plots and write the page from the result in a folder."""
    result = records.read(out)[NAME]
    draw_feel(result, out / NAME)
    write_feel_page(result, page, os.path.relpath(out / NAME, page.parent))
    own = out / f"{NAME}.md"
    if own != page:
        own.unlink(missing_ok=True)


if __name__ == "__main__":
    main()
