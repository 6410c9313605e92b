"""People edit on the page: who comes second is told, and nothing is lost."""

import threading
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import hapticdb
from hapticdb.errors import ConflictError, HapticDBError, UsageError
from hapticdb.page.editing import Edits
from hapticdb.sample.write import write_sample


@pytest.fixture(scope="module")
def sample(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("sample")
    url = str(folder / "car.db")
    options = hapticdb.ImportOptions(grid=hapticdb.GridOptions(bits=7, extent=1.6))
    hapticdb.import_files(url, [write_sample(folder, 10).wrench], options)
    return url


def done(edits: Edits, person: int, job: Any) -> Any:  # noqa: ANN401 - a job's result or error
    """Do a job of a person, and wait for its result or error."""
    found: list[Any] = []
    is_done = threading.Event()

    def keep(result: object) -> None:
        found.append(result)
        is_done.set()

    edits.ask(person, job, keep, keep)
    assert is_done.wait(60.0)
    return found[0]


def test_two_people_who_move_one_part(sample: str) -> None:
    edits = Edits(sample)
    try:
        with hapticdb.open(sample, read_only=True) as env:
            seen = env.objects()[0]
            up = np.eye(4)
            up[2, 3] = 0.002
            said = done(edits, 0, lambda own: own.move(seen, up))
            assert isinstance(said, str)
            assert np.allclose(env.object(seen.id).transform, up @ seen.transform)
            second = done(edits, 1, lambda own: own.move(seen, np.linalg.inv(up)))
            assert isinstance(second, ConflictError)
            assert np.allclose(env.object(seen.id).transform, up @ seen.transform)
            done(edits, 0, lambda own: own.undo())
            assert np.allclose(env.object(seen.id).transform, seen.transform)
            now = env.object(seen.id)
            done(edits, 1, lambda own: own.take_out(now))
            assert env.objects() == []
            assert isinstance(done(edits, 0, lambda own: own.put_back()), UsageError)
            done(edits, 1, lambda own: own.put_back())
            assert [obj.name for obj in env.objects()] == [seen.name]
    finally:
        edits.close()


def test_an_error_does_not_tell_where_the_environment_is(sample: str, tmp_path: Path) -> None:
    edits = Edits(sample)
    try:
        with hapticdb.open(sample, read_only=True) as env:
            gone = replace(env.objects()[0], id=999)
        found = done(edits, 0, lambda own: own.take_out(gone))
    finally:
        edits.close()
    nowhere = done(Edits(str(tmp_path / "none.db")), 0, lambda own: own.undo())
    for error in (found, nowhere):
        assert isinstance(error, HapticDBError)
        assert str(Path(sample).parent) not in str(error)
        assert str(tmp_path) not in str(error)
