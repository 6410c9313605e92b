"""The verb sweep, with right and wrong arguments."""

import csv
import json
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

import hapticdb
from assemblies import write_obj
from command_line import Run, poses, refused, succeeded
from contact_scenes import box, imported, shell_of
from hapticdb.exact import sweep as sweeping

TOOL = ("--tool", "tool.stl")


@pytest.fixture
def free(scene: Path) -> Path:
    """A path 40 mm above the boxes."""
    return poses(scene.parent / "free.csv", (0.0, 0.0, 0.1), (0.4, 0.0, 0.1))


@pytest.fixture
def through(scene: Path) -> Path:
    """A path from above into the first box and on through all of them."""
    return poses(
        scene.parent / "through.csv", (-0.05, 0.0, 0.15), (-0.05, 0.0, 0.0), (0.45, 0.0, 0.0)
    )


@pytest.fixture
def along(scene: Path) -> Path:
    """A path on which the tool lies on the first box, slides, and goes up."""
    return poses(scene.parent / "along.csv", (0.0, 0.0, 0.06), (0.02, 0.0, 0.06), (0.02, 0.0, 0.2))


@pytest.mark.usefixtures("free")
def test_sweep_clear_gap(run: Run, scene: Path) -> None:
    out = succeeded(run("sweep", scene, *TOOL, "--path", "free.csv"))
    found = json.loads(run("sweep", scene, *TOOL, "--path", "free.csv", "--json")[1])
    assert found["verdict"] == "clear"
    assert 0.0396 <= found["gap"] <= 0.04
    assert found["gap_at_most"] == pytest.approx(0.04, abs=1e-6)
    assert out.startswith(f"{found['line']}\n")
    assert (found["moved"], found["path"]) == ("tool.stl", "free.csv")


@pytest.mark.usefixtures("through")
def test_sweep_hit_position(run: Run, scene: Path) -> None:
    code, out, err = run("sweep", scene, *TOOL, "--path", "through.csv")
    assert (code, err) == (1, "")
    first, *rest = out.splitlines()
    assert first.startswith("hits box0 at ")
    assert "(segment 0)" in first
    for name in ("box0", "box1", "box2"):
        assert any(name in line for line in rest)
    words = ("sweep", scene, *TOOL, "--path", "through.csv", "--json", "--until-hit")
    assert [one["name"] for one in json.loads(run(*words)[1])["hits"]] == ["box0"]


@pytest.mark.usefixtures("along")
def test_sweep_sliding_start_is_clear(run: Run, scene: Path) -> None:
    sweep = ("sweep", scene, *TOOL, "--path", "along.csv")
    out = succeeded(run(*sweep))
    assert out.startswith("slides along box0 until 12.6 % of the path, otherwise clear by ")
    refused(run(*sweep, "--contact", 0), "contact")


def test_sweep_about_other_centre(run: Run, scene: Path) -> None:
    """160 degrees take the tool through the first box, or about the box's middle round it."""
    poses = "0,0,0.1,1,0,0,0\n0.0342020143,0,-0.0939692621,0.1736481777,0,0.984807753,0\n"
    text = f"x,y,z,qw,qx,qy,qz\n{poses}"
    (scene.parent / "turn.csv").write_text(text)
    sweep = ("sweep", scene, *TOOL, "--path", "turn.csv")
    assert run(*sweep)[0] == 1
    code, out, _ = run(*sweep, "--about", "0,0,-100", "--json")
    assert (code, json.loads(out)["nearest"]["name"]) == (0, "box0")
    # the tool's inner side is 90 mm from the box's middle, the box's edges are 70.7 mm from it
    assert json.loads(out)["gap"] == pytest.approx(0.09 - 0.1 / 2**0.5, rel=0.01)
    refused(run(*sweep, "--about", "0,-100"), "--about", "millimetres")


@pytest.mark.usefixtures("through")
def test_sweep_csv_row_per_hit(run: Run, scene: Path) -> None:
    sweep = ("sweep", scene, *TOOL, "--path", "through.csv")
    found = json.loads(run(*sweep, "--json")[1])
    assert run(*sweep, "--csv", "hit.csv")[0] == 1
    text = scene.with_name("hit.csv").read_text()
    rows = csv.DictReader(text.splitlines())
    assert [(row["name"], row["what"], float(row["fraction"])) for row in rows] == [
        (one["name"], "hit", one["fraction"]) for one in found["hits"]
    ]
    code, out, err = run(*sweep, "--csv", "-")
    assert (code, out, err) == (1, text, "")
    refused(run(*sweep, "--csv", "-", "--json"), "only one")
    refused(run(*sweep, "--csv", "hit.csv"), "--csv")


