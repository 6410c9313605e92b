"""Every benchmark runs: at a tiny size, on one tiny scene."""

import os
import time
from pathlib import Path
from typing import Any

import pytest

import batches
import editing
import feeling
import figures
import fits
import hapticdb
import in_real_time
import many
import page_tables
import records
import scale
import waits
from feel.measures import MEASURES
from hapticdb import GridOptions, ImportOptions, PointShell
from hapticdb.cli import app
from hapticdb.poses import read_poses
from hapticdb.sample import SampleFiles, write_sample
from hapticdb.store.base import LAYOUTS
from paper.experiments import Budget
from paper.plots import draw
from paper.tables import EVALUATION
from places import find_binaries

TINY = Budget(0.05, 10, 1, 10, (0, 500), (10, 1000), (30, 300))


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> SampleFiles:
    return write_sample(tmp_path_factory.mktemp("sample"), count=20)


@pytest.fixture(scope="module")
def database(sample: SampleFiles) -> Path:
    path = Path(sample.car).with_name("car.db")
    options = ImportOptions(grid=GridOptions(bits=7, extent=1.6))
    hapticdb.import_files(path, [sample.car], options)
    return path


def test_evaluate_all_experiments(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    newest = max(find_binaries(), key=lambda found: found.major)
    monkeypatch.setattr(figures, "find_binaries", lambda: [newest])
    results = figures.evaluate(tmp_path, 7, TINY, many.Effort(0.2, (1, 2)), real=False)
    for name in ("figure8", "figure9", "figure10"):
        places = {(cell["engine"], cell["layout"]) for cell in results[name]["cells"]}
        assert len(places) == len(LAYOUTS) * 2, name
    assert {one["poses"] for one in results["visits"]["cells"]} == {"random", "slide"}
    results["scale"] = scale.evaluate(tmp_path, scale.Effort((3e3, 3e4, 1e5), 7, 10))
    beside = {one["engine"] for one in results["many"]["cells"] if one.get("edits_per_s")}
    assert len(beside) == 2
    kept = records.read(records.ROOT / "results")
    for made in EVALUATION.values():
        assert made(kept | results)
    draw(results, tmp_path)
    assert len(list(tmp_path.glob("*.svg"))) == 5


def test_measure_frames_cells_equal_dense_bitmap(database: Path, sample: SampleFiles) -> None:
    """`measure_frames` compares every bit itself."""
    shell, poses = PointShell.from_file(sample.spanner, 3000), read_poses(sample.path)
    found = in_real_time.measure_frames(database, shell, poses)
    assert found["hits"] > 0
    assert set(found["ratio"]) == {"flat", "session", "distance"}


def test_edits_change_hits_and_revert(database: Path, sample: SampleFiles) -> None:
    found = editing.edits(str(database), Path(sample.spanner), Path(sample.path), n_edits=2)
    assert (found["edits"], found["voxels"] > 0) == (2, True)


def test_measure_batch_peers_agree_far_from_parts(tmp_path: Path) -> None:
    settings = batches.Settings(0.01, most_poses=40, points=(300,))
    found = batches.measure(tmp_path, None, 7, settings)
    missing = {note.partition(":")[0] for note in found["notes"]}
    assert not (missing and "CI" in os.environ)
    for cell in found["cells"]:
        if (cell["situation"], cell["question"]) == ("free", "touch"):
            assert {side["agree"] for side in cell["sides"].values()} == {1.0}
            assert len(cell["sides"]) == 8 - len(missing)


def test_removal_paths_spark_plug_keeps_proved_gap(tmp_path: Path) -> None:
    if "CI" not in os.environ:
        pytest.importorskip("coal", reason="make peers installs it")
    import removal_paths  # noqa: PLC0415 - loads coal

    model = tmp_path / "plug.glb"
    model.write_bytes(removal_paths.plug_scene().export(file_type="glb"))
    question = removal_paths.Question(("engine/spark_plug",))
    (row,) = removal_paths.measure(tmp_path, model, 7, [question])["rows"]
    assert (row["verdict"], row["how"]) == ("comes out", "pull")
    assert 0.0 < row["gap_m"] <= row["mesh_distance_m"]


def test_open_shapes_sweeps_agree_with_coal() -> None:
    if "CI" not in os.environ:
        pytest.importorskip("coal", reason="make peers installs it")
    import truth  # noqa: PLC0415 - loads coal

    cases = list(truth.open_shapes(time.monotonic() + 1.0))
    assert cases
    assert not any(case.is_wrong for case in cases)


def test_fits_peg_gap_is_nominal(tmp_path: Path) -> None:
    data = Path(os.environ["HAPTICDB_TEST_DATA"], "fits")
    row = fits.measured(tmp_path, data, "round 8 mm, tight", 6)
    assert row["verdict"] == "clear"
    assert row["gap_m"] == pytest.approx(row["nominal_m"], abs=2e-6)
    assert page_tables.tables()["fits"]({"fits": {"rows": [row]}}).count("\n") == 2


def test_measure_feeling_all_cells_and_curves(tmp_path: Path, sample: SampleFiles) -> None:
    effort = feeling.Effort(0, 1, (1000.0,), (0.0,), 100, 40, 7)
    (tmp_path / "scenes").mkdir()
    cells, curves = feeling.measure(effort, tmp_path / "scenes", Path(sample.car))
    found: dict[str, Any] = {"feel": {"cells": cells}}
    assert page_tables.tables()["feel"](found).count("\n") == 1 + len(MEASURES)
    assert page_tables.tables()["walls"](found).count("\n") == 3
    feeling.plot(curves, tmp_path / "feel.svg")
    assert {(c["curve"], c["law"]) for c in curves} == {one[:2] for one in feeling.PANELS}


def test_measure_waits_all_verbs_and_a_page(tmp_path: Path) -> None:
    verbs = {command.split()[0] for command in waits.COMMANDS}
    assert verbs == {command.name for command in app.registered_commands} - {"grant"}
    cells = waits.measure(tmp_path, {"this": records.ROOT}, 1, ["info car.db", "serve car.db"])
    assert all(cell[turn]["cpu_s"] > 0.0 for cell in cells for turn in ("first", "again"))
