"""People edit on the page: who comes second is told, and nothing is lost."""

import threading
from typing import Any

import numpy as np
import pytest

import hapticdb
from children import PATIENCE, until
from hapticdb.errors import ConflictError, HapticDBError, UsageError
from hapticdb.page import database
from hapticdb.page.editing import Edits
from hapticdb.sample.write import write_sample
from hapticdb.store.base import Object


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
    assert is_done.wait(PATIENCE)
    return found[0]


def test_each_person_has_undo_of_their_own(sample: str) -> None:
    """What each step and undo does, `test_undo` says."""
    edits = Edits(sample)
    with hapticdb.open(sample, read_only=True) as env:
        (seen,) = env.objects()
        up = np.eye(4)
        up[2, 3] = 0.002
        assert isinstance(done(edits, 0, lambda own: own.move(seen, up)), Object)
        assert isinstance(done(edits, 1, lambda own: own.move(seen, up)), ConflictError)
        assert isinstance(done(edits, 1, lambda own: own.undo()), UsageError)
        done(edits, 0, lambda own: own.undo())
        assert np.allclose(env.object(seen.id).transform, seen.transform)
    edits.close()


def test_no_caller_waits_for_the_database_and_one_connection_serves_all(
    sample: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    may_go_on = threading.Event()
    opened: list[threading.Thread] = []
    answers: list[object] = []

    def wait_and_open(*args: Any, **options: Any) -> Any:  # noqa: ANN401
        assert may_go_on.wait(PATIENCE)
        opened.append(threading.current_thread())
        if len(opened) == 1:
            raise HapticDBError("the server is away")
        return hapticdb.open(*args, **options)

    monkeypatch.setattr(database, "open_environment", wait_and_open)
    edits = Edits(sample)
    try:
        for person in range(3):
            edits.ask(person, lambda own: own.undo(), answers.append, answers.append)
        assert (opened, answers) == ([], [])
        may_go_on.set()
        until(lambda: len(answers) == 3)
    finally:
        edits.close()
    assert str(answers[0]) == "the server is away"
    assert [str(answer) for answer in answers[1:]] == ["there is nothing to undo"] * 2
    assert len(opened) == 2
    assert len(set(opened)) == 1
