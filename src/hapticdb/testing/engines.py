"""Tests of an engine's URLs: opening, making, naming, refusing."""

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from hapticdb.errors import EnvironmentExistsError, EnvironmentNotFoundError, UsageError
from hapticdb.grid import Grid
from hapticdb.store.connect import backup_environment, grant, open_store, restore_environment
from hapticdb.store.engines import Engine, SupportsBackup, SupportsGrant, engine_of
from hapticdb.testing.scenes import Case, blob, everything, floor_voxels, write_voxels

ENGINE_CAPABILITIES: dict[str, Any] = {
    "grant": SupportsGrant,
    "backup": SupportsBackup,
}
"""Capabilities that only some engines have, by their names in `EngineContract.lacks`."""


class EngineContract(Case):
    """Tests of what one engine does with URLs. Subclass and override `url`."""

    grid = Grid(0.01, (0, 0, 0), 6)

    def url(self) -> str:
        """URL of an environment that does not exist yet; another one at each call."""
        raise NotImplementedError

    def make(self) -> str:
        """URL of a small environment, which is closed."""
        url = self.url()
        store = self.engine().create(url, self.grid, "brick")
        write_voxels(store, floor_voxels(self.grid), "floor")
        store.close()
        return url

    def engine(self) -> Engine:
        """Engine that the URLs lead to."""
        return engine_of(self.url())

    def test_what_was_made_is_opened(self) -> None:
        """It is opened to read only, and to write."""
        url = self.url()
        assert not self.engine().exists(url)
        self.engine().create(url, self.grid, "voxel").close()
        assert self.engine().exists(url)
        for read_only in (True, False):
            store = open_store(url, read_only=read_only)
            assert (store.grid, store.layout) == (self.grid, "voxel")
            assert store.is_read_only == read_only
            store.close()

    def test_what_is_not_there_is_not_opened(self) -> None:
        """Opening a missing environment does not make it."""
        url = self.url()
        with pytest.raises(EnvironmentNotFoundError):
            self.engine().open(url, read_only=True)
        assert not self.engine().exists(url)

    def test_nothing_is_made_twice(self) -> None:
        """The existing environment stays as it is."""
        url = self.make()
        with pytest.raises(EnvironmentExistsError):
            self.engine().create(url, self.grid, "brick")
        store = self.engine().open(url, read_only=True)
        assert [obj.name for obj in store.objects()] == ["floor"]
        store.close()

    def test_another_environment_stands_beside(self) -> None:
        """Its URL leads only to it."""
        url = self.make()
        other = self.engine().beside(url, "_beside")
        assert not self.engine().exists(other)
        store, first = self.engine().create(other, self.grid, "brick"), open_store(url)
        assert store.identity != first.identity
        first.close()
        store.discard()
        assert not self.engine().exists(other)
        assert self.engine().exists(url)

    @pytest.mark.parametrize("capability", sorted(ENGINE_CAPABILITIES))
    def test_the_engine_has_what_it_does_not_say_to_lack(self, capability: str) -> None:
        """The engine also lacks what `lacks` names, so no test is skipped without need."""
        has_it = isinstance(self.engine(), ENGINE_CAPABILITIES[capability])
        assert has_it != (capability in self.lacks)

    def test_what_the_engine_lacks_is_refused(self) -> None:
        """The message has the URL."""
        url = self.make()
        refusals: dict[str, list[Callable[[], object]]] = {
            "grant": [lambda: grant(url, "anna", "viewer")],
            "backup": [
                lambda: backup_environment(url, "copy.db"),
                lambda: restore_environment("copy.db", url),
            ],
        }
        for capability in self.lacks:
            for refused in refusals[capability]:
                with pytest.raises(UsageError, match=" is on "):
                    refused()

    def test_a_right_is_given_to_a_role_that_is_there(self) -> None:
        """A grant to a missing role does not make the role."""
        self.need("grant")
        engine = self.engine()
        assert isinstance(engine, SupportsGrant)
        with pytest.raises(UsageError, match="no role"):
            engine.grant(self.make(), "nobody of that name", "viewer")

    def test_a_copy_holds_the_same_and_is_put_back(self) -> None:
        """A restore brings back the whole copy, although the environment has changed since."""
        self.need("backup")
        engine = self.engine()
        assert isinstance(engine, SupportsBackup)
        url, copy = self.make(), self.url()
        before = open_store(url)
        expected = everything(before)
        report = engine.back_up(url, copy, replace=False, progress=None)
        assert (report.revision, report.objects) == (1, 1)
        write_voxels(before, blob(1, (20, 20, 20)), "later")
        before.close()
        assert engine.restore(copy, url, progress=None).revision == 1
        for place in (copy, url):
            store = open_store(place, read_only=True)
            assert [obj.name for obj in store.objects()] == ["floor"]
            for found, wanted in zip(everything(store), expected, strict=True):
                np.testing.assert_array_equal(found, wanted)
            store.close()
