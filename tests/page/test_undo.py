"""People edit on the page: each step is one write, and nothing of another is lost."""

import contextlib
import threading
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import hapticdb
from assemblies import row_of_boxes
from children import TIMEOUT, until
from hapticdb import Environment
from hapticdb.errors import ConflictError, HapticDBError, ObjectNotFoundError, UsageError
from hapticdb.page import database
from hapticdb.page.edits import Edits, PersonsEdits
from hapticdb.store.base import Object
from servers import ENGINES, named, url_on

N_BOXES = 3


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Cubes of 10 cm in a row; beside the file they are imported."""
    folder = tmp_path_factory.mktemp("boxes")
    return row_of_boxes(folder / "e.db", N_BOXES, 0.3).with_suffix(".glb")


@pytest.fixture(params=[None], ids=["sqlite"])
def url(request: pytest.FixtureRequest, file: Path, tmp_path: Path) -> Iterator[str]:
    with url_on(request.param, tmp_path) as where:
        hapticdb.copy_environment(file.with_name("e.db"), where)
        yield where


@pytest.fixture
def env(url: str) -> Iterator[Environment]:
    """Where the edits of all people are written, as on a page."""
    with hapticdb.open(url) as env:
        yield env


@pytest.fixture
def one(env: Environment) -> PersonsEdits:
    return PersonsEdits(env)


@pytest.fixture
def other(env: Environment) -> PersonsEdits:
    return PersonsEdits(env)


def up(z: float) -> NDArray[np.float64]:
    way = np.eye(4)
    way[2, 3] = z
    return way


def nothing_to_undo(person: PersonsEdits) -> None:
    with pytest.raises(UsageError, match="there is nothing to undo"):
        person.undo()


State = dict[int, tuple[str, bytes, bytes, str]]


def state_of(env: Environment) -> State:
    """Everything of every object but its revision: name, place, voxels, attributes."""
    return {
        obj.id: (
            obj.name,
            obj.transform.tobytes(),
            env.voxels(obj.id).tobytes(),
            f"{sorted(obj.attributes.items())} {obj.rows_crc} {obj.distances_crc} {obj.bounds}",
        )
        for obj in env.objects()
    }


@pytest.mark.parametrize("url", ENGINES, indirect=True, ids=named)
def test_undo_each_step_one_write_exact(one: PersonsEdits, env: Environment) -> None:
    states, revisions = [state_of(env)], [env.store.revision()]
    steps: list[Callable[[], object]] = [
        lambda: one.move(env.object(1), up(0.2)),
        lambda: one.move(env.object(1), up(0.1)),
        lambda: one.take_out(env.object(2)),
        lambda: one.move(env.object(3), up(0.1)),
        one.put_back,
    ]
    for step in steps:
        step()
        states.append(state_of(env))
        revisions.append(env.store.revision())
    assert 2 not in states[3]
    assert states[5].keys() == {1, 2, 3}
    assert states[5][2] == states[0][2]
    said = []
    for expected in states[-2::-1]:
        said.append(one.undo())
        assert state_of(env) == expected
        revisions.append(env.store.revision())
    nothing_to_undo(one)
    assert np.diff(revisions).tolist() == [1] * (len(revisions) - 1)
    assert said[2:4] == ["undid: took out 2 (cube1)", "undid: moved 1 (cube0) by 100 mm"]


def test_edits_conflict_of_two_people(
    one: PersonsEdits, other: PersonsEdits, env: Environment
) -> None:
    seen = env.object(1)
    mine = one.move(seen, up(0.1))
    before = state_of(env)
    for step in (partial(other.move, seen, up(0.3)), partial(other.take_out, seen)):
        with pytest.raises(ConflictError, match="cube0: somebody has moved it"):
            step()
        assert state_of(env) == before
    nothing_to_undo(other)
    other.move(env.object(1), up(0.3))
    other.undo()
    assert np.array_equal(env.object(1).transform, mine.transform)


@pytest.mark.parametrize("follows", [False, True])
def test_undo_not_before_edit_of_another(
    one: PersonsEdits, other: PersonsEdits, env: Environment, *, follows: bool
) -> None:
    """Steps of other objects can be undone after that; those of this object before it cannot."""
    one.move(env.object(2), up(0.1))
    one.move(env.object(1), up(0.1))
    theirs = other.move(env.object(1), up(-0.2))
    if follows:
        one.move(env.object(1), up(0.3))
        one.undo()
    else:
        with pytest.raises(ConflictError, match=r"cannot undo .moved 1 .*somebody has moved it"):
            one.undo()
    assert np.array_equal(env.object(1).transform, theirs.transform)
    assert one.undo() == "undid: moved 2 (cube1) by 100 mm"
    nothing_to_undo(one)
    assert np.array_equal(env.object(1).transform, theirs.transform)


def test_edits_object_removed_by_another(
    one: PersonsEdits, other: PersonsEdits, env: Environment
) -> None:
    seen = one.move(env.object(1), up(0.1))
    other.take_out(env.object(1))
    for step in (partial(one.move, seen, up(0.1)), partial(one.take_out, seen), one.undo):
        with pytest.raises(ConflictError, match="cube0: somebody has taken it out"):
            step()
    with pytest.raises(UsageError, match="you have taken no part out"):
        one.put_back()
    other.put_back()
    moved = one.move(env.object(1), up(0.1))
    assert np.array_equal(env.object(1).transform, moved.transform)


def test_undo_removed_part_imported_again(
    one: PersonsEdits, url: str, env: Environment, file: Path
) -> None:
    one.take_out(env.object(3))
    with hapticdb.open(url) as theirs:
        (added,) = theirs.add(file).added
    assert added.id > 3
    with pytest.raises(ConflictError, match="put it back meanwhile"):
        one.undo()
    with pytest.raises(UsageError, match="you have taken no part out"):
        one.put_back()
    nothing_to_undo(one)
    assert [obj.name for obj in env.objects()] == ["cube0", "cube1", "cube2"]


STEPS = st.lists(
    st.tuples(st.integers(0, 1), st.sampled_from(["move", "out", "back", "undo", "look"])),
    max_size=14,
)


@settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(steps=STEPS)
def test_edits_random_steps_of_two_people(env: Environment, steps: list[tuple[int, str]]) -> None:
    """Two people at once, on one object, in any order."""
    people = PersonsEdits(env), PersonsEdits(env)
    seen: list[Object] = [env.object(1)] * 2
    for n, (who, what) in enumerate(steps):
        before, state = env.store.revision(), state_of(env)
        actions: dict[str, Callable[[], object]] = {
            "move": partial(people[who].move, seen[who], up(0.01 * (n + 1))),
            "out": partial(people[who].take_out, seen[who]),
            "back": people[who].put_back,
            "undo": people[who].undo,
            "look": partial(env.object, 1),
        }
        try:
            found = actions[what]()
            assert env.store.revision() == before + (what != "look")
            seen[who] = found if isinstance(found, Object) else seen[who]
        except (ConflictError, ObjectNotFoundError, UsageError):
            assert (env.store.revision(), state_of(env)) == (before, state)
    for person in people:
        if len(env.objects()) < N_BOXES:
            with contextlib.suppress(UsageError):
                person.put_back()
    env.move(1, np.eye(4))
    assert {obj.id for obj in env.objects()} == {1, 2, 3}


def test_edits_asynchronous_one_connection(
    url: str, env: Environment, monkeypatch: pytest.MonkeyPatch
) -> None:
    """And each person has steps of their own."""
    may_go_on = threading.Event()
    opened: list[threading.Thread] = []
    answers: list[object] = []

    def wait_and_open(*args: Any, **options: Any) -> Any:  # noqa: ANN401
        assert may_go_on.wait(TIMEOUT)
        opened.append(threading.current_thread())
        if len(opened) == 1:
            raise HapticDBError("the server is away")
        return hapticdb.open(*args, **options)

    monkeypatch.setattr(database, "open_environment", wait_and_open)
    edits, seen = Edits(url), env.object(1)
    jobs: list[tuple[int, Any]] = [(0, lambda own: own.undo())]
    jobs += [(0, lambda own: own.move(seen, up(0.1))), (1, lambda own: own.undo())]
    jobs += [(0, lambda own: own.undo())]
    try:
        for person, job in jobs:
            edits.submit(person, job, answers.append, answers.append)
        assert (opened, answers) == ([], [])
        may_go_on.set()
        until(lambda: len(answers) == len(jobs))
    finally:
        edits.close()
    assert str(answers[0]) == "the server is away"
    assert str(answers[2]) == "there is nothing to undo"
    assert answers[3] == "undid: moved 1 (cube0) by 100 mm"
    assert len(opened) == 2
    assert len(set(opened)) == 1
