"""The verbs view and serve, with mistakes and signals."""

from pathlib import Path

import pytest

import hapticdb
from hapticdb.cli import main
from hapticdb.cli.options import RenderingName
from hapticdb.cli.verbs.serving import PageOptions, _tokens
from hapticdb.cli.verbs.sweeping import MachineOptions
from hapticdb.server.access import Role
from hapticdb.server.lifecycle import _page_request
from hapticdb.session.processes import fork_server


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.db"
    hapticdb.create(path, hapticdb.Grid(0.01, (0.0, 0.0, 0.0), 6)).close()
    return path


@pytest.mark.parametrize(
    ("args", "words"),
    [
        ("--host 192.0.2.1", "--token"), ("--token-file none", "--token-file none"),
        ("--machine none.urdf", "none.urdf: no such file"), ("--joints q.csv", "--machine"),
        ("--tool none.stl", "no such file"), ("--prefix a\tb", "--prefix"),
        ("--tls-cert cert.pem", "--tls-key"), ("--seconds 0", "--seconds"),
        ("--role-url editor=none.db", "none.db"), ("owner=0123456789abcdef", "viewer, toucher"),
        ("editor=short", "tokens, line 1: "), ("editor=short", "16"), ("editor", "ROLE="),
    ],
)  # fmt: skip
def test_view_serve_bad_arguments_start_nothing(
    scene: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    args: str,
    words: str,
) -> None:
    """Also in the file of tokens."""
    started: list[str] = []
    monkeypatch.setattr(fork_server, "prepare", lambda work, _: started.append(work))
    given = args.split(" ")
    if len(given) == 1:
        (tokens := scene.with_name("tokens")).write_text(args)
        given = ["--token-file", str(tokens)]
    assert main(["serve", str(scene), *given]) == 2
    assert not started
    told = capsys.readouterr()
    assert (told.out, len(told.err.splitlines())) == ("", 1)
    assert words in told.err


@pytest.mark.parametrize("verb", ["view", "serve"])
def test_view_serve_coupling_without_distances(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, verb: str
) -> None:
    started: list[str] = []
    monkeypatch.setattr(fork_server, "prepare", lambda work, _: started.append(work))
    path = tmp_path / "plain.db"
    hapticdb.create(path, hapticdb.Grid(0.01, (0.0, 0.0, 0.0), 6), layout="voxel").close()
    assert main([verb, str(path), "--rendering", "coupled", "--seconds", "1"]) == 2
    told = capsys.readouterr()
    assert (told.out, len(told.err.splitlines()), started) == ("", 1, [])
    assert "plain.db has no distances" in told.err
    assert "leave out --rendering coupled" in told.err


def test_tokens_file_with_bom_and_comments(tmp_path: Path) -> None:
    (file := tmp_path / "tokens").write_text(
        "\ufeff# of the workshop\neditor=0123456789abcdef\n\n  # viewer=no\n", "utf-8"
    )
    assert _tokens(str(file), are_made=False) == {"0123456789abcdef": Role.EDITOR}


@pytest.mark.parametrize("rendering", [None, "coupled", "direct"])
def test_serving_rendering_option(scene: Path, rendering: RenderingName | None) -> None:
    machine = MachineOptions(str(scene), at="0,0,1000,1,0,0,0")
    serving = PageOptions(rendering=rendering).serving(str(scene), {}, machine)
    assert serving.rendering == rendering
    request = _page_request(serving, 0, 0, "")
    assert request.is_direct == (rendering == "direct")
    assert request.machine is not None
    assert (request.machine.machine, request.machine.at[2, 3]) == (str(scene), 1.0)
