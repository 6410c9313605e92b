"""Two people edit one scene: every step is one write, nothing of another is lost, undo is exact."""

import os
from collections.abc import Callable, Iterator
from functools import partial
from itertools import count
from pathlib import Path

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

import hapticdb
from hapticdb import Environment
from hapticdb.edits.editor import Editor
from hapticdb.errors import ConflictError, ObjectNotFoundError, UsageError
from hapticdb.store.postgres.address import with_environment
from hapticdb.store.postgres.schema_of import drop
from hapticdb.store.postgres.store import PostgresStore
from servers import FOUND, base_url, named

N_BOXES = 3


NUMBERS = count()
"""Distinct names of environments on servers."""


@pytest.fixture(scope="module")
def file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Boxes of 10 cm in a row; beside the file they are imported with distances."""
    scene = trimesh.Scene()
    for n in range(N_BOXES):
        placed = np.eye(4)
        placed[0, 3] = 0.3 * n
        box = trimesh.creation.box((0.1, 0.1, 0.1))
        scene.add_geometry(box, node_name=f"box{n}", transform=placed)
    made = tmp_path_factory.mktemp("boxes") / "boxes.glb"
    made.write_bytes(scene.export(file_type="glb"))
    options = hapticdb.ImportOptions(grid=hapticdb.GridOptions(bits=7, extent=4.0))
    hapticdb.import_files(made.with_name("e.db"), [made], options)
    return made


@pytest.fixture(
    params=[None, *FOUND], ids=lambda found: "sqlite" if found is None else named(found)
)
def url(request: pytest.FixtureRequest, file: Path, tmp_path: Path) -> Iterator[str]:
    where = str(tmp_path / "e.db")
    if request.param is not None:
        where = with_environment(base_url(request.param), f"edits_{os.getpid()}_{next(NUMBERS)}")
    hapticdb.copy_environment(file.with_name("e.db"), where)
    yield where
    if request.param is not None:
        with hapticdb.open(where) as env:
            assert isinstance(env.store, PostgresStore)
            drop(env.store._connection)


@pytest.fixture
def one(url: str) -> Iterator[Editor]:
    with Editor(url) as editor:
        yield editor


@pytest.fixture
def other(url: str) -> Iterator[Editor]:
    with hapticdb.open(url) as env:
        yield Editor(env)


@pytest.fixture
def env(url: str) -> Iterator[Environment]:
    with hapticdb.open(url, read_only=True) as env:
        yield env


def has_nothing_to(step: Callable[[], object]) -> None:
    with pytest.raises(UsageError, match="there is nothing to"):
        step()


def shifted(env: Environment, object_id: int, z: float) -> NDArray[np.float64]:
    place = env.object(object_id).transform.copy()
    place[2, 3] += z
    return place


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


def test_every_step_is_one_write_and_is_undone_exactly(one: Editor, env: Environment) -> None:
    states, revisions = [state_of(env)], [env.store.revision()]
    place = shifted(env, 1, 0.2)
    steps: list[Callable[[], object]] = [
        lambda: one.move(1, place),
        lambda: one.move(1, shifted(env, 1, 0.1)),
        lambda: one.take_out(2),
        lambda: one.move(3, shifted(env, 3, 0.1)),
        lambda: one.put_back(2),
    ]
    for step in steps:
        step()
        states.append(state_of(env))
        revisions.append(env.store.revision())
    assert 2 not in states[3]
    assert states[5].keys() == {1, 2, 3}
    assert states[5][2] == states[0][2]
    for expected in states[-2::-1]:
        one.undo()
        assert state_of(env) == expected
        revisions.append(env.store.revision())
    has_nothing_to(one.undo)
    for expected in states[1:]:
        one.redo()
        assert state_of(env) == expected
        revisions.append(env.store.revision())
    has_nothing_to(one.redo)
    assert np.diff(revisions).tolist() == [1] * (len(revisions) - 1)
    assert len(one.history) == 15
    assert one.history[0] == "moved 1 (box0) by 200 mm"
    assert one.history[2] == "took out 2 (box1)"
    assert one.history[5] == "undid: put back 2 (box1)"


def test_the_second_of_two_is_told_and_nothing_is_lost(
    one: Editor, other: Editor, env: Environment
) -> None:
    mine, theirs = shifted(env, 1, 0.1), shifted(env, 1, 0.3)
    one.move(1, mine)
    before = state_of(env)
    for step in (partial(other.move, 1, theirs), partial(other.take_out, 1)):
        with pytest.raises(ConflictError, match="written by another meanwhile"):
            step()
        assert state_of(env) == before
    has_nothing_to(other.undo)
    other.look(1)
    other.move(1, theirs)
    assert np.array_equal(env.object(1).transform, theirs)
    other.undo()
    assert np.array_equal(env.object(1).transform, mine)


def test_an_undo_does_not_take_another_step_back(
    one: Editor, other: Editor, env: Environment
) -> None:
    """Steps of other objects can be undone after that; those of this object cannot."""
    one.move(2, shifted(env, 2, 0.1))
    one.move(1, shifted(env, 1, 0.1))
    one.move(1, shifted(env, 1, 0.1))
    other.look()
    other.move(1, shifted(env, 1, -0.2))
    theirs, revision = env.object(1).transform, env.store.revision()
    with pytest.raises(ConflictError, match=f"cannot undo .moved 1 .*revision {revision}, not"):
        one.undo()
    assert one.history[-1].startswith("cannot undo (moved 1")
    assert np.array_equal(env.object(1).transform, theirs)
    one.undo()
    assert one.history[-1] == "undid: moved 2 (box1) by 100 mm"
    has_nothing_to(one.undo)
    assert np.array_equal(env.object(1).transform, theirs)


@pytest.mark.parametrize("looks_at_all", [False, True])
def test_after_a_look_at_another_step_the_steps_before_it_are_done(
    one: Editor, other: Editor, env: Environment, looks_at_all: bool
) -> None:
    """Neither undo nor redo goes back behind what another has written; other objects' steps do."""
    one.move(2, shifted(env, 2, 0.1))
    one.move(1, shifted(env, 1, 0.1))
    one.move(1, shifted(env, 1, 0.1))
    one.undo()
    other.look()
    other.move(1, shifted(env, 1, -0.2))
    theirs = env.object(1).transform
    one.look(None if looks_at_all else 1)
    has_nothing_to(one.redo)
    one.move(1, shifted(env, 1, 0.3))
    one.undo()
    assert np.array_equal(env.object(1).transform, theirs)
    assert one.undo() == "undid: moved 2 (box1) by 100 mm"
    has_nothing_to(one.undo)
    assert np.array_equal(env.object(1).transform, theirs)


