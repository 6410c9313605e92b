"""Ctrl-C at any moment of the command line gives one line and exit code 130."""

import sys
from pathlib import Path

import pytest

from children import finished
from draws import drawn

AT_IMPORT = """
import os, signal, sys, runpy

at, how = int(sys.argv[1]), sys.argv[2]
sys.argv[:] = ["hapticdb", *sys.argv[3:]]
left = None

def interrupt_within(event, args):
    global left
    if event == "import":
        if left is None and args[0] == "hapticdb.cli":
            left = at
        elif left is not None:
            left -= 1
            if left == 0:
                os.kill(os.getpid(), signal.SIGINT)

sys.addaudithook(interrupt_within)
if how == "module":
    runpy.run_module("hapticdb", run_name="__main__", alter_sys=True)
else:
    from hapticdb.__main__ import main
    sys.exit(main())
"""
"""A program: the command line, interrupted in the n-th import after its own module's."""


@pytest.mark.parametrize("at", drawn(range(1, 521), 3))
def test_interrupting_ctrl_c_during_import(scene: Path, at: int) -> None:
    how = "module" if at % 2 else "script"
    done = finished([sys.executable, "-c", AT_IMPORT, str(at), how, "objects", str(scene)])
    if done.returncode == 0:  # there are fewer imports than `at`
        assert at > 150
        assert done.stderr == ""
    else:
        assert (done.returncode, done.stderr) == (130, "hapticdb: interrupted\n")


IN_LLVMLITE = """
import os, signal
from hapticdb import interrupting

interrupting.begin()
interrupting.work()
lines = "given = True\\nos.kill(os.getpid(), signal.SIGINT)\\nnoted = True"
scope = {"os": os, "signal": signal}
try:
    exec(compile(lines, os.sep.join(["", "llvmlite", "binding.py"]), "exec"), scope)
    while True:
        signal.pause()
except KeyboardInterrupt:
    print("noted" in scope)
"""
"""A program that is interrupted between two lines of a module of llvmlite."""


def test_interrupting_ctrl_c_inside_llvmlite_deferred() -> None:
    """Its ``ExecutionEngine.add_module`` gives a module to LLVM, and notes it in the next line."""
    done = finished([sys.executable, "-c", IN_LLVMLITE])
    assert (done.returncode, done.stdout, done.stderr) == (0, "True\n", "")


def test_interrupting_ignored_ctrl_c_stays_ignored(scene: Path) -> None:
    script = f"import signal; signal.signal(2, signal.SIG_IGN)\n{AT_IMPORT}"
    done = finished([sys.executable, "-c", script, "40", "module", "objects", str(scene)])
    assert (done.returncode, done.stderr) == (0, "")


FINALIZED = """
import os, signal, sys, time
from hapticdb import interrupting

class Slow:
    def __del__(self):
        os.kill(os.getpid(), signal.SIGINT)
        time.sleep(0)

interrupting.begin()
interrupting.work()
try:
    Slow()
    time.sleep(30)
except KeyboardInterrupt as error:
    print(f"raised {error}")
"""


def test_interrupting_ctrl_c_in_finalizer_not_lost() -> None:
    done = finished([sys.executable, "-c", FINALIZED])
    assert (done.stdout, done.stderr) == ("raised \n", "")
