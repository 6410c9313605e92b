"""An environment to serve."""

from pathlib import Path

import pytest

import hapticdb


@pytest.fixture(scope="session")
def environment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("served") / "scene.db"
    hapticdb.create(path, hapticdb.Grid(0.01, (0.0, 0.0, 0.0), 6)).close()
    return path
