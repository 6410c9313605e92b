"""The evaluation's chapter on the fitted costs, by which gaps are closed."""

from collections.abc import Sequence

from hapticdb.bench.cells import Cell, number
from hapticdb.bench.evaluation.prose import paragraphs, place_of, table

COLUMNS = (
    ("statement", "statement of ranges"),
    ("descent", "a range more"),
    ("row_scanned", "a row more"),
    ("lookup", "statement of keys"),
    ("probe", "a key more"),
    ("caution", "caution"),
    ("gap_rows", "a gap is closed up to rows"),
)


def costs(cells: Sequence[Cell]) -> str:
    """Fitted figures, microseconds, and the rows up to which a gap is closed."""
    rows = [[place_of(cell, cells), *(_figure(cell, key) for key, _ in COLUMNS)] for cell in cells]
    said = (
        "Microseconds, fitted to the opened database before it was measured. Caution is how many "
        "times its expected rows a gap counts: the factor that would have cost least at the places "
        "of the calibration."
    )
    return paragraphs(said, table(["", *(name for _, name in COLUMNS)], rows)) if rows else ""


def _figure(cell: Cell, key: str) -> str:
    value = number(cell, key)
    return "-" if value is None else f"{value:,.3g}"


def what_gaps_pay(cells: Sequence[Cell]) -> list[str]:
    """What a range more costs beside a row, and beside a key of `array`."""
    said = []
    for cell in cells:
        descent, row, probe = (number(cell, key) for key in ("descent", "row_scanned", "probe"))
        if not descent or not row or probe is None:
            continue
        said.append(
            f"{place_of(cell, cells)}: a range more costs as much as {descent / row:,.1f} rows, "
            f"and {_beside(descent, probe)}."
        )
    return said


def _beside(descent: float, probe: float) -> str:
    if probe <= 0.0:
        return "a key of `array` too little to be measured"
    if descent > probe:
        return f"{descent / probe:,.1f} times a key of `array`"
    return f"{descent / probe:,.2f} of a key of `array`, so that a range of two keys pays"
