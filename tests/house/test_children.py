"""A test run reacts to Ctrl-C however it was started, and leaves nothing however it ends."""

import os
import signal
import sys
from pathlib import Path

import pytest

from children import child, finished, until
from hapticdb.resident.table import is_alive

PATHS = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}


HOLDING = """
import os, subprocess, sys, time
import children, servers
children.begin_run()
server = servers.shared_server(servers.FOUND[0])
asleep = [sys.executable, "-c", "import time; time.sleep(600)"]
apart = subprocess.Popen(asleep, start_new_session=True)
forked = os.fork()
if forked:
    children.end_forked(forked)
    print(server.pid, apart.pid, forked, os.environ[children.RUN], flush=True)
time.sleep(600)
"""


JOINING = """
import sys
from pathlib import Path
import children, servers
children.begin_run(Path(sys.argv[1]))
server = servers.shared_server(servers.FOUND[0])
print(server.pid, flush=True)
"""


@pytest.mark.parametrize(
    "how", [signal.SIGKILL, pytest.param(signal.SIGTERM, marks=pytest.mark.long)], ids=str
)
def test_child_killed_run_leaves_nothing(how: signal.Signals) -> None:
    with child([sys.executable, "-c", HOLDING], env=PATHS, stderr=None) as run:
        assert run.stdout is not None
        *numbers, folder = run.stdout.readline().split()
        pids = list(map(int, numbers))
        assert len(pids) == 3
        assert all(map(is_alive, pids))
        part = finished([sys.executable, "-c", JOINING, folder], env=PATHS, check=True)
        assert int(part.stdout) == pids[0], "one server, which outlives a part of the run"
        assert all(map(is_alive, pids))
        os.kill(run.pid, how)
        until(lambda: not any(map(is_alive, pids)))
        until(lambda: not Path(folder).exists())


def test_child_timeout_kills_group() -> None:
    pids: list[int] = []

    def listen() -> None:
        with child(["sh", "-c", "sleep 600 & echo $!; wait"], timeout=0.5) as process:
            assert process.stdout is not None
            pids.extend(map(int, process.stdout))  # reads until the pipe closes

    with pytest.raises(pytest.fail.Exception, match=r"killed, since it did not end within 0\.5 s"):
        listen()
    (grandchild,) = pids
    until(lambda: not is_alive(grandchild))
