"""A move of several objects that is cut off moves none of them; run again, it moves each once."""

import sys
from pathlib import Path

import numpy as np
import pytest

import hapticdb
from children import finished
from command_line import Run, succeeded
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


CODES = {"SIGINT": 130, "SIGTERM": 143, "SIGKILL": -9, "full disk": 2}


@pytest.mark.parametrize(
    ("engine", "how"),
    [
        *((None, how) for how in CODES),
        *((engine, how) for engine in FOUND for how in ("SIGINT", "SIGKILL")),
    ],
    ids=lambda value: value if isinstance(value, str) else named(value),
)
def test_move_interrupted_is_atomic(
    run: Run, scene: Path, engine: Binaries | None, how: str
) -> None:
    with url_on(engine, scene.parent) as url:
        hapticdb.copy_environment(scene, url)
        with hapticdb.open(url, read_only=True) as env:
            before = contents(env)
            command = ["move", url, "box*", "--translate", "0,0,0.1"]
            done = finished([sys.executable, "-c", CUT_OFF, how, *command])
            assert (done.returncode, done.stdout) == (CODES[how], ""), done.stderr
            assert "Traceback" not in done.stderr
            if how == "SIGINT":
                assert "all have moved, or nothing" in done.stderr
            assert contents(env) == before
            succeeded(run(*command))
            heights = [obj.transform[2, 3] for obj in env.objects()]
            np.testing.assert_allclose(heights, 0.1)
            assert_valid(env)
