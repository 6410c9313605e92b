"""The verb bench, with right and wrong arguments."""

# ruff: noqa: F811 - fixtures are imported, and arguments bear their names

import json
import re
from pathlib import Path

import pytest

import hapticdb
from command_line import PLACES, Run, made, refused, run, scene, tool  # noqa: F401 - fixtures
from hapticdb.bench.feel.measures import MEASURES
from hapticdb.poses import write_poses

EXPERIMENTS = {
    *(
        "table1",
        "costs",
        "figure8",
        "figure9",
        "figure10",
        "strategies",
        "points",
        "tail",
        "conditions",
    ),
}


@pytest.mark.long
def test_bench_writes_results_plots_and_a_report(run: Run, tmp_path: Path) -> None:
    assert run("sample", "sample", "--frames", 40)[0] == 0
    assert run("import", "car.db", "sample/car.glb", "--bits", 8)[0] == 0
    with hapticdb.open("car.db") as env:
        before = [obj.revision for obj in env.objects()]
    tool_options = ("--tool", "sample/wrench.stl", "--poses", "sample/path.csv")
    code, out, err = run("bench", "car.db", "--quick", *tool_options)
    assert code == 0, err
    assert out == "car-bench/evaluation.md\n"
    folder = tmp_path / "car-bench"
    assert {path.stem for path in folder.glob("*.json")} == EXPERIMENTS
    report = (folder / "evaluation.md").read_text()
    for plot in folder.glob("*.svg"):
        assert f"{plot.name})" in report
    for name in ("figure8", "figure9", "figure10", "points", "tail"):
        assert (folder / f"{name}.svg").is_file() or (folder / f"{name}-all-cached.svg").is_file()
    found = json.loads((folder / "strategies.json").read_text())
    assert {cell["poses"] for cell in found["cells"]} == {"slide", "random", "recorded"}
    assert found["machine"]["processors"] > 0
    assert str(tmp_path) not in "".join(p.read_text() for p in folder.iterdir())
    with hapticdb.open("car.db") as env:
        assert [obj.revision for obj in env.objects()] == before
    assert not list(folder.glob(".*"))


@pytest.mark.long
def test_bench_refuses_what_it_cannot_measure_in_one_line(run: Run, tmp_path: Path) -> None:
    refused(run("bench", "none.db"), "no environment at none.db", "hapticdb import")
    hapticdb.create(tmp_path / "empty.db", hapticdb.Grid(0.01, (0, 0, 0), 6)).close()
    refused(run("bench", "empty.db"), "empty.db is empty", "import a file")
    refused(run("bench", "empty.db", "--tool", "t.stl"), "--tool and --poses go together")
    assert not (tmp_path / "empty-bench").exists()


def test_bench_finds_out_before_it_measures_that_it_cannot_write(
    run: Run, scene: Path, tmp_path: Path
) -> None:
    (tmp_path / "taken").write_text("a file")
    refused(run("bench", scene, "--quick", "--out", "taken"), "taken", "cannot be written")
    assert (tmp_path / "taken").read_text() == "a file"


@pytest.mark.long
def test_bench_takes_a_tool_along_its_path(run: Run, scene: Path, tmp_path: Path) -> None:
    file = tool(tmp_path / "tool.stl")
    write_poses(tmp_path / "path.csv", hapticdb.read_poses(path_over(tmp_path)))
    code, _, err = run(
        "bench", scene, "--quick", "--tool", file, "--poses", "path.csv", "--out", "out"
    )
    assert code == 0, err
    cells = json.loads((tmp_path / "out" / "strategies.json").read_text())["cells"]
    assert {cell["shell"] for cell in cells} == {"sphere", "tool"}


def path_over(folder: Path) -> Path:
    """A file of poses at the positions of the scene's boxes."""
    lines = ["x,y,z,qw,qx,qy,qz", *(f"{x},{y},{z},1,0,0,0" for x, y, z in PLACES)]
    path = folder / "over.csv"
    path.write_text("\n".join(lines) + "\n")
    return path


def test_bench_feel_refuses_what_it_does_not_take_in_one_line(run: Run, tmp_path: Path) -> None:
    refused(run("bench"), "no environment", "--feel")
    refused(run("bench", "none.db", "--feel"), "no environment at none.db", "hapticdb import")
    tool = ("--tool", "t.stl", "--poses", "p.csv")
    refused(run("bench", "--feel", *tool), "--feel has tools of its own")
    assert not (tmp_path / "feel-bench").exists()


@pytest.mark.long
def test_bench_feel_prints_its_table(run: Run, tmp_path: Path) -> None:
    code, out, err = run("bench", "--feel", "--quick")
    assert code == 0, err
    lines = out.splitlines()
    assert lines[0] == "| measure | plane | smooth | wanted |"
    assert lines[-1] == "feel-bench/feel.md"
    result = json.loads((tmp_path / "feel-bench" / "feel.json").read_text())
    assert {cell["measure"] for cell in result["cells"]} == {m.key for m in MEASURES}
    page = (tmp_path / "feel-bench" / "feel.md").read_text()
    for target in re.findall(r"\]\((feel/\w+\.\w+)\)", page):
        assert (tmp_path / "feel-bench" / target).stat().st_size > 1000
    for measure in MEASURES:
        assert measure.how in page