@pytest.mark.usefixtures("free", "through", "along")
def test_sweep_batch_file(run: Run, scene: Path) -> None:
    many = scene.with_name("many.csv")
    many.write_text(
        "tool,part,path,exclude,contact\n"
        "tool.stl,,free.csv,,\n"
        "tool.stl,,free.csv,box0; box1,\n"
        ",box2,free.csv,,0.1\n"
    )
    out = succeeded(run("sweep", scene, "--batch", "many.csv"))
    assert [line.split()[0] for line in out.splitlines()[2:]] == ["tool.stl", "tool.stl", "box2"]
    many.write_text(many.read_text() + "tool.stl,,through.csv,,\n")
    code, out, err = run("sweep", scene, "--batch", "many.csv", "--json")
    assert (code, err) == (1, "")
    found = [json.loads(line) for line in out.splitlines()]
    assert [one["verdict"] for one in found] == ["clear", "clear", "clear", "hits"]
    assert [one["contact"] for one in found] == pytest.approx([5e-5, 5e-5, 1e-4, 5e-5])
    assert found[1]["excluded"] == [1, 2]
    assert found[2]["parts"] == [3]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("", "--batch"), ("part,way\n1,a.csv\n", "'way'"), ("part\n1\n", "path"),
        ("part,path\n", "no sweep"), ("part,path\n1\n", "line 2"), ("part,path\n1,,\n", "line 2"),
        ("part,tool,path\n1,tool.stl,path.csv\n", "line 2"),
        ("part,path\n\n1,path.csv\n9,path.csv\n", "line 4: --part: no object 9"),
        ("part,path\n1,none.csv\n", "line 2: no file of poses"),
        ("tool,path\nnone.stl,path.csv\n", "line 2: cannot read none.stl"),
        ("part,path,contact\n1,path.csv,wide\n", "line 2: contact"),
        ('part,path\n"1,path.csv\n', "unexpected end"), ("\0", "--batch"),
    ],
)  # fmt: skip
def test_sweep_bad_batch_file(run: Run, scene: Path, text: str, told: str) -> None:
    scene.with_name("many.csv").write_text(text)
    refused(run("sweep", scene, "--batch", "many.csv"), told)


