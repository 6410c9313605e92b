"""The address of the page is there before any kernel is; what hands call is compiled meanwhile."""

import os
import signal
import sys
from pathlib import Path

import pytest

from children import PATIENCE, child, until
from hapticdb.hosting.preparing import progress_text
from hapticdb.kernels._cache import IN_WORKER, LENT
from hapticdb.kernels.compiling import Compiled
from hapticdb.resident.table import is_alive
from page_person import PagePerson
from serving import browser_at

HELD_BACK = f"""
import os, pathlib, time
if os.environ.get("{IN_WORKER}"):
    pathlib.Path(__file__).with_name(f"{{os.getpid()}}.pid").touch()
    time.sleep({PATIENCE})
"""
"""A `sitecustomize` that keeps processes from compiling anything."""


def test_the_time_left_is_as_expected_or_told_to_be_longer() -> None:
    """However long no kernel is ready."""
    start = "compiling what the hand needs, once: "
    assert progress_text(Compiled(3, 32), 24.4) == f"{start}3 of 32, about 24 s left"
    assert progress_text(Compiled(0, 1), 0.4) == f"{start}0 of 1, about 1 s left"
    assert progress_text(Compiled(31, 32), -18.0) == f"{start}31 of 32, longer than expected"
    assert progress_text(Compiled(32, 32), 9.0) == f"{start}32 of 32"


@pytest.mark.long
def test_the_page_is_there_before_the_kernels_and_a_closed_server_compiles_no_more(
    environment: Path, tmp_path: Path
) -> None:
    (tmp_path / "sitecustomize.py").write_text(HELD_BACK)
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    known = {k: v for k, v in os.environ.items() if k not in {LENT, "NUMBA_CACHE_DIR"}}
    cold = known | {"XDG_CACHE_HOME": str(tmp_path / "cache"), "PYTHONPATH": path}
    view = [sys.executable, "-m", "hapticdb", "view", str(environment), "--no-browser"]
    with child(view, env=cold) as process:
        assert process.stdout is not None
        place, _, token = process.stdout.readline().strip().partition("/?token=")
        place = place.removeprefix("http://")
        with browser_at(place, Authorization=f"Bearer {token}") as connection:
            person = PagePerson(connection)
            told = "compiling what the hand needs, once: 0 of "
            person.wait_for(told)
            until(lambda: list(tmp_path.glob("*.pid")))
        process.send_signal(signal.SIGTERM)
        _, said = process.communicate(timeout=PATIENCE)
    assert told in said
    compiling = [int(file.stem) for file in tmp_path.glob("*.pid")]
    until(lambda: not any(map(is_alive, compiling)))
