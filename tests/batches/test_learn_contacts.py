"""The example that makes a data set, at a small size, without a GPU."""

import runpy
from pathlib import Path

import numpy as np

import hapticdb
from command_line import boxes
from sources import ROOT

MAIN = runpy.run_path(str(ROOT / "examples" / "learn_contacts.py"))["main"]


def test_learn_contacts_reproducible_data_set(tmp_path: Path) -> None:
    url, (first, again) = str(tmp_path / "s.db"), (tmp_path / f"{n}.npz" for n in "ab")
    grid = hapticdb.GridOptions(bits=6)
    hapticdb.import_files(
        url, [boxes(tmp_path / "b.glb", side=0.15)], hapticdb.ImportOptions(grid=grid)
    )
    words = ["box1", "--poses", "200", "--points", "50", "--seed", "3"]
    for out in (first, again):
        MAIN([url, str(out), *words])
    found = np.load(first)
    repeated = np.load(again)
    assert sorted(found) == sorted(repeated)
    for name in found:
        assert found[name].tobytes() == repeated[name].tobytes(), name
    with hapticdb.open(url) as env:
        (own,) = env.find("box1")
        shell = env.shell("box1", points=50, seed=3)
        assert found["revision"].tolist() == [env.store.revision()]
        one = int(np.flatnonzero(found["contacts"])[0])
        touch = env.touch(shell, found["displacement"][one], exclude=["box1"])
        assert found["force"][one].tolist() == touch.force.tolist()
        others = {obj.id for obj in env.objects()} - {own.id}
    touching, offsets = found["contacts"] > 0, found["offsets"]
    assert 0 < np.count_nonzero(touching) < 200
    assert not found["force"][~touching].any()
    assert ((found["clearance"] == 0.0) == (found["hits"] > 0)).all()
    assert (np.diff(offsets)[touching] > 0).all()
    assert set() < set(found["ids"].tolist()) <= others
