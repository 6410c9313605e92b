"""Objects' files are read below the operator's folders only."""

import os
from pathlib import Path
from typing import Any

import pytest

from hapticdb.errors import FileError, UsageError
from hapticdb.page.folders import AllowedFolders


@pytest.fixture
def inside(tmp_path: Path) -> Path:
    folder = tmp_path / "inside"
    (folder / "deep").mkdir(parents=True)
    (tmp_path / "secret").write_text("secret")
    (tmp_path / "inside-too").mkdir()
    (tmp_path / "inside-too" / "part.stl").write_text("solid")
    (folder / "part.stl").write_text("solid")
    (folder / "deep" / "part.stl").write_text("solid")
    (folder / "out").symlink_to(tmp_path / "secret")
    (folder / "within").symlink_to(folder / "part.stl")
    (folder / "up").symlink_to(tmp_path)
    (folder / "loop").symlink_to(folder / "loop")
    os.mkfifo(folder / "pipe")
    return folder


@pytest.mark.parametrize("name", ["part.stl", "deep/part.stl", "within", "deep/../part.stl"])
def test_a_file_below_the_folder_is_given_without_symbolic_links(inside: Path, name: str) -> None:
    found = AllowedFolders([inside]).checked(str(inside / name))
    assert found.read_text() == "solid"
    assert found == found.resolve()


@pytest.mark.parametrize(
    "name",
    [
        "../secret",
        "out",
        "up/secret",
        "../inside-too/part.stl",
        "loop",
        "missing",
        "pipe",
        "deep",
        "a\0b",
        "x" * 5000,
    ],
)
def test_every_way_out_is_refused_without_naming_a_path(inside: Path, name: str) -> None:
    with pytest.raises(FileError) as refused:
        AllowedFolders([inside]).checked(str(inside / name))
    assert str(inside.parent) not in str(refused.value)


def test_links_allow_their_folders_as_they_were_at_the_start(inside: Path) -> None:
    allowed = AllowedFolders.of_links([str(inside / "part.stl"), "", "/no/such/folder/part.stl"])
    assert allowed.checked(str(inside / "deep" / "part.stl"))
    with pytest.raises(FileError):
        allowed.checked(str(inside.parent / "secret"))


def test_a_folder_that_is_not_there_is_told(inside: Path) -> None:
    for name in ("missing", "part.stl"):
        with pytest.raises(UsageError, match="--files"):
            AllowedFolders([inside / name])


def test_a_folder_that_may_not_be_entered_adds_none(
    inside: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As of an ordinary user: /home of others, in a service that may not see it."""
    closed = inside.parent / "closed"
    closed.mkdir()
    (closed / "part.stl").write_text("solid")
    links = [str(closed / "part.stl"), str(inside / "part.stl")]
    real = os.stat

    def stat(path: Any, **more: Any) -> os.stat_result:  # noqa: ANN401 - as of os.stat
        if str(path).startswith(str(closed)):
            raise PermissionError(13, "Permission denied", str(path))
        return real(path, **more)

    monkeypatch.setattr(os, "stat", stat)
    allowed = AllowedFolders.of_links(links)
    assert allowed.checked(links[1])
    with pytest.raises(FileError):
        allowed.checked(links[0])
    with pytest.raises(UsageError, match="--files"):
        AllowedFolders([closed])
