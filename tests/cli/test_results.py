"""Results as JSON and CSV: one record of each, whose keys docs/results.md has."""

import csv
import io
import json
import re
from collections.abc import Iterator
from dataclasses import fields
from pathlib import Path

import numpy as np

from command_line import Run
from hapticdb.exact.swept import Gap, Swept
from hapticdb.session.coupling import SettledCoupling
from hapticdb.session.prefetch.resident_cells import CacheFigures
from hapticdb.session.report import Report, Spread
from hapticdb.tabular.schema import COLUMNS, FIELDS, OBJECT, plain
from hapticdb.tabular.tables import CsvWriter
from made_sweeps import line, place_at, swept, thing, touching

PATH = line()
BOLT, SEAT, LID = thing("bolt", 1), thing("seat", 2), thing("lid", 3)
GAP = Gap(4e-4, 4.01e-4, place_at(BOLT, 0.312, PATH, 4e-4))
HIT = place_at(SEAT, 0.25, PATH)
DEEP = HIT._replace(at_least=2e-3)


def test_sweep_json_no_infinity() -> None:
    both = touching(SEAT, 0.6), touching(BOLT, 0.0, by="", start=np.inf)
    found = swept(gap=GAP, hits=(HIT,), touching=both, enclosed=(LID,))
    record = json.loads(json.dumps(plain(found), allow_nan=False))
    assert (record["hits"][0]["id"], record["hits"][0]["name"]) == (2, "seat")
    assert [one["start"] for one in record["touching"]] == [5e-5, None]
    assert (record["verdict"], record["gap"], record["nearest"]["name"]) == ("hits", 4e-4, "bolt")
    nothing = plain(swept())
    assert (nothing["verdict"], nothing["gap"], nothing["nearest"]) == ("clear", None, None)


def rows_of(found: Swept) -> list[dict[str, str]]:
    CsvWriter(stream := io.StringIO(newline="")).write(found.columns())
    return [*csv.DictReader(stream.getvalue().splitlines())]


def test_sweep_csv_row_per_hit_object() -> None:
    hit = place_at(BOLT, 0.5, PATH)
    found = swept(hits=(hit, DEEP), touching=(touching(SEAT, 0.6),), enclosed=(LID,))
    rows = rows_of(found)
    assert [(row["name"], row["what"], row["fraction"]) for row in rows] == [
        ("bolt", "hit", "0.5"), ("seat", "hit", "0.25"), ("lid", "enclosed", ""),
        ("seat", "touched", ""),
    ]  # fmt: skip
    assert [float(rows[0][f"on_object_{axis}_m"]) for axis in "xyz"] == hit.on_object.tolist()
    assert [row["reach_m"] for row in rows] == ["", "", "", "7e-05"]
    assert [row["at_least_m"] for row in rows] == ["0.0", "0.002", "", ""]
    assert (rows[3]["until"], rows[3]["start_m"], rows[3]["by"]) == ("0.6", "5e-05", "shift")
    (nearest,) = rows_of(swept(gap=GAP))
    assert (nearest["what"], nearest["gap_m"], nearest["verdict"]) == ("nearest", "0.0004", "clear")


PAGE = (Path(__file__).parents[2] / "docs" / "results.md").read_text()
UNITS = {
    key: unit.strip()
    for keys, unit in re.findall(r"^\| (`[^|]*) \|([^|]*)\|", PAGE, re.MULTILINE)
    for key in re.findall(r"`(\w+)`", keys)
}
"""Unit of each key that the page has, or an empty text."""
BY_NAME = ("attributes", "figures", "spread", "conditions", "defects")
"""Keys of what has names of its own."""


def keys_of(told: object) -> Iterator[str]:
    for one in told if isinstance(told, list) else ():
        yield from keys_of(one)
    for key, one in told.items() if isinstance(told, dict) else ():
        yield key
        yield from () if key in BY_NAME else keys_of(one)


def test_results_page_documents_each_key(run: Run, scene: Path) -> None:
    seen = {
        text.partition("=")[0] for names in (*FIELDS.values(), OBJECT) for text in names.split()
    }
    seen -= {"object"}  # its fields stand in its place
    seen |= {one.name for told in (Report, SettledCoupling) for one in fields(told)} - {"objects"}
    seen |= {*Spread._fields, *CacheFigures._fields}
    box = ("--part", "box1", "--path", "path.csv")
    for words in (
        ("info", scene, "--calibrate"), ("objects", scene), ("copy", scene, "b.db"),
        ("touch", scene, "--tool", "tool.npz", "--poses", "path.csv"), ("sweep", scene, *box),
        ("clashes", scene, "--within", "200"), ("move", scene, 2, "--translate", "0,0,0.01"),
        ("clashes", scene, "--of", "box1", "--turn", "z"), ("diff", scene, "b.db"),
        ("check", scene), ("backup", scene, "c.db"), ("import", "d.db", "tool.stl"),
        ("clashes", scene, "--accept", "box1", "box2", "--because", "meant"),
        ("extract", scene, "box1", "--motions", 0), ("distance", scene, 1, 2),
    ):  # fmt: skip
        code, out, err = run(*words, "--json")
        assert code in {0, 1, 4}, err
        for text in out.splitlines():
            seen |= {*keys_of(json.loads(text))}
    assert not seen - UNITS.keys()


def test_csv_columns_end_in_unit() -> None:
    for key, columns in COLUMNS.items():
        if unit := UNITS[key].replace(" ", ""):
            assert {name.rpartition("_")[2] for name in columns} == {unit}, key
