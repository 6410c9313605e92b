"""The whole evaluation at a tiny size: all engines, layouts, experiments, plots and the report."""

import json
from pathlib import Path

import pytest

import figures
from hapticdb.bench import records
from hapticdb.bench.cells import IN_THE_SERVER
from hapticdb.bench.experiments import Budget
from hapticdb.store.base import LAYOUTS
from servers import FOUND

TINY = Budget(
    cell_s=0.05,
    frames=20,
    tail=40,
    cold=2,
    windows=20,
    gaps=(0, 500, 100_000),
    resolutions=(10, 1000),
    shells=(30, 300),
)
BITS = 8
EXPERIMENTS = {
    *("table1", "figure8", "figure9", "figure10", "conditions", "strategies", "layouts", "points"),
    *("tail", "peers", "voxelizing", "costs"),
}


@pytest.fixture(scope="module")
def found(tmp_path_factory: pytest.TempPathFactory) -> dict[str, dict[str, object]]:
    folder = tmp_path_factory.mktemp("figures")
    parts = (*figures.PARTS, figures.ENGINES)
    return figures.evaluate(folder, BITS, TINY, None, parts)


def cells_of(found: dict[str, dict[str, object]], name: str) -> list[dict[str, object]]:
    cells = found[name]["cells"]
    assert isinstance(cells, list)
    return cells


def test_every_experiment_has_cells_on_every_engine_and_layout(
    found: dict[str, dict[str, object]],
) -> None:
    assert set(found) == EXPERIMENTS
    for name in ("figure8", "figure9", "figure10", "conditions", "strategies", "points", "tail"):
        places = {(cell["engine"], cell["layout"]) for cell in cells_of(found, name)}
        assert len({engine for engine, _ in places}) == 1 + len(FOUND), name
        assert len(places) == len(LAYOUTS) * (1 + len(FOUND)), name


def test_servers_show_both_forms_of_a_range_query(found: dict[str, dict[str, object]]) -> None:
    looped = [cell for cell in cells_of(found, "figure9") if cell["form"] == IN_THE_SERVER]
    assert {str(cell["engine"]).split()[0] for cell in looped} == {"PostgreSQL"}
    assert {cell["strategy"] for cell in looped} == {"maxgap", "cbgroup"}


def test_the_three_curves_are_compared_where_they_exist(
    found: dict[str, dict[str, object]],
) -> None:
    assert {(cell["layout"], cell["curve"]) for cell in cells_of(found, "layouts")} == {
        *(("brick", curve) for curve in ("z-order", "hilbert")),
        *(("voxel", curve) for curve in ("z-order", "hilbert", "lexicographic")),
    }


def test_cold_frames_are_measured_on_every_engine(found: dict[str, dict[str, object]]) -> None:
    cold = [cell for cell in cells_of(found, "conditions") if cell["file"] == "cold"]
    assert len({cell["engine"] for cell in cold}) == 1 + len(FOUND)


def test_results_become_plots_and_a_report(
    found: dict[str, dict[str, object]], tmp_path: Path
) -> None:
    out = tmp_path / "results"
    records.write(out, found)
    report = tmp_path / "docs" / "evaluation.md"
    figures.redraw(out, report)
    text = report.read_text()
    plots = {path.name for path in out.glob("*.svg")}
    assert len(plots) >= len(EXPERIMENTS) - 2
    for name in plots:
        assert f"(../results/{name})" in text
    assert json.loads((out / "figure9.json").read_text())["cells"]
    everything = text + "".join(path.read_text() for path in out.iterdir())
    assert str(tmp_path) not in everything
    assert str(Path.home()) not in everything