def test_what_another_has_taken_out_is_told(one: Editor, other: Editor, env: Environment) -> None:
    one.move(1, shifted(env, 1, 0.1))
    place = shifted(env, 1, 0.2)
    other.look()
    other.take_out(1)
    revision = env.store.revision()
    for step in (partial(one.move, 1, place), partial(one.take_out, 1), one.undo):
        with pytest.raises(ConflictError, match=rf"taken out by another .*revision {revision}"):
            step()
    with pytest.raises(UsageError, match="not taken out by this editor"):
        one.put_back(1)
    other.put_back(1)
    one.look()
    one.move(1, place)
    assert np.array_equal(env.object(1).transform, place)


def test_what_another_has_imported_again_is_not_put_back(
    one: Editor, url: str, env: Environment, file: Path
) -> None:
    assert [obj.id for obj in one.taken_out] == []
    one.take_out(3)
    assert [obj.name for obj in one.taken_out] == ["box2"]
    with hapticdb.open(url) as theirs:
        (added,) = theirs.add(file).added
    assert added.id > 3
    with pytest.raises(ConflictError, match="put it back meanwhile"):
        one.undo()
    assert one.taken_out == ()
    has_nothing_to(one.undo)
    assert [obj.name for obj in env.objects()] == ["box0", "box1", "box2"]


STEPS = st.lists(
    st.tuples(st.integers(0, 1), st.sampled_from(["move", "out", "back", "undo", "redo", "look"])),
    max_size=14,
)


@pytest.mark.parametrize("url", [None], indirect=True, ids=["sqlite"])
@settings(
    max_examples=15, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
@given(steps=STEPS)
def test_a_refused_step_writes_nothing_and_any_other_writes_once(
    url: str, env: Environment, steps: list[tuple[int, str]]
) -> None:
    """Two people at once, on one object, in any order."""
    with Editor(url) as first, Editor(url) as second:
        for n, (who, what) in enumerate(steps):
            editor = (first, second)[who]
            before, state = env.store.revision(), state_of(env)
            place = np.eye(4)
            place[2, 3] = 0.01 * (n + 1)
            actions: dict[str, Callable[[], object]] = {
                "move": partial(editor.move, 1, place),
                "out": partial(editor.take_out, 1),
                "back": partial(editor.put_back, 1),
                "undo": editor.undo,
                "redo": editor.redo,
                "look": editor.look,
            }
            try:
                actions[what]()
                assert env.store.revision() == before + (what != "look")
            except (ConflictError, ObjectNotFoundError, UsageError):
                assert (env.store.revision(), state_of(env)) == (before, state)
        for obj in (*first.taken_out, *second.taken_out):
            first.look()
            if obj.id not in {one.id for one in env.objects()}:
                (first if obj in first.taken_out else second).put_back(obj.id)
    assert {obj.id for obj in env.objects()} == {1, 2, 3}
