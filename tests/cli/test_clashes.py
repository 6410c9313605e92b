"""The verb clashes."""

import base64
import csv
import html
import io
import json
import re
import zipfile
from pathlib import Path
from typing import Any

import imageio.v3 as iio
import numpy as np
import pytest

import hapticdb
from assemblies import ball, box, row_of_boxes, write_obj
from command_line import Run, on_terminal, refused
from hapticdb.pictures import reports
from hapticdb.pictures.clash_page import snapshot


@pytest.fixture
def meeting(scene: Path) -> Path:
    """Three boxes of 0.1 m: the first 10 mm deep in the second, the third flush with it."""
    with hapticdb.open(scene) as env:
        env.shift([1], (0.11, 0.0, 0.0))
        env.shift([3], (-0.1, 0.0, 0.0))
    return scene


def test_clashes_order_by_severity_then_same(run: Run, meeting: Path) -> None:
    code, out, _ = run("clashes", meeting, "--json")
    first, second = (json.loads(line) for line in out.splitlines())
    assert code == 1
    assert (first["a"], first["b"], first["kind"], first["status"]) == (1, 2, "overlapping", "new")
    assert 0.0099 < first["at_least"] < 0.0101 < first["at_most"]
    assert (second["a"], second["b"], second["kind"]) == (2, 3, "touching")
    code, out, _ = run("clashes", meeting)
    assert code == 1
    assert "overlapping" in out
    assert "2 same" in out
    assert "0 pairs, 2 known before" in out


def test_clashes_accepted_pair_exit_code(run: Run, meeting: Path) -> None:
    assert run("clashes", meeting, "--of", "box2")[0] == 0
    assert run("clashes", meeting)[0] == 1
    code, out, _ = run("clashes", meeting, "--accept", "box0", "2", "--because", "a press fit")
    assert (code, out.strip()) == (0, "1 pair accepted until a part changes its shape")
    assert run("clashes", meeting)[0] == 0
    assert "a press fit" in run("clashes", meeting, "--all")[1]
    assert run("clashes", meeting, "--kind", "touching")[0] == 1
    assert run("clashes", meeting, "--accept", "1", "2", "--because", "")[0] == 0
    assert run("clashes", meeting)[0] == 1
    assert run("clashes", meeting, "--accept", "1", "2", "--because", "a press fit")[0] == 0
    with hapticdb.open(meeting) as env:
        env.shift([1], (0.0, 0.0, 0.2))
    (line,) = (line for line in run("clashes", meeting, "--all")[1].splitlines() if "box0" in line)
    assert line.split()[-2:] == ["-", "gone"]


def test_clashes_csv_columns(run: Run, meeting: Path, tmp_path: Path) -> None:
    assert run("clashes", meeting, "--csv", tmp_path / "pairs.csv", "--kind", "touching")[0] == 1
    (row,) = csv.DictReader((tmp_path / "pairs.csv").open())
    assert list(row)[7:13] == [f"{of}_{axis}_m" for of in "ab" for axis in "xyz"]
    assert (row["a_name"], row["kind"], row["at_least_m"]) == ("box1", "touching", "0.0")


def test_clashes_group_accepted_by_id(run: Run, tmp_path: Path) -> None:
    path = row_of_boxes(tmp_path / "row.db", 4, 0.098)
    code, out, _ = run("clashes", path)
    (line,) = (line for line in out.splitlines() if "and 2 alike" in line)
    assert (code, line.split()[1:4]) == (1, ["overlapping", "3", "4"])
    group = line.split()[0]
    code, out, _ = run("clashes", path, "--group", group, "--json")
    assert (code, {json.loads(line)["group"] for line in out.splitlines()}) == (1, {group})
    assert run("clashes", path, "--all")[1].count("   overlapping   ") == 3
    code, out, _ = run("clashes", path, "--group", group, "--because", "glued")
    assert (code, out.strip()) == (0, "3 pairs accepted until a part changes its shape")
    code, out, _ = run("clashes", path)
    assert (code, "1 group meant or accepted: --all" in out, group in out) == (0, True, False)
    assert run("clashes", path, "--all")[1].count("glued") == 3
    assert run("clashes", path, "--accept", "1", "2", "--because", "")[0] == 0
    code, out, _ = run("clashes", path)
    assert (code, "2 of 3 accepted" in out) == (1, True)
    refused(run("clashes", path, "--group", "none"), "--group 'none'")


