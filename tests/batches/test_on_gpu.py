"""Batches on a GPU: on numba's simulator, since machines that run tests have none."""

import os
import sys
from pathlib import Path

import numpy as np
import pytest
from numba import cuda

from children import finished
from hapticdb import Environment
from hapticdb.errors import MissingExtraError, UsageError
from session.worlds import SIZE, block, cloud, make, poses_in
from voxels import write_voxels

CHECKS = (
    "laws_are_those_of_the_processor",
    "a_law_that_no_kernel_knows_is_felt",
    "a_frame_repeats_bit_for_bit",
    "unknown_is_never_empty",
    "edits_arrive_by_the_slots_that_changed",
    "what_the_table_evicts_leaves_the_gpu",
    "a_pose_that_is_not_rigid_is_refused",
)


@pytest.fixture(scope="module")
def simulated() -> str:
    """Names of the checks that passed, and the error of the first one that failed."""
    script = Path(__file__).with_name("simulated_gpu.py")
    path = os.pathsep.join([str(script.parents[1]), os.environ.get("PYTHONPATH", "")])
    variables = {"NUMBA_ENABLE_CUDASIM": "1", "PYTHONPATH": path}
    done = finished([sys.executable, str(script)], env=os.environ | variables)
    return done.stdout + done.stderr


@pytest.mark.long
@pytest.mark.parametrize("check", CHECKS)
def test_gpu_simulator_equals_cpu(simulated: str, check: str) -> None:
    assert check in simulated.splitlines(), simulated


SEARCH = """
import sys
import hapticdb
from hapticdb.kernels.gpu import gpu_nearest as nearest
from session.worlds import SIZE, cloud, poses_in
sys.setswitchinterval(1e-4)
nearest.THREADS = 2
with hapticdb.open(sys.argv[1], read_only=True) as env:
    poses = poses_in(env.grid, 6, beyond=0.0)
    found = env.clearance(cloud(5), poses, 20 * SIZE, device="cuda")
print(*found.distances, *found.points)
"""


def test_gpu_simulator_nearest_voxels(env: Environment) -> None:
    """As plain Python: the search counts bits by instructions that the simulator does not have."""
    write_voxels(env.store, block((20, 24, 28), (27, 30, 31)), "block")
    shell, poses = cloud(5), poses_in(env.grid, 6, beyond=0.0)
    wanted = env.clearance(shell, poses, 20 * SIZE)
    path = os.pathsep.join([str(Path(__file__).parents[1]), os.environ.get("PYTHONPATH", "")])
    flags = {"NUMBA_ENABLE_CUDASIM": "1", "NUMBA_DISABLE_JIT": "1", "PYTHONPATH": path}
    done = finished([sys.executable, "-c", SEARCH, env.url], env=os.environ | flags, check=True)
    found = list(map(float, done.stdout.split()))
    assert found[:6] == pytest.approx(wanted.distances.tolist(), rel=1e-12)
    assert found[6:] == wanted.points.tolist()
    assert 0 < np.count_nonzero(wanted.points < 0) < 6


@pytest.fixture
def env(tmp_path: Path) -> Environment:
    return make(tmp_path, 6)


def test_batch_tool_no_gpu_or_unknown_device(
    env: Environment, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cuda, "is_available", lambda: False)
    shell, poses = cloud(5), poses_in(env.grid, 2)
    with pytest.raises(MissingExtraError, match=r"no GPU.*pip install .*numba-cuda"):
        env.touch(shell, poses=poses, device="cuda")
    assert len(env.touch(shell, poses=poses)) == 2
    with pytest.raises(UsageError, match="'tpu': choose 'cpu' or 'cuda'"):
        env.batch_tool(cloud(5), device="tpu")  # type: ignore[arg-type]
