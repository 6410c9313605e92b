"""`touch --out`: a table of all poses, whole or not at all."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest
from numba import cuda

import hapticdb
from command_line import Run, refused
from hapticdb.batches import batch_tool
from hapticdb.tabular.schema import WRENCH

TOUCH = ("touch", "scene.db", "--tool", "tool.npz", "--poses")


@pytest.fixture
def mapped(scene: Path) -> Path:
    """The path's poses, several times, as a .npy file."""
    poses = hapticdb.read_poses(scene.with_name("path.csv"))
    np.save(scene.with_name("poses.npy"), np.tile(poses, (4, 1, 1)))
    return scene.with_name("poses.npy")


@pytest.mark.parametrize("suffix", [".npz", ".parquet"])
def test_touch_out_equals_batch_bits(
    run: Run, mapped: Path, monkeypatch: pytest.MonkeyPatch, suffix: str
) -> None:
    monkeypatch.setattr(batch_tool, "PIECE", 3)
    code, out, err = run(*TOUCH, "poses.npy", "--out", f"felt{suffix}")
    if suffix == ".parquet" and importlib.util.find_spec("pyarrow") is None:
        refused((code, out, err), "pip install", ".npz")
        return
    assert code == 0, err
    assert "in contact" in out
    path = mapped.with_name(f"felt{suffix}")
    if suffix == ".npz":
        found = dict(np.load(path))
    else:
        from pyarrow import parquet  # noqa: PLC0415 - an extra

        table = parquet.read_table(path)
        found = {name: table[name].to_numpy() for name in table.column_names}
    poses = np.load(mapped)
    with hapticdb.open(mapped.with_name("scene.db")) as env:
        shell = hapticdb.PointShell.load(mapped.with_name("tool.npz"))
        felt = env.touch(shell, poses=poses)
    wrench = np.stack([found[name] for name in WRENCH], axis=1)
    assert wrench.tobytes() == np.hstack([felt.forces, felt.torques]).tobytes()
    assert felt.forces.any()
    assert found["pose"].tolist() == list(range(len(poses)))
    assert found["hits"].tolist() == felt.hits.tolist()
    assert found["contacts"].tolist() == felt.n_contacts.tolist()
    assert found["deepest_m"].tolist() == felt.deepest.tolist()
    assert set(found["revision"].tolist()) == {felt.revision}
    assert not list(mapped.parent.glob(".*"))


def test_touch_out_bad_input(run: Run, mapped: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "is_available", lambda: False)
    np.save(mapped.with_name("flat.npy"), np.eye(4))
    mapped.with_name("text.npy").write_text("no array")
    for word in ("cuda", "cpu"):
        refused(run(*TOUCH, "path.csv", "--on", word), "--on", "without --out")
    refused(run(*TOUCH, "poses.npy", "--out", "f.npz", "--maxgap", 9), "--maxgap", "with --out")
    refused(run(*TOUCH, "poses.npy", "--out", "f.npz", "--csv", "-"), "--out", "--csv")
    refused(run(*TOUCH, "poses.npy", "--out", "f.xlsx"), "f.xlsx", ".parquet, .npz")
    refused(run(*TOUCH, "poses.npy", "--out", "poses.npy"), ".parquet, .npz")
    refused(run(*TOUCH, "flat.npy", "--out", "f.npz"), "flat.npy", "(M, 4, 4)")
    refused(run(*TOUCH, "text.npy", "--out", "f.npz"), "text.npy", "no .npy file")
    refused(run(*TOUCH, "none.npy", "--out", "f.npz"), "none.npy")
    refused(run(*TOUCH, "poses.npy", "--out", "f.npz", "--on", "cuda"), "no GPU", "numba-cuda")
    poses = np.load(mapped)
    poses[5, 0, 0] = 7.0
    np.save(mapped.with_name("bent.npy"), poses)
    refused(run(*TOUCH, "bent.npy", "--out", "f.npz"), "pose 5", "no rigid transform")
    assert not list(mapped.parent.glob("f.*"))
    assert not list(mapped.parent.glob(".*"))
