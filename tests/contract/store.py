"""The contract: what every engine's store must do; `tests/store/test_contract_*` run it."""

import pytest

from contract.case import Case
from contract.distances import DistancesContract
from contract.reading import ReadingContract
from contract.sharing import SharingContract
from contract.writing import WritingContract
from hapticdb.errors import EnvironmentExistsError, EnvironmentNotFoundError
from hapticdb.grid import Grid
from hapticdb.store.connect import create_store, exists, open_store
from voxels import floor_voxels, write_voxels

GRID = Grid(0.01, (0, 0, 0), 6)


class UrlContract(Case):
    def test_open_store_as_created(self) -> None:
        url = self.new_url()
        assert not exists(url)
        with pytest.raises(EnvironmentNotFoundError):
            open_store(url, read_only=True)
        assert not exists(url)
        create_store(url, GRID, "voxel").close()
        assert exists(url)
        for read_only in (True, False):
            store = open_store(url, read_only=read_only)
            assert (store.grid, store.layout) == (GRID, "voxel")
            assert store.is_read_only == read_only
            store.close()

    def test_create_store_existing(self) -> None:
        url = self.new_url()
        store = create_store(url, GRID)
        write_voxels(store, floor_voxels(GRID), "floor")
        with pytest.raises(EnvironmentExistsError):
            create_store(url, GRID)
        assert [obj.name for obj in store.objects()] == ["floor"]
        store.close()

    def test_create_store_beside_another(self) -> None:
        url = self.new_url()
        other = self.new_url()
        first = create_store(url, GRID)
        assert not exists(other)
        store = create_store(other, GRID)
        assert store.identity != first.identity
        first.close()
        store.discard()
        assert (exists(url), exists(other)) == (True, False)


class StoreContract(
    UrlContract, ReadingContract, WritingContract, DistancesContract, SharingContract
):
    """All tests of the contract, over every layout and curve."""
