"""SIGTERM to `view` and `serve` while somebody records: the recording stays, whole."""

import os
import signal
import sys
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import pytest

import hapticdb
from banded import write_points
from children import TIMEOUT, child, until
from hapticdb import Grid
from hapticdb.recording.file import Recording
from hapticdb.session.replay import replay
from page_person import PagePerson
from serving import browser_at
from voxels import floor_voxels

GRID = Grid(0.01, (0.0, 0.0, 0.0), 6)


@pytest.mark.long
@pytest.mark.parametrize(("verb", "option"), [("serve", "--token"), ("view", "--no-browser")])
def test_serve_view_sigterm_keeps_recording(tmp_path: Path, verb: str, option: str) -> None:
    scene, folder = tmp_path / "scene.db", tmp_path / "recordings"
    with hapticdb.create(scene, GRID) as env:
        floor = floor_voxels(GRID)
        write_points(env.store, floor[floor[:, 2] == floor[:, 2].max()] + 0.5, "floor")
    folder.mkdir()
    command = [
        sys.executable, "-m", "hapticdb", verb, str(scene), option, "--recordings", str(folder),
    ]  # fmt: skip
    with child(command, env=dict(os.environ)) as server:
        assert server.stdout is not None
        lines = [server.stdout.readline() for _ in range(3 if verb == "serve" else 1)]
        address = urlsplit(lines[-1].split()[-1])
        (token,) = parse_qs(address.query)["token"]
        with browser_at(address.netloc, Authorization=f"Bearer {token}") as browser:
            person = PagePerson(browser)
            until(lambda: (person.look(), "Touches nothing" in "".join(person.received))[1])
            person.press("Record")
            until(lambda: (person.look(), _size(folder) > 200_000)[1])
            server.send_signal(signal.SIGTERM)
            assert server.stderr is not None
            told = server.stderr.read()
            assert server.wait(TIMEOUT) == 128 + signal.SIGTERM
    assert "?token=" not in told
    assert "stopped" in told or verb == "view"
    (path,) = _recorded(folder)
    recording = Recording(path)
    assert not recording.n_torn
    with hapticdb.open(scene, read_only=True) as env:
        found = replay(recording, env)
    assert found.is_equal, found.describe()
    assert found.n_frames > 100


def _size(folder: Path) -> int:
    """Bytes of all recordings."""
    return sum(path.stat().st_size for path in _recorded(folder))


def _recorded(folder: Path) -> list[Path]:
    return sorted(folder.glob("*.hdbrec"))
