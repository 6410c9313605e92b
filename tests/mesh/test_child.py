"""The child process that parses files: same result, limited harm, no orphan process."""

import os
import signal
import struct
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from subprocess import Popen

import numpy as np
import pytest

from children import child, until
from hapticdb.errors import MissingExtraError
from hapticdb.mesh import Defects, parse_in_process, read_file
from hapticdb.mesh import reader as reader_module
from hapticdb.mesh import scratch as scratch_module
from hapticdb.mesh.child import allowance
from hapticdb.mesh.formats.gltf import bytes_beside
from hapticdb.mesh.scratch import scratch_folder
from hapticdb.resident.table import is_alive
from mesh_files import cause, gltf, names, text, threemf


def test_read_file_child_equals_in_process(tmp_path: Path) -> None:
    n = 3_000
    nodes = [{"mesh": 0, "name": f"n{i}", "translation": [i, -i, 0.1 * i]} for i in range(n)]
    nodes[1]["scale"] = [0.1, 3, 1]
    tree = {"nodes": nodes, "scenes": [{"nodes": [*range(n)]}]}
    path = gltf(tree, tmp_path / "two.gltf", indices=[0, 1, 2, 0, 1, 9])
    here, there = parse_in_process(path), read_file(path)
    assert there.link == str(path.resolve())
    assert names(there) == names(here) == [f"n{i}" for i in range(n)]
    assert there.defects == here.defects == Defects(out_of_range=n)
    assert len({id(part.vertices) for part in there.parts}) == 1
    for a, b in zip(here.parts, there.parts, strict=True):
        np.testing.assert_array_equal(a.world_from_part, b.world_from_part)
    assert here.parts[1].digest == there.parts[1].digest
    np.testing.assert_array_equal(here.parts[1].triangles(), there.parts[1].triangles())


def test_read_file_zip_bomb_memory_limit(tmp_path: Path) -> None:
    filler = " " * (64 << 20)
    path = threemf(tmp_path / "bomb.3mf", f'<object id="1">{filler}</object>', "")
    assert path.stat().st_size < 200_000
    cause(path, read_file, memory_limit=32 << 20)


def test_bytes_beside_counts_each_gltf_file_once(tmp_path: Path) -> None:
    beside = tmp_path / "a b.bin"
    beside.write_bytes(b"\0" * 1_000_000)
    (tmp_path / "link.bin").symlink_to(beside)
    named = ["a b.bin", "a%20b.bin", "link.bin", "./a b.bin", "gone.bin"] * 100
    tree = {"buffers": [{"byteLength": 1_000_000, "uri": name} for name in named]}
    path = gltf(tree, tmp_path / "d.gltf")
    assert bytes_beside(path) == 1_000_000
    assert allowance(path, bytes_beside(path)) > allowance(path) + 1_000_000


@pytest.fixture
def fake_laspy(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Path]:
    """A function that makes a LAS file and replaces laspy by a test's code."""

    def make(body: str) -> Path:
        (tmp_path / "laspy" / "vlrs").mkdir(parents=True)
        classes = "class GeoKeyDirectoryVlr: ...\nclass WktCoordinateSystemVlr: ...\n"
        text(tmp_path / "laspy" / "vlrs" / "known.py", classes)
        source = f"import os, signal, time\nclass LasHeader: ...\ndef open(path):\n    {body}\n"
        text(tmp_path / "laspy" / "__init__.py", source)
        text(tmp_path / "lazrs.py", "")
        monkeypatch.syspath_prepend(str(tmp_path))
        header = bytearray(227)
        header[:4] = b"LASF"
        struct.pack_into("<HI", header, 94, 227, 227)
        path = tmp_path / "a.las"
        path.write_bytes(header)
        return path

    return make


@pytest.mark.parametrize(
    ("body", "options", "words"),
    [
        ("os.kill(os.getpid(), signal.SIGSEGV)", {}, ["lazrs", "SIGSEGV", "unpack it to LAS"]),
        ("bytearray(2 << 30)", {"memory_limit": 64 << 20}, ["more memory", "--memory-limit"]),
        ("os.write(2, b'out of luck'); os._exit(3)", {}, ["status 3", "out of luck"]),
        (
            "exec('while True: pass')",
            {"time_limit": 0.5},
            ["longer than 0.5 s of processor time", "--time-limit"],
        ),
        ("time.sleep(600)", {"time_limit": 0.1}, ["1 s without an end", "--time-limit"]),
        # time without a processor does not count
        ("time.sleep(0.8); raise ValueError('whole')", {"time_limit": 0.6}, ["whole"]),
        ("os.write(1, b'chatter'); raise ValueError('odd\\nfile')", {}, ["odd file"]),
    ],
)
def test_read_file_parser_failure_one_line(
    fake_laspy: Callable[[str], Path],
    monkeypatch: pytest.MonkeyPatch,
    body: str,
    options: dict[str, float],
    words: list[str],
) -> None:
    if "while" in body:  # on a busy machine the limit by the clock would come before
        monkeypatch.setattr(reader_module, "_WAITING", 1000.0)
    line = cause(fake_laspy(body), read_file, **options)
    assert all(word in line for word in words)


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere the limit of time ends the child")
def test_read_file_killed_parent_leaves_no_child(
    tmp_path: Path, fake_laspy: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its child ends with it. Its folder is removed, but not the folder of a process that runs."""
    pid_file = tmp_path / "pid"
    path = fake_laspy(f"os.rename(_note(), {str(pid_file)!r}); time.sleep(600)")
    module = tmp_path / "laspy" / "__init__.py"
    note = "def _note():\n    f = os.open('note', os.O_WRONLY | os.O_CREAT)\n"
    note += "    os.write(f, str(os.getpid()).encode()); os.close(f); return 'note'\n"
    module.write_text(module.read_text() + note)
    # No guard for the main module: a spawned child would run this script again.
    script = f"import sys\nsys.path.insert(0, {str(tmp_path)!r})\nfrom hapticdb.mesh import read_file\nread_file({str(path)!r})\n"  # noqa: E501
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(scratch_module, "YOUNG_S", 0.0)
    env = os.environ | {"TMPDIR": str(tmp_path)}
    with child([sys.executable, "-c", script], cwd=tmp_path, env=env) as parent:
        until(pid_file.exists)
        (left,) = tmp_path.glob("hapticdb-parser-*")
        with scratch_folder():
            assert left.exists()
        parser = int(pid_file.read_text())
        parent.kill()  # the parent alone, not its group
        until(lambda: not is_alive(parser))
    with scratch_folder() as own:
        assert not left.exists()
        assert Path(own).exists()
    assert not Path(own).exists()


def test_read_file_interrupt_kills_child(
    fake_laspy: Callable[[str], Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    started: list[Popen[bytes]] = []

    def interrupted(parser: Popen[bytes], _request: object) -> None:
        started.append(parser)
        raise KeyboardInterrupt

    monkeypatch.setattr(reader_module, "_talk", interrupted)
    with pytest.raises(KeyboardInterrupt):
        read_file(fake_laspy("time.sleep(600)"))
    assert started[0].returncode == -signal.SIGKILL


def test_read_file_missing_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=r"pip install 'cascadio"):
        read_file(text(tmp_path / "a.STEP", "ISO-10303-21;"))
