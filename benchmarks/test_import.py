"""Import of the sample car: from the file to a database that answers, in both layouts.

`object_voxels_per_s` covers the whole import: parsing in a child, voxelizing, writing, statistics.
"""

import shutil
from pathlib import Path

import pytest
from pytest_benchmark.fixture import BenchmarkFixture

import hapticdb
from hapticdb.store.base import LAYOUTS, Layout
from scene import BenchScene


@pytest.mark.parametrize("jobs", [1, 2])
@pytest.mark.parametrize("layout", LAYOUTS)
def test_import(
    benchmark: BenchmarkFixture,
    scene: BenchScene,
    bits: int,
    tmp_path: Path,
    layout: Layout,
    jobs: int,
) -> None:
    options = hapticdb.ImportOptions(
        grid=hapticdb.GridOptions(bits=bits, extent=1.6), layout=layout, jobs=jobs, distances=False
    )
    folder = tmp_path / "car"

    def fresh() -> None:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir()

    def run() -> None:
        (report,) = hapticdb.import_files(folder / "car.db", [scene.files.car], options)
        assert report.status == "imported"

    benchmark.group = "import"
    benchmark.pedantic(run, setup=fresh, rounds=3, warmup_rounds=1)
    with hapticdb.open(folder / "car.db") as env:
        counted = {obj.name: obj.voxels for obj in env.objects()}
        size = env.size()
    wanted = scene.environments[layout]
    assert counted == {obj.name: obj.voxels for obj in wanted.objects()}
    assert size.rows == wanted.size().rows
    voxels = sum(counted.values())
    benchmark.extra_info["object_voxels"] = voxels
    benchmark.extra_info["bytes_per_voxel"] = round(size.bytes / voxels, 2)
    if benchmark.stats is not None:
        per_second = voxels / benchmark.stats.stats.median
        benchmark.extra_info["object_voxels_per_s"] = round(per_second)
