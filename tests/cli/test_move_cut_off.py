"""A move of several objects that is cut off moves none of them; run again, it moves each once."""

import sys
from pathlib import Path

import numpy as np
import pytest

import hapticdb
from children import finished
from command_line import boxes
from hapticdb import GridOptions, ImportOptions
from postgres_servers import Binaries
from servers import FOUND, named, url_on
from validity import assert_valid, contents

CUT_OFF = """
import os, resource, signal, sys
from hapticdb.__main__ import main
from hapticdb.store.tables import Tables

how = sys.argv.pop(1)
log, n_moved = Tables._log, 0

def log_moved(*args):
    global n_moved
    log(*args)
    n_moved += 1
    if n_moved == 2 and how == "full disk":
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
    elif n_moved == 2:
        os.kill(os.getpid(), getattr(signal, how))

Tables._log = log_moved
sys.exit(main())
"""
"""A program: the command line, which meets a signal or a full disk when two objects are written."""


@pytest.mark.parametrize(
    ("engine", "how"),
    [
        *((engine, how) for engine in (None, *FOUND) for how in ("SIGINT", "SIGTERM", "SIGKILL")),
        (None, "full disk"),
    ],
    ids=lambda value: value if isinstance(value, str) else named(value),
)
def test_a_move_cut_off_moves_none(tmp_path: Path, engine: Binaries | None, how: str) -> None:
    with url_on(engine, tmp_path) as url:
        options = ImportOptions(grid=GridOptions(bits=7, extent=3.0))
        hapticdb.import_files(url, [boxes(tmp_path / "boxes.glb")], options)
        with hapticdb.open(url, read_only=True) as env:
            before = contents(env)
            command = ["move", url, "box*", "--translate", "0,0,0.1"]
            done = finished([sys.executable, "-c", CUT_OFF, how, *command])
            codes = {"SIGINT": 130, "SIGTERM": 143, "SIGKILL": -9, "full disk": 2}
            assert (done.returncode, done.stdout) == (codes[how], ""), done.stderr
            assert "Traceback" not in done.stderr
            if how == "SIGINT":
                assert "all that was chosen has moved, or nothing" in done.stderr
            assert contents(env) == before
            finished([sys.executable, "-m", "hapticdb", *command], check=True)
            heights = [obj.transform[2, 3] for obj in env.objects()]
            np.testing.assert_allclose(heights, 0.1)
            assert_valid(env)