def test_clashes_rules_stored_and_reported(run: Run, meeting: Path, tmp_path: Path) -> None:
    meant = "box0 in *: overlap up to 11 mm is meant because a fit"
    code, out, _ = run("clashes", meeting, "--rule", meant)
    assert code == 0
    assert "box0 in *: overlap up to 11 mm is meant" in out
    assert "1 meant" in out
    assert "a fit" in run("clashes", meeting, "--all")[1]
    code, out, _ = run("clashes", meeting, "--rule", meant, "--rule", "none and *: ignore")
    assert (code, out.count("box0 in *")) == (0, 1)
    code, out, err = run("clashes", meeting, "--json")
    assert (code, [json.loads(line)["rule"] for line in out.splitlines()]) == (0, [1, None])
    assert "rule 2 reaches no pair: no object 'none'" in err
    rules = tmp_path / "rules.toml"
    rules.write_text("rules = ['box2 and *: ignore']")
    code, out, _ = run("clashes", meeting, "--rules", rules)
    assert (code, "1 pair of near boxes" in out, "box0 in *" in out) == (1, True, False)
    rules.write_text("rules = ['box2 and *: keep 5mm apart']")
    refused(run("clashes", meeting, "--rules", rules), "rule 1", "--within 5mm")
    assert "box2 and *: ignore" in run("clashes", meeting)[1]
    code, out, _ = run("clashes", meeting, "--rules", rules, "--within", "5mm", "--csv", "-")
    kinds = [(row["kind"], row["rule"]) for row in csv.DictReader(out.splitlines())]
    assert (code, kinds) == (1, [("overlapping", ""), ("too near", "1")])
    rules.write_text("")
    assert "rule" not in run("clashes", meeting, "--rules", rules)[1]


def test_clashes_duplicates_exit_code(run: Run, tmp_path: Path) -> None:
    path = row_of_boxes(tmp_path / "row.db", 40, 0.0)
    code, out, _ = run("clashes", path)
    assert (code, "cube0, 40 at one place" in out, "780 duplicate" in out) == (1, True, True)
    assert out.count(" 1 duplicate") == 1
    assert run("clashes", path, "--kind", "inside")[0] == 0


def test_clashes_enclosed_part_exit_code(run: Run, tmp_path: Path) -> None:
    parts = {"wall": box((0, 0, 0), (1, 1, 1)), "pipe": ball((0.5, 0.5, 0.5), 0.1)}
    coarse = hapticdb.ImportOptions(grid=hapticdb.GridOptions(bits=6))
    hapticdb.import_files(tmp_path / "a.db", [write_obj(tmp_path / "a.obj", parts)], coarse)
    code, out, _ = run("clashes", tmp_path / "a.db")
    assert (code, "inside" in out) == (1, True)


def test_clashes_html_self_contained_and_escaped(run: Run, tmp_path: Path) -> None:
    name = "<script>alert('&')</script>"
    path = row_of_boxes(tmp_path / "row.db", 3, 0.099, names=("a/one", f"a/b/{name}", "a/b/two"))
    assert run("clashes", path, "--html", tmp_path / "meet.html")[0] == 1
    page = (tmp_path / "meet.html").read_text()
    assert "<script" not in page
    assert html.escape(name) in page
    assert "(gone)" not in page  # nothing is, and no pair has a reason
    assert re.findall(r"(?:src|href)=.([a-z:]*)", page) == ["data:image"]  # one of each group
    matrix = page[page.index("class=matrix") :]
    assert re.findall(r"<td[^>]*>(\d*/?\d*)", matrix)[:4] == ["1/1", "1/1", "1/1", ""]
    pictures = [base64.b64decode(one) for one in re.findall(r'base64,([^"]*)', page)]
    for picture in pictures:
        image = iio.imread(picture, extension=".png")[..., :3].astype(np.float64)
        orange, blue = (image[..., i] > 1.5 * image[..., j] for i, j in ((0, 2), (2, 0)))
        assert min(orange.sum(), blue.sum()) > 5_000
    refused(run("clashes", path, "--html", tmp_path / "meet.html"), "not there yet")


def test_clashes_unfinished_exit_code(run: Run, meeting: Path) -> None:
    code, out, _ = run("clashes", meeting, "--seconds", "1e-9")
    assert code == 3
    assert "2 pairs: call again" in out


def test_clashes_rotation_and_path_first_contact(run: Run, tmp_path: Path) -> None:
    path = row_of_boxes(tmp_path / "row.db", 2, 0.3)
    hinge = ("--of", "cube1", "--turn", "z", "--about", "150,0,0", "--from", "90", "--to", "270")
    code, out, _ = run("clashes", path, *hinge, "--json")
    (one,) = map(json.loads, out.splitlines())
    assert (code, one["name"], one["kind"]) == (1, "cube0", "overlapping")
    assert one["begin"] + one["end"] == pytest.approx(360.0, abs=0.05)
    assert "1 meeting" in run("clashes", path, *hinge)[1]
    table = list(csv.DictReader(run("clashes", path, *hinge, "--csv", "-")[1].splitlines()))
    assert [(row["name"], float(row["begin"])) for row in table] == [("cube0", one["begin"])]
    assert run("clashes", path, *hinge, "--kind", "inside")[:2] == (0, "0 meetings on the way\n")
    (tmp_path / "way.csv").write_text("x,y,z,qw,qx,qy,qz\n0,0,0,1,0,0,0\n0.1,0,0,1,0,0,0\n")
    code, out, _ = run("clashes", path, "--of", "cube0", "--poses", tmp_path / "way.csv")
    assert (code, out) == (0, "0 meetings on the way\n")
    refused(run("clashes", path, "--turn", "z"), "--of")
    for more in ("--least-volume 1", "--all", "--within 2", "--budget 9", "--junit a.xml"):
        words = ("--of", "cube0", "--turn", "z", *more.split())
        refused(run("clashes", path, *words), more.split()[0], "with --poses or --turn")
    for more in ("--from 1", "--about 0,0,0"):
        refused(run("clashes", path, *more.split()), more.split()[0], "without --poses")
    refused(run("clashes", path, "--of", "cube0", "--turn", "w"), "--turn x, y or z")


