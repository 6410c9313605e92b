"""The benchmark of batches runs on a tiny scene, and the peers agree with hapticdb."""

import os
from pathlib import Path

import pytest

from batches import ALL_OWN, OWN, OWN_ONE, SITUATIONS, Settings, measure, table
from report.paths_page import batch_table


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> dict[str, object]:
    folder: Path = tmp_path_factory.mktemp("batches")
    return measure(folder, None, 7, Settings(0.01, most_poses=40, points=(300,)))


def test_every_question_is_asked_in_every_situation(results: dict[str, list]) -> None:  # type: ignore[type-arg]
    asked = [(cell["situation"], cell["question"]) for cell in results["cells"]]
    assert asked == [(name, word) for name in SITUATIONS for word in ("touch", "clearance")]
    for cell in results["cells"]:
        assert {OWN, OWN_ONE} <= set(cell["sides"])
        assert all(side["poses_per_s"] > 0.0 for side in cell["sides"].values())
        own = ALL_OWN if cell["question"] == "touch" else {OWN, OWN_ONE}
        assert all(cell["sides"][name]["agree"] == 1.0 for name in own)
    assert table(results).count("\n") > 12
    assert batch_table(results).count("\n") == 1 + len(SITUATIONS)


def test_every_peer_takes_part_and_agrees_far_from_all_parts(results: dict[str, list]) -> None:  # type: ignore[type-arg]
    missing = {note.partition(":")[0] for note in results["notes"]}
    if "CI" in os.environ:
        assert missing == set()
    for cell in results["cells"]:
        others = set(cell["sides"]) - ALL_OWN
        named = {"python-fcl", "python-fcl, parts", "coal", "coal, parts", "Open3D"}
        assert others == named - missing
        if cell["situation"] == "free" and cell["question"] == "touch":
            assert all(cell["sides"][name]["agree"] == 1.0 for name in others)
