"""JUnit and BCF reports of clashes: counts, the order of elements, GUIDs, and the view."""

# ruff: noqa: S314 - files of our own
import io
import re
import shutil
from pathlib import Path
from uuid import UUID
from xml.etree import ElementTree as ET
from zipfile import ZipFile

import imageio.v3 as iio
import numpy as np
import pytest

import hapticdb
from command_line import Run, refused
from hapticdb.clashes.groups import groups_of
from hapticdb.clashes.search import find_clashes
from hapticdb.pictures.clash_page import SIZE
from hapticdb.pictures.reports import junit
from hapticdb.verdicts import Kind
from ifc_files import Building


@pytest.fixture(scope="module")
def built(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two walls 0.1 m deep in one another, and a column that touches the second."""
    folder = tmp_path_factory.mktemp("hall")
    one = Building()
    for name, at in (("wall", 0.0), ("crossing", 1.9)):
        one.add("IfcWall", name, one.shape(one.box(2000, 200, 2500)), (at, 0.0, 3.0))
    one.add("IfcColumn", "post \x01", one.shape(one.box(200, 200, 2500)), (3.0, 0.0, 3.0))
    hapticdb.import_files(folder / "hall.db", [one.written(folder / "hall.ifc")])
    return folder / "hall.db"


@pytest.fixture
def hall(built: Path, tmp_path: Path) -> Path:
    return Path(shutil.copy(built, tmp_path))


def outcomes(report: Path) -> dict[str, list[str]]:
    """Outcomes of test cases by suite, after their counts have been compared."""
    root, found = ET.parse(report).getroot(), {}
    assert root.tag == "testsuites"
    for suite in root:
        cases = [case[0].tag if len(case) else "" for case in suite]
        for word, tag in (("failures", "failure"), ("errors", "error"), ("skipped", "skipped")):
            assert int(suite.get(word, "")) == cases.count(tag)
        assert int(suite.get("tests", "")) == len(cases)
        assert all(case.tag == "testcase" and case.get("classname") for case in suite)
        found[suite.get("name", "")] = cases
    for word in ("tests", "failures", "errors"):
        assert int(root.get(word, "")) == sum(int(suite.get(word, "")) for suite in root)
    return found


def test_junit_findings_and_rules(run: Run, hall: Path, tmp_path: Path) -> None:
    rules = [
        "--rule", "IfcClass=IfcDoor and *: ignore",
        "--rule", "*/wall in *: overlap up to 10 mm is meant",
        "--rule", "*/post* and *: touching is meant",
    ]  # fmt: skip
    code, *_ = run("clashes", hall, "--junit", tmp_path / "a.xml", *rules)
    assert code == 1
    assert outcomes(tmp_path / "a.xml") == {
        "clashes": ["failure"], "rules": ["skipped", "failure", ""]
    }  # fmt: skip
    text = (tmp_path / "a.xml").read_text()
    assert "site/house/ground/wall (1), site/house/ground/crossing (2): overlapping" in text
    assert run("clashes", hall, "--accept", "1", "2", "--because", "cast")[0] == 0
    assert run("clashes", hall, "--junit", tmp_path / "b.xml")[0] == 0
    assert outcomes(tmp_path / "b.xml") == {"clashes": [""], "rules": ["skipped", "", ""]}


def test_junit_kinds_and_undecided_pairs(run: Run, hall: Path, tmp_path: Path) -> None:
    assert run("clashes", hall, "--junit", tmp_path / "a.xml", "--kind", "touching")[0] == 1
    assert outcomes(tmp_path / "a.xml") == {"clashes": ["failure"], "rules": []}
    with hapticdb.open(hall) as env:
        env.shift([1], (0.001, 0.0, 0.0))
        found = find_clashes(env, seconds=1e-9)
        (tmp_path / "b.xml").write_bytes(junit(found, groups_of(env.store, found.pairs), [*Kind]))
    assert outcomes(tmp_path / "b.xml")["clashes"][-1] == "error"


def order(element: ET.Element) -> list[str]:
    return [child.tag for child in element]


def vector(element: ET.Element | None) -> np.ndarray:
    assert element is not None
    assert order(element) == ["X", "Y", "Z"]
    return np.array([float(axis.text or "") for axis in element])


def test_bcf_topics_schema_order(run: Run, hall: Path, tmp_path: Path) -> None:
    """Order of elements and required attributes as markup.xsd and visinfo.xsd of BCF 2.1."""
    assert run("clashes", hall, "--bcf", tmp_path / "a.bcfzip")[0] == 1
    with ZipFile(tmp_path / "a.bcfzip") as archive:
        assert ET.fromstring(archive.read("bcf.version")).get("VersionId") == "2.1"
        (folder,) = {name.split("/")[0] for name in archive.namelist() if "/" in name}
        markup = ET.fromstring(archive.read(f"{folder}/markup.bcf"))
        view = ET.fromstring(archive.read(f"{folder}/viewpoint.bcfv"))
        picture = iio.imread(io.BytesIO(archive.read(f"{folder}/snapshot.png")))
    assert picture.shape[:2] == SIZE[::-1]
    assert picture.std() > 1.0
    topic, viewpoint = markup
    assert order(markup) == ["Topic", "Viewpoints"]
    assert order(topic) == [
        "Title", "Labels", "CreationDate", "CreationAuthor", "Description"
    ]  # fmt: skip
    assert topic.attrib == {"Guid": folder, "TopicType": "Clash", "TopicStatus": "Open"}
    assert str(UUID(folder)) == folder
    assert re.fullmatch(r"\d{4}-\d\d-\d\dT[\d:]{8}\+00:00", topic.findtext("CreationDate") or "")
    assert order(viewpoint) == ["Viewpoint", "Snapshot"]
    assert viewpoint.get("Guid") == view.get("Guid")
    assert order(view) == ["Components", "OrthogonalCamera"]
    assert order(view[0]) == ["Selection", "Visibility"]
    assert view[0][1].get("DefaultVisibility") == "true"
    assert order(view[1]) == [
        "CameraViewPoint", "CameraDirection", "CameraUpVector", "ViewToWorldScale"
    ]  # fmt: skip


def test_bcf_viewpoint_selects_and_faces_pair(run: Run, hall: Path, tmp_path: Path) -> None:
    assert run("clashes", hall, "--bcf", tmp_path / "a.bcfzip")[0] == 1
    with ZipFile(tmp_path / "a.bcfzip") as archive:
        (name,) = (name for name in archive.namelist() if name.endswith(".bcfv"))
        view = ET.fromstring(archive.read(name))
    with hapticdb.open(hall) as env:
        place = np.array(find_clashes(env).pairs[0].place).reshape(2, 3).mean(axis=0)
        numbers = [env.find(n)[0].attributes["GlobalId"] for n in (1, 2)]
    assert [one.get("IfcGuid") for one in view.iter("Component")] == numbers
    eye, ahead, up = (vector(axes) for axes in view[1][:3])
    assert np.linalg.norm(ahead) == pytest.approx(1.0)
    assert ahead @ up == pytest.approx(0.0, abs=1e-12)
    away = place - eye
    assert away @ ahead > 0.0
    assert np.linalg.norm(np.cross(away, ahead)) < 0.5 * float(view[1][3].text or "")


def test_bcf_guids_stable_and_accepted_closed(run: Run, hall: Path, tmp_path: Path) -> None:
    found = []
    for name, words in (("a", []), ("b", ["--accept", "1", "2", "--because", "cast"]), ("c", [])):
        if words:
            run("clashes", hall, *words)
        run("clashes", hall, "--bcf", tmp_path / f"{name}.bcfzip")
        with ZipFile(tmp_path / f"{name}.bcfzip") as archive:
            found.append(
                ET.fromstring(archive.read(next(n for n in archive.namelist() if "markup" in n)))[0]
            )
    assert len({topic.get("Guid") for topic in found}) == 1
    assert [topic.get("TopicStatus") for topic in found] == ["Open", "Closed", "Closed"]


def test_reports_refused_arguments(run: Run, hall: Path, tmp_path: Path) -> None:
    (tmp_path / "a.xml").touch()
    refused(run("clashes", hall, "--junit", tmp_path / "a.xml"), "--junit", "not there yet")
    moving = ("--of", "1", "--turn", "z", "--bcf", "a.bcfzip")
    refused(run("clashes", hall, *moving), "--poses or --turn")
    assert not (tmp_path / "a.bcfzip").exists()
