"""Hands whose looks are on a GPU: on numba's simulator, since machines that run tests have none."""

import os
import sys
from pathlib import Path

import pytest
from numba import cuda

from children import finished
from hapticdb import PointShell
from hapticdb.errors import MissingExtraError, UsageError
from hapticdb.session.session import Session
from session.hands import still

CHECKS = (
    "a_flat_tool_is_pressed_on_a_plane_and_leaves",
    "no_point_passes_a_sheet",
    "a_hollow_surface_is_felt_and_a_tool_may_begin_in_something",
    "unknown_is_never_empty_and_what_changes_is_felt",
    "a_session_feels_says_where_and_is_replayed",
)


@pytest.fixture(scope="module")
def simulated() -> str:
    """Names of the checks that passed, and the error of the first one that failed."""
    path = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    variables = {"NUMBA_ENABLE_CUDASIM": "1", "PYTHONPATH": path}
    call = "from session.simulated_hands import main; main()"
    done = finished([sys.executable, "-c", call], env=os.environ | variables)
    return done.stdout + done.stderr


@pytest.mark.long
@pytest.mark.parametrize("check", CHECKS)
def test_gpu_queries_simulator_equals_cpu(simulated: str, check: str) -> None:
    assert check in simulated.splitlines(), simulated


@pytest.mark.parametrize(
    ("choices", "told"),
    [
        ({"frames_on": "tpu"}, "'tpu': choose 'cpu' or 'cuda'"),
        ({"frames_on": "cuda", "law": "plane"}, "rendering coupled"),
    ],
)
def test_session_gpu_unsupported_options(choices: dict[str, object], told: str) -> None:
    with pytest.raises(UsageError, match=told):
        Session("none.db", PointShell.sphere(0.01, 10), still(0.03), **choices)  # type: ignore[arg-type]


def test_session_no_gpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cuda, "is_available", lambda: False)
    with pytest.raises(MissingExtraError, match=r"no GPU.*pip install .*numba-cuda"):
        Session("none.db", PointShell.sphere(0.01, 10), still(0.03), frames_on="cuda")