@pytest.mark.usefixtures("free")
def test_sweep_concurrent_edit_note(run: Run, scene: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    swept_by = sweeping.sweep

    def disturbed(*args: object, **options: object) -> object:
        found = swept_by(*args, **options)  # type: ignore[arg-type]
        with hapticdb.open(scene) as env:
            env.remove(3)
        return found

    monkeypatch.setattr(sweeping, "sweep", disturbed)
    code, _, err = run("sweep", scene, *TOOL, "--path", "free.csv")
    assert code == 0
    assert "was written meanwhile; this is of revision 3" in err


@pytest.mark.parametrize(
    ("lengths", "told", "hint"),
    [
        ((20.0,), "longer than the scene", "would --tool-unit mm be right?"),
        ((1e-4,), "shorter than a voxel", "is --tool-unit right?"),
    ],
)
@pytest.mark.parametrize("args", [("touch", "--poses"), ("sweep", "--path")])
def test_sweep_feel_tool_unit_hint(
    run: Run, scene: Path, args: tuple[str, str], lengths: tuple[float], told: str, hint: str
) -> None:
    trimesh.creation.box(lengths * 3).export(scene.parent / "wrong.stl")
    words = (args[0], scene, args[1], "path.csv", "--tool", "wrong.stl")
    (line,) = run(*words)[2].splitlines()
    assert line.startswith("hapticdb: the tool is ")
    assert told in line
    assert line.endswith(hint)
    assert run(*words, "--tool-unit", "m")[2] == ""


def test_sweep_bad_arguments(run: Run, scene: Path) -> None:
    path = ("--path", "path.csv")
    refused(run("sweep", scene, *path), "--tool and --part")
    refused(run("sweep", scene, *TOOL), "--path", "--batch")
    refused(run("sweep", scene, *path, "--batch", "many.csv"), "--batch and --path")
    refused(run("sweep", scene, *path, *TOOL, "--part", 1), "--tool and --part")
    refused(run("sweep", scene, *path, "--part", 1, "--tool-unit", "mm"), "--tool-unit")
    refused(run("sweep", scene, *path, "--part", 9), "no object 9")
    refused(run("sweep", scene, *path, *TOOL, "--exclude", "x"), "--exclude")
    refused(run("sweep", scene, *path, *TOOL, "--seconds", -1), "second")
    refused(run("sweep", "none.db", *path, *TOOL), "none.db")


@pytest.fixture
def seam(tmp_path: Path) -> Path:
    """A hood of 100 x 60 x 1 mm that stands 2 mm deep in its seam, and a rail 5 mm below it."""
    url = tmp_path / "seam.db"
    surfaces = {
        "hood": box((100.0, 60.0, 1.0)),
        "seam": box((20.0, 60.0, 10.0), (58.0, 0.0, -3.0)),
        "rail": box((20.0, 60.0, 10.0), (0.0, 0.0, -10.5)),
    }
    with imported(url, surfaces):
        poses(tmp_path / "up.csv", (0.0, 0.0, 0.0), (0.0, 0.0, 0.04))
        poses(tmp_path / "still.csv", (0.0, 0.0, 0.0))
        poses(tmp_path / "down.csv", (0.0, 0.0, 0.0), (0.0, 0.0, -0.02))
        return url


def test_sweep_extract_overlap_at_start_exit_code(
    run: Run, seam: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(seam.parent)
    words = ("sweep", seam, "--part", "hood", "--path", "up.csv")
    code, out, _ = run(*words)
    assert code == 4
    assert re.search(
        r"otherwise clear by 5 mm: nearest rail .*, but for overlaps at the start: seam 2", out
    )
    found = json.loads(run(*words, "--json")[1])
    assert found["verdict"] == "overlaps"
    (touched,) = found["touching"]
    assert 1.95e-3 <= touched["start_at_least"] <= 2e-3 + 1e-9 <= touched["start"] <= 2.11e-3
    assert run(*words, "--overlap", 2.5)[0] == 0
    assert run(*words, "--overlap", 1.0)[0] == 4
    Path("many.csv").write_text("part,path\nhood,up.csv\nrail,still.csv\n")
    assert run("sweep", seam, "--batch", "many.csv")[0] == 4
    Path("many.csv").write_text("part,path\nhood,up.csv\nhood,down.csv\n")
    assert run("sweep", seam, "--batch", "many.csv")[0] == 1
    code, out, _ = run("extract", seam, "hood", "--motions", 0, "--out", 40)
    assert code == 4
    assert "but for overlaps at the start: seam 2" in out
    assert run("extract", seam, "hood", "--motions", 0, "--out", 40, "--overlap", 2.5)[0] == 0
    code, out, _ = run("extract", seam, "hood", "--motions", 0, "--out", 40, "--disassemble")
    assert code == 4


def test_sweep_foreign_tool_overlap_is_hit(
    run: Run, seam: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(seam.parent)
    corners = shell_of(box((100.0, 60.0, 1.0))).outline
    write_obj(Path("hood.obj"), {"hood": (corners, np.arange(len(corners)).reshape(-1, 3))})
    words = ("--path", "up.csv", "--exclude", "hood")
    code, out, _ = run("sweep", seam, "--tool", "hood.obj", "--tool-unit", "m", *words)
    assert (code, out.partition(":")[0]) == (1, "starts inside seam")


@pytest.mark.usefixtures("through")
def test_sweep_envelope_is_stored_and_replaced(run: Run, scene: Path) -> None:
    words = ("sweep", scene, *TOOL, "--path", "through.csv", "--until-hit", "--envelope", "swept")
    code, out, err = run(*words, "--envelope-voxel", 10)
    assert (code, err) == (1, "hapticdb: envelope stored as swept, in voxels of 10 mm\n")
    assert out.startswith("hits box0 at ")
    with hapticdb.open(scene) as env:
        (stored,) = env.find("envelope=tool.stl")
    assert (stored.id, stored.name) == (4, "swept")
    assert stored.attributes["path"] == "through.csv"
    found = [json.loads(one) for one in run("clashes", scene, "--of", 4, "--json")[1].splitlines()]
    assert {one["a_name"] for one in found if "a_name" in one} == {"box0", "box1", "box2"}
    refused(run(*words), "--envelope swept: object 4", "--replace")
    # the former envelope is not met
    again = run(*words, "--replace", "--json")
    assert (again[0], json.loads(again[1])["excluded"]) == (1, [4])
    with hapticdb.open(scene) as env:
        assert env.object(4).attributes["voxel"] != "10 mm"
    refused(run(*words[:-1], "box1", "--replace"), "--envelope box1: object 2")
    refused(run(*words[:-2], "--envelope-voxel", 2), "--envelope-voxel")
    refused(run("sweep", scene, "--batch", "many.csv", "--envelope", "swept"), "--batch")
    refused(run(*words[:-1], "fine", "--envelope-voxel", "1um"), "1 µm", "would do")


@pytest.mark.usefixtures("through")
@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("swept", "--envelope-voxel", "1um"), "would do"),
        (("swept",), "outside the grid's"),
        (("sw\udcffept",), "is no text"),
    ],
)
def test_sweep_envelope_refused_before_the_sweep(
    run: Run, scene: Path, monkeypatch: pytest.MonkeyPatch, words: tuple[str, ...], told: str
) -> None:
    poses(scene.parent / "away.csv", (-0.05, 0.0, 0.15), (50.0, 0.0, 0.15))
    path = "away.csv" if "grid" in told else "through.csv"
    monkeypatch.setattr(sweeping, "sweep", lambda *_, **__: pytest.fail("it has begun"))
    refused(run("sweep", scene, *TOOL, "--path", path, "--envelope", *words), told)


