"""Tests that every engine must pass: the contract suites, and scenes with a closed form.

An engine's tests subclass `StoreContract` and say how a store is made and opened again::

    class TestMyStore(StoreContract):
        lacks = frozenset({"statement", "caches"})

        def make(self, grid, layout, name="environment"):
            return MyStore.create(..., grid, layout)

        def reopen(self, store):
            return MyStore.open(store.url)

They also subclass `EngineContract`, which tests what an engine does with URLs. `lacks` names the
capabilities that the engine lacks. Their tests are skipped, each with its reason; every other
capability is tested. docs/extending.md leads from the first line to a tested engine.

Needs pytest.
"""

from hapticdb.testing.distances import DistancesContract
from hapticdb.testing.engines import ENGINE_CAPABILITIES, EngineContract
from hapticdb.testing.reading import STORE_CAPABILITIES, ReadingContract
from hapticdb.testing.scenes import (
    KINDS,
    blob,
    floor_voxels,
    voxel_object,
    with_distances,
    write_voxels,
)
from hapticdb.testing.sharing import SharingContract, is_noticed
from hapticdb.testing.writing import WritingContract

__all__ = [
    "ENGINE_CAPABILITIES",
    "KINDS",
    "STORE_CAPABILITIES",
    "EngineContract",
    "StoreContract",
    "blob",
    "floor_voxels",
    "is_noticed",
    "voxel_object",
    "with_distances",
    "write_voxels",
]


class StoreContract(ReadingContract, WritingContract, DistancesContract, SharingContract):
    """Tests of one engine's store, over every layout and curve.

    Subclass, override `make` and `reopen`, and name in `lacks` what the engine lacks.
    """
