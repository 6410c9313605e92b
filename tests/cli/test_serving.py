"""The verbs view and serve, with mistakes and signals."""

import os
import signal
import sys
from pathlib import Path
from urllib.request import urlopen

import pytest

import hapticdb
from children import PATIENCE, child
from hapticdb.cli import main
from hapticdb.cli.root import TERMINATED
from hapticdb.realtime import fork_server


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    path = tmp_path / "scene.db"
    hapticdb.create(path, hapticdb.Grid(0.01, (0.0, 0.0, 0.0), 6)).close()
    return path


@pytest.mark.parametrize(
    ("args", "words"),
    [
        ("--host 192.0.2.1", "--token"), ("--token-file none", "--token-file none"),
        ("--tool none.stl", "no such file"), ("--prefix a\tb", "--prefix"),
        ("--tls-cert cert.pem", "--tls-key"), ("--seconds 0", "--seconds"),
        ("--role-url editor=none.db", "none.db"), ("owner=0123456789abcdef", "viewer, toucher"),
        ("editor=short", "16"), ("editor", "ROLE="),
    ],
)  # fmt: skip
def test_a_mistake_is_one_line_and_starts_nothing(
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


@pytest.mark.long
def test_sigterm_ends_the_server_in_order(scene: Path) -> None:
    command = [sys.executable, "-m", "hapticdb", "serve", str(scene), "--token", "--log-json"]
    with child(command, env=dict(os.environ)) as server:
        assert server.stdout is not None
        assert server.stderr is not None
        lines = [server.stdout.readline().split() for _ in range(3)]
        assert [role for role, _ in lines] == ["viewer", "toucher", "editor"]
        place = lines[0][1].partition("?")[0]
        with urlopen(f"{place}healthz", timeout=PATIENCE) as answer:  # noqa: S310 - our own
            assert b'"status":"ok"' in answer.read()
        server.send_signal(signal.SIGTERM)
        told = server.stderr.read()
        assert server.wait(PATIENCE) == TERMINATED
    assert '"event": "stopped"' in told
    assert "?token=" not in told