def test_sweep_envelope_of_machine_stored(run: Run, scene: Path) -> None:
    scene.with_name("crane.urdf").write_text(
        '<robot name="crane"><link name="base"/><link name="hook"><collision><geometry>'
        '<box size="0.02 0.02 0.02"/></geometry></collision></link><joint name="lift" '
        'type="prismatic"><parent link="base"/><child link="hook"/><axis xyz="0 0 1"/></joint>'
        "</robot>"
    )
    scene.with_name("lift.csv").write_text("lift\n0\n0.02\n")
    words = ("--machine", "crane.urdf", "--joints", "lift.csv", "--at", "0,0,70,1,0,0,0")
    assert run("sweep", scene, *words, "--envelope", "crane", "--envelope-voxel", 1)[0] == 0
    with hapticdb.open(scene) as env:
        low, high = env.find("crane")[0].bounds
    assert low == pytest.approx([-0.01, -0.01, 0.06], abs=2e-3)
    assert high == pytest.approx([0.01, 0.01, 0.1], abs=2e-3)


@pytest.mark.usefixtures("free", "through")
def test_sweep_gaps_are_written_as_a_table_and_a_plot(run: Run, scene: Path) -> None:
    sweep = ("sweep", scene, *TOOL, "--path", "free.csv")
    out = succeeded(run(*sweep, "--gaps", "gaps.csv", "--gaps", "gaps.svg", "--within", 45))
    assert "3 pairs within 45 mm" in out
    rows = [*csv.DictReader(scene.with_name("gaps.csv").read_text().splitlines())]
    assert {row["name"] for row in rows} == {"box0", "box1", "box2"}
    assert min(float(row["at_least_m"]) for row in rows) == pytest.approx(0.04, rel=0.01)
    assert "box2: 39." in scene.with_name("gaps.svg").read_text()
    refused(run(*sweep, "--gaps", "gaps.csv"), "--gaps")
    refused(run(*sweep, "--gaps", "gaps.png"), "--gaps", ".svg")
    refused(run(*sweep, "--within", 5), "--within", "--gaps")
    refused(run("sweep", scene, "--batch", "many.csv", "--gaps", "a.csv"), "--gaps", "--batch")


@pytest.mark.usefixtures("free")
def test_sweep_cloud_radius_says_what_free_means(run: Run, scene: Path) -> None:
    places = np.array([[0.0, 0.0, 0.2], [0.4, 0.0, 0.2]])
    trimesh.PointCloud(places).export(scene.with_name("scan.ply"))
    succeeded(run("import", "scan.db", "scan.ply", "--bits", 5, "--unit", "m"))
    sweep = ("sweep", "scan.db", *TOOL, "--path", "free.csv")
    name = json.loads(run("objects", "scan.db", "--json")[1])["name"]
    found = json.loads(run(*sweep, "--json")[1])
    assert f"{name}: no point within " in found["line"]
    assert "nothing proved between points" in found["line"]
    assert ([one["name"] for one in found["clouds"]], found["cloud_radius"]) == ([name], 0.0)
    ball = json.loads(run(*sweep, "--json", "--cloud-radius", 10)[1])
    assert ball["gap"] == pytest.approx(found["gap"] - 0.01, abs=1e-5)
    assert f"the points of {name} are balls of radius 10 mm" in ball["line"]
