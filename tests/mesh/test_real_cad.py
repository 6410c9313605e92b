"""From a CAD file to objects: real assemblies, or the sample without them."""

from pathlib import Path

import pytest

import hapticdb
from hapticdb import GridOptions, ImportOptions
from hapticdb.sample import write_sample

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
    request: pytest.FixtureRequest, test_data: Path | None, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, int]:
    """A file and its number of parts."""
    name = str(request.param)
    if test_data is not None:
        return test_data / name, ASSEMBLIES[name]
    return write_sample(tmp_path_factory.mktemp("sample"), count=2).car, SAMPLE_PARTS


def test_import_files_real_assembly_all_instances(
    assembly: tuple[Path, int], tmp_path: Path
) -> None:
    file, n_parts = assembly
    options = ImportOptions(grid=GridOptions(bits=BITS), distances=False)
    hapticdb.import_files(tmp_path / "e.db", [file], options)
    with hapticdb.open(tmp_path / "e.db", read_only=True) as env:
        objects = env.objects()
    assert [obj.id for obj in objects] == list(range(1, n_parts + 1))
    assert len({obj.name for obj in objects}) == n_parts
    assert all(obj.voxels > 0 for obj in objects)
