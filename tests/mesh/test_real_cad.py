"""From a CAD file to a force: on real assemblies, or on the sample without them."""

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import hapticdb
from hapticdb import Environment, PointShell
from hapticdb.paper.strategies import STRATEGIES
from hapticdb.sample import write_sample
from hapticdb.store.base import LAYOUTS, Layout
from naive_frame import touch_of_shell

ASSEMBLIES = {
    "demo_vintage_car/vintage_car.glb": 200,
    "assembly_vw_t1/vw_t1.glb": 1428,
    "robot_lekiwi/lekiwi.glb": 42,
}
SAMPLE_PARTS = 217
BITS = 8


@pytest.fixture(
    scope="module",
    params=[
        "robot_lekiwi/lekiwi.glb",
        *(pytest.param(name, marks=pytest.mark.long) for name in ASSEMBLIES if "robot" not in name),
    ],
)
def assembly(
    request: pytest.FixtureRequest,
    test_data: Path | None,
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[Path, int]:
    """A file and its number of parts."""
    name = str(request.param)
    if test_data is not None:
        return test_data / name, ASSEMBLIES[name]
    return write_sample(tmp_path_factory.mktemp("sample"), count=2).car, SAMPLE_PARTS


@pytest.fixture(scope="module")
def environments(
    assembly: tuple[Path, int], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[dict[Layout, Environment]]:
    folder = tmp_path_factory.mktemp("cad")
    opened: dict[Layout, Environment] = {}
    with ExitStack() as closing:
        for layout in LAYOUTS:
            path, grid = folder / f"{layout}.db", hapticdb.GridOptions(bits=BITS, extent=1.6)
            options = hapticdb.ImportOptions(grid=grid, layout=layout)
            assert hapticdb.import_files(path, [assembly[0]], options)[0].status == "imported"
            opened[layout] = closing.enter_context(hapticdb.open(path))
        yield opened


def all_voxels(env: Environment) -> dict[tuple[int, int, int], set[int]]:
    found: dict[tuple[int, int, int], set[int]] = {}
    for obj in env.objects():
        for i, j, k in env.voxels(obj.id).tolist():
            found.setdefault((i, j, k), set()).add(obj.id)
    return found


def scaled_tool(env: Environment, folder: Path) -> tuple[PointShell, NDArray[np.float64]]:
    """The sample's wrench, 24 voxels long, and poses in which it lies across voxels."""
    whole = PointShell.from_file(write_sample(folder, 2).wrench, points=300)
    length = float(np.ptp(whole.points, axis=0).max())
    scale = 24 * env.grid.voxel_size / length
    shell = PointShell(
        points=whole.points * scale, normals=whole.normals, center=whole.center * scale
    )
    centers = env.grid.centers(np.array(sorted(all_voxels(env))))
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, 3] = centers[np.linspace(0, len(centers) - 1, 7).astype(int)[1:-1]]
    return shell, poses


def test_every_instance_becomes_an_object_that_touches_voxels(
    assembly: tuple[Path, int], environments: dict[Layout, Environment]
) -> None:
    objects = environments["brick"].objects()
    assert len(objects) == assembly[1]
    assert [obj.id for obj in objects] == list(range(1, assembly[1] + 1))
    assert len({obj.name for obj in objects}) == assembly[1]
    assert all(obj.voxels > 0 for obj in objects)


def test_strategies_layouts_and_the_plain_set_agree_along_a_path(
    environments: dict[Layout, Environment], tmp_path: Path
) -> None:
    env = environments["brick"]
    plain = all_voxels(env)
    shell, poses = scaled_tool(env, tmp_path)
    n_hits = 0
    for pose in poses:
        wanted = touch_of_shell(plain, env.grid, shell, pose)
        n_hits += len(wanted.hits)
        for each in environments.values():
            for strategy in STRATEGIES:
                touch = each.touch(shell, pose, strategy, law="plane")
                assert touch.hits.tolist() == wanted.hits
                assert [obj.id for obj in touch.objects] == wanted.ids
                assert touch.force.tobytes() == np.array(wanted.force).tobytes()
                assert touch.torque.tobytes() == np.array(wanted.torque).tobytes()
    assert n_hits > 10 * len(poses), "the path touches too little to show anything"
