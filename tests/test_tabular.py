"""Tables of results: one schema, written to files and read back."""

import csv
import importlib.util
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

import hapticdb
from assemblies import row_of_boxes
from hapticdb.batches.batch_results import ClearanceBatch, TouchBatch, TouchedIds
from hapticdb.errors import FileError, MissingExtraError, UsageError
from hapticdb.query.law import PLANE
from hapticdb.tabular.schema import COLUMNS, WRENCH
from hapticdb.tabular.tables import Tabular
from made_sweeps import line, place_at, swept, thing


def touches() -> TouchBatch:
    made = TouchBatch(2, PLANE)
    made.forces[1] = 0.1, -2.0, 1e-300
    known = {1: thing("=bolt", 1), 4: thing("nut", 4)}
    made.named = TouchedIds(np.array([0, 0, 2]), np.array([1, 4]), known)
    return made


def clearances() -> ClearanceBatch:
    made = ClearanceBatch(2, np.inf)
    made.distances[0], made.points[0] = 1 / 3, 7
    return made


def clashes(tmp_path: Path) -> hapticdb.Clashes:
    with hapticdb.open(row_of_boxes(tmp_path / "row.db", 3, 0.098)) as env:
        return hapticdb.find_clashes(env)


@pytest.mark.parametrize("suffix", [".csv", ".npz", ".parquet"])
def test_tabular_write_round_trip(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"table{suffix}"
    if suffix == ".parquet" and importlib.util.find_spec("pyarrow") is None:
        with pytest.raises(MissingExtraError, match="pip install"):
            touches().write(path)
        return
    hit = place_at(thing("seat", 2), 0.25, line())
    for result in (touches(), clearances(), swept(hits=(hit,)), clashes(tmp_path)):
        result.write(path)
        written = read(path)
        assert [*written] == [*result.columns()]
        for name, column in result.columns().items():
            read_back = written[name]
            assert len(read_back) == len(column) > 0
            for one, wanted in zip(read_back, column, strict=True):
                assert is_same(one, wanted, is_csv=suffix == ".csv"), (name, one, wanted)
        (tmp_path / "row.db").unlink(missing_ok=True)
    assert not list(tmp_path.glob(".*"))


def read(path: Path) -> dict[str, list[object]]:
    if path.suffix == ".npz":
        return {name: column.tolist() for name, column in np.load(path).items()}
    if path.suffix == ".csv":
        header, *rows = csv.reader(path.read_text().splitlines())
        return {name: [row[n] for row in rows] for n, name in enumerate(header)}
    from pyarrow import parquet  # noqa: PLC0415 - an extra

    found: dict[str, list[object]] = parquet.read_table(path).to_pydict()
    return found


def is_same(one: object, wanted: object, *, is_csv: bool) -> bool:
    if wanted is None:
        return one is None or one == "" or one != one  # noqa: PLR0124 - NaN
    if isinstance(wanted, str):
        return one in {wanted, f"'{wanted}"}
    return (float(one) if is_csv else one) == wanted  # type: ignore[arg-type]


def test_tabular_column_names_of_command_line(tmp_path: Path) -> None:
    names = {name for result in (touches(), clashes(tmp_path)) for name in result.columns()}
    assert {*WRENCH, *COLUMNS["touched"], *COLUMNS["places"], "deepest_m"} < names
    assert touches().columns()["touched_names"] == ["", "=bolt; nut"]


def test_to_pandas_needs_pandas(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(MissingExtraError, match=r"to_pandas.* pip install pandas$"):
        clearances().to_pandas()
    monkeypatch.setitem(sys.modules, "pandas", SimpleNamespace(DataFrame=dict))
    assert clearances().to_pandas()["distance_m"].tolist() == [1 / 3, np.inf]


def test_tabular_write_bad_path(tmp_path: Path) -> None:
    result: Tabular = clearances()
    with pytest.raises(UsageError, match=r"\.csv, \.parquet, \.npz"):
        result.write(tmp_path / "table.xlsx")
    with pytest.raises(FileError, match=r"cannot write .*No such file"):
        result.write(tmp_path / "none" / "table.csv")
