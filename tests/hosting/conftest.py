"""A floor for hosted hands."""

from collections.abc import Iterator

import pytest

from banded import write_points
from hapticdb import Environment
from realtime.sessions import floor_points
from realtime.worlds import make


@pytest.fixture(scope="module")
def env(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Environment]:
    """A floor just under z = 0, with distances."""
    with make(tmp_path_factory.mktemp("hosted"), bits=6) as made:
        write_points(made.store, floor_points(31.5), "floor")
        yield made