def test_clashes_bad_input(run: Run, meeting: Path) -> None:
    refused(run("clashes", meeting, "--kind", "near"), "--kind 'near'", "touching")
    refused(run("clashes", meeting, "--within", "0"), "give lengths above 0")
    refused(run("clashes", meeting, "--accept", "1", "2"), "--because")
    refused(run("clashes", meeting, "--of", "wheel"), "wheel")
    refused(run("clashes", meeting, "--json", "--csv", "-"), "standard output")
    refused(run("clashes", "none.db"), "no environment")
    refused(run("clashes", meeting, "--rule", "box0 is fine"), "ONE in OTHER")
    refused(run("clashes", meeting, "--rules", "none.toml"), "none.toml")


def test_clashes_unwritable_report_leaves_no_file(run: Run, meeting: Path, tmp_path: Path) -> None:
    nowhere = ("--junit", tmp_path / "a.xml", "--bcf", tmp_path / "none" / "a.bcfzip")
    refused(run("clashes", meeting, *nowhere), "--bcf: cannot write", "No such file")
    assert "2 new" in run("clashes", meeting)[1]
    refused(
        run("clashes", meeting, "--junit", "one.xml", "--bcf", "one.xml"),
        "another option names this file",
    )
    refused(
        run("clashes", meeting, "--csv", "one.xml", "--junit", "one.xml"),
        "another option names this file",
    )
    refused(run("clashes", tmp_path / "no.db", "--junit", "one.xml"), "no environment")
    assert not [*tmp_path.rglob("*.xml"), *tmp_path.rglob("*.part")]


def test_clashes_reports_one_revision(
    run: Run, meeting: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def removing(*given: Any) -> bytes:  # noqa: ANN401 - passed on
        with hapticdb.open(meeting) as other:
            other.remove(2)
        return snapshot(*given)

    monkeypatch.setattr(reports, "snapshot", removing)
    assert run("clashes", meeting, "--kind", "overlapping", "--bcf", "meet.bcf")[0] == 1
    assert len(zipfile.ZipFile("meet.bcf").namelist()) == 4
    assert "2 gone" in run("clashes", meeting)[1]


def test_clashes_accept_needs_reason_and_stands_alone(
    run: Run, meeting: Path, tmp_path: Path
) -> None:
    (group,) = {
        row["group"]
        for row in map(json.loads, run("clashes", meeting, "--json")[1].splitlines())
        if row["kind"] == "overlapping"
    }
    refused(run("clashes", meeting, "--group", group, "--because", " "), "an empty reason")
    given = ("--accept", "1", "2", "--because", "a press fit")
    refused(run("clashes", meeting, *given, "--rule", "1 and 2: ignore"), "--rule", "with --accept")
    refused(run("clashes", meeting, *given, "--csv", tmp_path / "a.csv"), "--csv", "with --because")
    assert run("clashes", meeting)[0] == 1


def test_clashes_least_volume(run: Run, meeting: Path, tmp_path: Path) -> None:
    code, out, _ = run("clashes", meeting, "--least-volume", "99cm3", "--csv", tmp_path / "a.csv")
    assert code == 1
    assert "100 cm³" in out
    first, second = csv.DictReader((tmp_path / "a.csv").open())
    assert float(first["volume_m3"]) == pytest.approx(0.01 * 0.1 * 0.1, rel=1e-5)
    assert second["volume_m3"] == ""
    code, out, _ = run("clashes", meeting, "--least-volume", "101", "--json")
    assert code == 0
    assert [json.loads(line)["volume"] for line in out.splitlines()] == [None]
    refused(run("clashes", meeting, "--least-volume", "1mm"), "no volume")


def test_clashes_bar_on_terminal_not_in_stdout(meeting: Path) -> None:
    shown = on_terminal("clashes", meeting, "--json", out=(out := io.StringIO()), code=1)
    assert "pairs" in shown
    kinds = [json.loads(line)["kind"] for line in out.getvalue().splitlines()]
    assert kinds == ["overlapping", "touching"]
