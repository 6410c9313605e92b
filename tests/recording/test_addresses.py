"""Addresses that a file or a database names lead to no connection, server or other folder."""

import shutil
import socket
from collections.abc import Iterator
from pathlib import Path

import pytest

import hapticdb
from command_line import Run, refused
from hapticdb.mesh import read_file
from hapticdb.recording.file import Recording
from recordings import header, motion, write

NAMED = (
    "ws://127.0.0.1:{port}", "wss://127.0.0.1:{port}/?token=x", "http://127.0.0.1:{port}/scene.db",
    "postgresql://ann@127.0.0.1:{port}/car", "sqlite:///scene.db",
    "scene.db?token=x", "../other/scene.db", "{folder}/scene.db", "./scene.db", "away.db", "beside",
    "gone.db", "scene.db\0", "scene.db\n", "", ".", "x" * 5000,
)  # fmt: skip

GLTF = """{{"asset": {{"version": "2.0"}}, "scene": 0, "scenes": [{{"nodes": [0]}}],
"nodes": [{{"mesh": 0}}], "meshes": [{{"primitives": [{{"attributes": {{"POSITION": 0}}}}]}}],
"accessors": [{{"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3"}}],
"bufferViews": [{{"buffer": 0, "byteLength": 36}}],
"buffers": [{{"byteLength": 36, "uri": "{address}"}}]}}"""
COLLADA = """<?xml version="1.0"?>
<!DOCTYPE COLLADA SYSTEM "{address}" [<!ENTITY x SYSTEM "{address}">]>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><title>&x;</title></asset></COLLADA>"""
WAVEFRONT = """mtllib {address}
usemtl {address}
v 0 0 0
v 1 0 0
v 0 1 0
f 1 2 3
"""
PLY = """ply
format ascii 1.0
comment TextureFile {address}
element vertex 3
property float x
property float y
property float z
element face 1
property list uchar int vertex_indices
end_header
0 0 0
1 0 0
0 1 0
3 0 1 2
"""


@pytest.fixture
def listening() -> Iterator[socket.socket]:
    """A socket of this machine; at the end nobody has connected to it."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        yield listening
        listening.setblocking(False)
        with pytest.raises(BlockingIOError):
            listening.accept()


def test_recording_opens_only_file_beside_it(
    run: Run, scene: Path, tmp_path_factory: pytest.TempPathFactory, listening: socket.socket
) -> None:
    """For anything else the person is asked to name the environment."""
    scene.with_name("away.db").symlink_to(shutil.copy(scene, tmp_path_factory.mktemp("other")))
    scene.with_name("beside").mkdir()
    with hapticdb.open(scene) as env:
        grid = env.grid
    for named in NAMED:
        name = named.format(port=listening.getsockname()[1], folder=scene.parent)
        write(scene.with_name("s.hdbrec"), motion(0), header(environment=name, grid=grid))
        refused(run("replay", "s.hdbrec"), "s.hdbrec names the environment", "replay FILE URL")
        with pytest.raises(hapticdb.errors.UsageError, match="no file beside it"):
            Recording("s.hdbrec").environment_beside()
        scene.with_name("s.hdbrec").unlink()
    assert not [*scene.with_name("beside").iterdir()]


def test_recording_relative_to_its_folder(
    run: Run, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with hapticdb.open(scene) as env:
        made = header(environment=scene.name, grid=env.grid)
    recording = write(scene.with_name("s.hdbrec"), motion(0), made)
    monkeypatch.chdir("/")
    code, out, err = run("replay", recording)
    assert (code, out) == (1, "nothing to compare: the recording has no frames\n")
    assert err == f"hapticdb: {recording} names {scene}, which is opened\n"


@pytest.mark.parametrize(
    ("name", "text"), [("a.gltf", GLTF), ("a.dae", COLLADA), ("a.obj", WAVEFRONT), ("a.ply", PLY)]
)
def test_read_file_follows_no_address(
    tmp_path: Path, listening: socket.socket, name: str, text: str
) -> None:
    address = f"http://127.0.0.1:{listening.getsockname()[1]}/more"
    (tmp_path / name).write_text(text.format(address=address))
    if name in {"a.gltf", "a.dae"}:  # they need what is behind the address
        with pytest.raises(hapticdb.errors.FileError):
            read_file(tmp_path / name)
    else:
        assert len(read_file(tmp_path / name).parts) == 1
