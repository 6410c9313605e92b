"""Kept shells: the bits of fresh ones, made anew whenever anything that shapes them has changed."""

import json
import os
import time
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from hapticdb import user_cache
from hapticdb.errors import FileError, UsageError
from hapticdb.pointshell.shell import PointShell
from hapticdb.pointshell.shell_cache import Tool, cached_tool, made_tool
from mesh_files import TRIANGLE, gltf

INSET = 0.002


def ball(path: Path, *, is_open: bool = False) -> Path:
    """A ball of 2 cm, with one triangle too many that has no area; an open one has a hole."""
    made = trimesh.creation.icosphere(3, 0.02)
    faces = np.concatenate([made.faces[is_open:], [[0, 0, 1]]])
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in made.vertices.tolist()]
    lines += [f"f {a} {b} {c}" for a, b, c in (faces + 1).tolist()]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.fixture(scope="module", autouse=True)
def _files_are_parsed_here() -> None:
    """The child that parses a tool has searched the names in it, and no others."""


@pytest.fixture
def file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A tool, in a folder where the cache is empty."""
    (tmp_path / "cache").mkdir()
    monkeypatch.setattr(user_cache, "cache_folder", lambda: tmp_path / "cache")
    return ball(tmp_path / "ball.obj")


@pytest.fixture
def is_read(monkeypatch: pytest.MonkeyPatch) -> Callable[[], bool]:
    """Whether a file of a tool was read since the last call."""
    calls: list[object] = []
    make = PointShell.from_file

    def counted(*args: object, **named: object) -> PointShell:
        calls.append(args)
        return make(*args, **named)  # type: ignore[arg-type]

    def asked() -> bool:
        found = bool(calls)
        calls.clear()
        return found

    monkeypatch.setattr(PointShell, "from_file", counted)
    return asked


def tool(
    file: Path,
    points: int | None = 50,
    unit: str | None = None,
    seed: int = 0,
    inset: float = INSET,
) -> Tool:
    return cached_tool(str(file), points, unit=unit, seed=seed, inset=inset)


def entries() -> list[Path]:
    return sorted(user_cache.entry_of("shells").parent.glob("*"))


@pytest.mark.parametrize("is_open", [False, True])
def test_tool_cache_hit_same_bits(file: Path, is_read: Callable[[], bool], is_open: bool) -> None:
    ball(file, is_open=is_open)
    fresh = made_tool(str(file), 50, unit="mm", seed=3, inset=1e-3 * INSET)
    tool(file, unit="mm", seed=3, inset=1e-3 * INSET)
    assert is_read()
    found = tool(file, unit="mm", seed=3, inset=1e-3 * INSET)
    assert not is_read()
    assert found.length == fresh.length
    assert fresh.shell.defects
    assert fresh.shell.is_closed != is_open
    for field in fields(PointShell):
        one, other = getattr(found.shell, field.name), getattr(fresh.shell, field.name)
        if isinstance(other, np.ndarray):
            assert (one.dtype, one.shape, one.tobytes()) == (
                other.dtype, other.shape, other.tobytes()
            ), field.name  # fmt: skip
            assert not one.flags.writeable
        elif field.name != "surface":
            assert one == other, field.name


def test_tool_cache_key_of_options(file: Path, is_read: Callable[[], bool]) -> None:
    tool(file)
    assert is_read()
    changes: list[dict[str, Any]] = [
        {"points": 51}, {"unit": "ft"}, {"unit": "m"}, {"seed": 1},
        {"inset": np.nextafter(INSET, 1.0)},
    ]  # fmt: skip
    for n, change in enumerate(changes, start=2):
        tool(file, **change)
        assert (is_read(), len(entries())) == (True, n), change


def test_tool_cache_invalidated_by_edits(
    file: Path, is_read: Callable[[], bool], monkeypatch: pytest.MonkeyPatch
) -> None:
    before = tool(file)
    assert is_read()
    file.write_text(file.read_text().replace("f 1 ", "f 2 ", 1))
    after = tool(file)
    assert is_read()
    assert not np.array_equal(before.shell.points, after.shell.points)
    other = ball(file.with_suffix(".OBJ"))  # the bytes of the first one, elsewhere
    assert tool(other).shell.link == str(other)
    assert not is_read()
    monkeypatch.setattr(user_cache, "sources_digest", lambda _: "edited")
    tool(file)
    assert is_read()


def _make_folder(entry: Path) -> None:
    entry.unlink()
    entry.mkdir()


def test_tool_cache_damaged_entry(file: Path, is_read: Callable[[], bool]) -> None:
    before = tool(file)
    damages: list[Callable[[Path], object]] = [
        lambda entry: entry.write_bytes(b""),
        lambda entry: entry.write_bytes(entry.read_bytes()[:-8]),
        lambda entry: entry.write_bytes(entry.read_bytes()[:-1] + b"!"),
        _make_folder,
    ]
    for n, damage in enumerate(damages):
        (entry,) = entries()
        damage(entry)
        is_read()
        assert tool(file).shell.points.tobytes() == before.shell.points.tobytes()
        assert is_read(), n


def test_tool_cache_referenced_files(file: Path, is_read: Callable[[], bool]) -> None:
    inner = json.loads(gltf({}, file.with_name("inner.gltf")).read_text())
    corners = np.concatenate([TRIANGLE.reshape(-1), np.arange(3, dtype=np.uint32).view(np.float32)])
    buffer = file.with_name("corners.bin")
    buffer.write_bytes(corners.tobytes())
    tree = {"buffers": [{"byteLength": buffer.stat().st_size, "uri": buffer.name}]}
    outer = file.with_name("outer.gltf")
    outer.write_text(json.dumps(inner | tree))
    tool(outer, inset=0.0)
    assert is_read()
    length = tool(outer, inset=0.0).length
    assert not is_read()
    corners[:9] *= 2.0
    buffer.write_bytes(corners.tobytes())
    assert tool(outer, inset=0.0).length == 2.0 * length
    assert is_read()
    buffer.unlink()
    with pytest.raises(FileError, match="not beside it"):
        tool(outer, inset=0.0)


def test_tool_cache_missing_file_appears(file: Path) -> None:
    file.write_text("mtllib paint.mtl\n" + file.read_text())
    assert "paint.mtl" in tool(file).shell.defects
    assert "paint.mtl" in tool(file).shell.defects
    file.with_name("paint.mtl").write_text("newmtl red\n")
    assert "paint.mtl" not in tool(file).shell.defects


def test_tool_cache_skips_file_being_written(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "time", lambda: file.stat().st_ctime)
    tool(file)
    assert not entries()


def test_tool_cache_evicts_least_recently_used(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    tool(file)
    (first,) = entries()
    tool(file, seed=1)
    (second,) = set(entries()) - {first}
    monkeypatch.setattr(user_cache, "MOST_BYTES", 2 * first.stat().st_size + 100)
    for entry, age in ((first, 200), (second, 100)):
        os.utime(entry, (0, age))
    tool(file)  # used now
    tool(file, seed=2)
    assert first in entries()
    assert second not in entries()
    assert len(entries()) == 2
    monkeypatch.setattr(user_cache, "MOST_BYTES", 100)
    tool(file, seed=4)  # too large to be kept
    assert len(entries()) == 2


def test_tool_cache_unwritable(file: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(user_cache, "cache_folder", lambda: file)
    assert len(tool(file).shell) == 50

    def no_home() -> Path:
        raise RuntimeError("could not determine home directory")

    monkeypatch.setattr(user_cache, "cache_folder", no_home)
    assert len(tool(file).shell) == 50


def test_tool_cache_bad_arguments(file: Path, tmp_path: Path) -> None:
    tool(file, points=None)
    with pytest.raises(UsageError, match="0 points"):
        tool(file, points=0)
    with pytest.raises(UsageError, match="seed"):
        tool(file, seed=-1)
    for missing in (tmp_path, tmp_path / "none.stl"):
        with pytest.raises(FileError):
            tool(missing)
    pipe = tmp_path / "pipe.stl"
    os.mkfifo(pipe)
    with pytest.raises(FileError, match="no regular file"):
        tool(pipe)
