"""Peers that answer the same question give the same hits; each missing peer is named."""

import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

import peers
from hapticdb.store.postgres.private_server import find_binaries
from peers import FAMILIES, SAME, Missing, Peer, PeerMissingError, PeerWork, all_peers
from peers.rows import RowPeer
from peers.run import measure_peers
from peers.voxelizers import TOOLS, measure_voxelizers, read_assembly
from scene import BenchScene

NAMES = [name for names in FAMILIES.values() for name in names]
SECONDS = 0.2
LEFT_OUT = {"LMDB", "pgpointcloud"}


@pytest.fixture(scope="module")
def work(scene: BenchScene, tmp_path_factory: pytest.TempPathFactory) -> PeerWork:
    binaries = next((found for found in find_binaries() if found.major == 15), None)
    folder = tmp_path_factory.mktemp("peers")
    env = scene.environments["brick"]
    return PeerWork.of_sample(env, scene.shell, scene.files, folder, binaries)


@pytest.fixture(scope="module", params=NAMES)
def peer(request: pytest.FixtureRequest, work: PeerWork) -> Iterator[Peer]:
    (found,) = (one for one in all_peers() if one.name == request.param)
    try:
        found.build(work)
    except PeerMissingError as error:
        if "CI" in os.environ:
            pytest.fail(f"{found.name}: {error}")
        pytest.skip(f"{found.name}: {error}")
    yield found
    found.close()


def test_every_peer_is_there_once_under_its_name() -> None:
    assert [one.name for one in all_peers()] == NAMES


def test_who_answers_the_same_question_finds_the_same_hits(
    scene: BenchScene, work: PeerWork, peer: Peer
) -> None:
    counts = [peer.frame(pose) for pose in scene.poses]
    assert any(counts)
    if peer.question == SAME:
        assert counts == [len(work.env.touch(scene.shell, pose).hits) for pose in scene.poses]


def test_who_answers_the_same_question_gives_the_same_wrench(
    scene: BenchScene, work: PeerWork, peer: Peer
) -> None:
    assert (peer.question == SAME) == isinstance(peer, RowPeer)
    if isinstance(peer, RowPeer):
        for pose in scene.poses[::10]:
            touch = work.env.touch(scene.shell, pose)
            _, wrench = peer.felt(pose)
            assert wrench.tobytes() == np.concatenate([touch.force, touch.torque]).tobytes()


def test_far_from_the_grid_nothing_is_found(peer: Peer) -> None:
    away = np.eye(4)
    away[:3, 3] = 1000.0
    assert peer.frame(away) == 0


def test_a_peer_says_how_large_it_is(peer: Peer) -> None:
    where, size = peer.size()
    assert where in {"memory", "file"}
    assert size >= 0


def test_voxels_of_the_work_are_those_of_the_objects(work: PeerWork) -> None:
    env = work.env
    keys = [env.grid.encode(env.voxels(one.id)) for one in env.objects()]
    assert np.array_equal(work.voxels, np.unique(np.concatenate(keys)))


def test_the_runner_gives_a_cell_for_each_peer(scene: BenchScene, work: PeerWork) -> None:
    chosen = [one for one in all_peers() if one.name not in LEFT_OUT]
    found = measure_peers(work, np.array(scene.poses[:20]), SECONDS, chosen)
    own, *cells = found.cells
    assert own["peer"] == f"hapticdb, {work.env.engine}"
    missing = [one.name for one in chosen if isinstance(one, Missing)]
    assert [cell["peer"] for cell in cells] == [o.name for o in chosen if o.name not in missing]
    assert [note.partition(":")[0] for note in found.notes] == missing
    for cell in found.cells:
        assert 1 <= cell["frames"] <= 20
        assert cell["cut_short"] == (cell["frames"] < 20)
        assert cell["us"]["p10"] <= cell["us"]["p50"] <= cell["us"]["max"]
        assert cell["us"]["p99.9"] is None
        assert cell["hits_agree"] == (1.0 if cell["question"].startswith("the same") else None)
        assert ("memory_bytes" in cell) != ("file_bytes" in cell)


def test_a_time_limit_cuts_short(scene: BenchScene, work: PeerWork) -> None:
    (own,) = measure_peers(work, np.array(scene.poses), 0.0, []).cells
    assert own["frames"] == 1
    assert own["cut_short"]


def test_a_package_that_does_not_load_is_named(
    scene: BenchScene, work: PeerWork, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, "lmdb", None)
    monkeypatch.delitem(sys.modules, "peers.lmdb_bricks", raising=False)
    lost = [one for one in all_peers() if one.name == "LMDB"]
    found = measure_peers(work, np.array(scene.poses[:2]), SECONDS, lost)
    assert len(found.cells) == 1
    assert found.notes == [f"LMDB: {peers.INSTALL}"]
    assert "requirements/figures.txt" in peers.INSTALL


def test_a_server_without_the_extensions_is_named(scene: BenchScene, work: PeerWork) -> None:
    bare = PeerWork(work.env, work.shell, work.mesh_path, work.tool_mesh, work.folder)
    poses = np.array(scene.poses[:2])
    lost = [one for one in all_peers() if one.name == "pgpointcloud"]
    (note,) = measure_peers(bare, poses, SECONDS, lost).notes
    assert "apt-get install" in note


def test_voxelizers_count_alike(scene: BenchScene) -> None:
    whole = read_assembly(Path(scene.files.car))
    few = whole._replace(parts=sorted(whole.parts, key=len)[:3])
    found = measure_voxelizers(few, SECONDS)
    names = [cell["tool"] for cell in found.cells]
    assert names == [t for t in TOOLS if not any(note.startswith(t) for note in found.notes)]
    own = found.cells[0]
    assert own["voxels_per_second"] > 0
    for cell in found.cells[1:]:
        if cell["parts"] == own["parts"]:
            assert cell["object_voxels"] == pytest.approx(own["object_voxels"], rel=0.2)
