"""Objects are chosen by ids, names and patterns; a shell covers all chosen objects."""

import unicodedata
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import trimesh

import hapticdb
from assemblies import box, write_obj
from hapticdb import Environment
from hapticdb.errors import ObjectNotFoundError, UsageError

NAMES = (
    "wheels/front/tyre",
    "wheels/front/wheel_bolt_1",
    "wheels/rear/tyre",
    "wheels/rear/wheel_bolt_1",
    "Body/hood",
    "Body/door",
    "Body/door/handle",
    "Body/handle[1]",
    "Body/handle1",
    "Body/left,right",
    "7",
    "007",
)


def test_find_names_in_normal_form_c(tmp_path: Path) -> None:
    apart = unicodedata.normalize("NFD", "T\u00fcr/Griff")
    write_obj(tmp_path / "a.obj", {apart: box((0, 0, 0), (0.1, 0.1, 0.1))})
    options = hapticdb.ImportOptions(grid=hapticdb.GridOptions(bits=6))
    hapticdb.import_files(tmp_path / "a.db", [tmp_path / "a.obj"], options)
    with hapticdb.open(tmp_path / "a.db") as env:
        for word in ("T\u00fcr", apart, "T\u00fc*", unicodedata.normalize("NFD", "T\u00fcr/*")):
            assert [obj.id for obj in env.find(word)] == [1]


@pytest.fixture(scope="module")
def car(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Environment]:
    """Cubes of 10 cm in a row along x, 20 cm apart; the name of one is the id of another."""
    folder = tmp_path_factory.mktemp("car")
    cubes = {
        name: box((0.2 * n - 0.05, -0.05, -0.05), (0.2 * n + 0.05, 0.05, 0.05))
        for n, name in enumerate(NAMES)
    }
    write_obj(folder / "car.obj", cubes)
    options = hapticdb.ImportOptions(grid=hapticdb.GridOptions(bits=6))
    (report,) = hapticdb.import_files(folder / "car.db", [folder / "car.obj"], options)
    assert tuple(obj.name for obj in report.added) == NAMES
    with hapticdb.open(folder / "car.db") as env:
        yield env


@pytest.mark.parametrize(
    ("words", "ids"),
    [
        ([7], [7]),
        (["7"], [7]),
        ([np.int64(2), " 2 , 1"], [1, 2]),
        (["3,4", 3, "5"], [3, 4, 5]),
        ([], []),
        # any element of the path; a sub-assembly chooses all objects below it
        (["tyre"], [1, 3]),
        (["wheel*"], [1, 2, 3, 4]),
        (["*bolt*"], [2, 4]),
        (["front"], [1, 2]),
        (["Body"], [5, 6, 7, 8, 9, 10]),
        # from the start of the path
        (["wheels/front"], [1, 2]),
        (["wheels/front/"], [1, 2]),
        (["wheels/*/tyre"], [1, 3]),
        (["Body/door"], [6, 7]),
        (["Body/h*"], [5, 8, 9]),
        # an exact name goes before a pattern, and may contain a comma
        (["handle[1]"], [8]),
        (["handle[12]"], [9]),
        (["left,right"], [10]),
        (["left?right"], [10]),
        (["[7]"], [11]),
        (["name=7"], [11]),
        (["007"], [12]),
        (["007", "7"], [7, 12]),
        (["name=Body/door"], [6, 7]),
        (["hood,tyre,7"], [1, 3, 5, 7]),
        (["[t-z]*,hood"], [1, 2, 3, 4, 5]),
    ],
)
def test_find_words(car: Environment, words: list[int | str], ids: list[int]) -> None:
    assert [obj.id for obj in car.find(*words)] == ids


@pytest.mark.parametrize(
    ("word", "said"),
    [
        (13, "no object 13 in"),
        (-1, "no object -1 in"),
        (1 << 80, "no object"),
        ("9" * 5000, "no object 9999"),
        ("door_left", "no object 'door_left' in"),
        ("hod", "did you mean 'hood'?"),
        ("front/tyre", "no object 'front/tyre' in"),  # not the start of a path
        ("hood,boot", "no object 'boot' in"),
        ("body", "case counts: there is 'Body/hood'"),
        ("bolt", "but 'wheels/front/wheel_bolt_1' and 1 more"),
        ("", "no object ''"),
        ("1,", "no object ''"),
        ("[", "no object"),
    ],
)
def test_find_unknown_word(car: Environment, word: int | str, said: str) -> None:
    with pytest.raises(ObjectNotFoundError) as told:
        car.find("tyre", word)
    assert said in str(told.value)
    assert len(str(told.value)) < 400


def test_environment_shell_of_several_objects(car: Environment) -> None:
    shell = car.shell("wheels/rear", 5, points=600, seed=3, inset=0.0)
    cubes = np.array([0.4, 0.6, 0.8])  # x of the cubes' centres
    nearest = np.abs(shell.points[:, 0, None] - cubes).argmin(axis=1)
    assert np.allclose(np.bincount(nearest), 200, atol=30)
    off = shell.points - np.stack([cubes[nearest], *np.zeros((2, len(shell)))], axis=1)
    assert np.allclose(np.abs(off).max(axis=1), 0.05)
    assert (np.einsum("nk,nk->n", off, shell.normals) < 0).all()
    assert np.allclose(shell.center, (0.6, 0, 0))
    assert shell.is_closed
    again = car.shell(5, "wheels/rear/*", points=600, seed=3, inset=0.0)
    assert np.array_equal(again.points, shell.points)


def test_environment_shell_without_surface(car: Environment, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="name at least one"):
        car.shell()
    cloud = trimesh.PointCloud(np.random.default_rng(0).random((50, 3)))
    (tmp_path / "cloud.ply").write_bytes(cloud.export(file_type="ply"))
    hapticdb.import_files(tmp_path / "cloud.db", [tmp_path / "cloud.ply"])
    with (
        hapticdb.open(tmp_path / "cloud.db", read_only=True) as env,
        pytest.raises(UsageError, match="point cloud, which has no surface"),
    ):
        env.shell("*")


def test_shift_all_or_none(car: Environment) -> None:
    ids = [obj.id for obj in car.find("wheels")]
    before = [obj.transform for obj in car.find("wheels")]
    with pytest.raises(hapticdb.errors.OutsideGridError):
        car.shift([*ids, 11], (2.0, 0, 0))  # only object 11 would leave the grid
    assert all(
        np.array_equal(a.transform, b) for a, b in zip(car.find("wheels"), before, strict=True)
    )
    shifted = car.shift(ids, (0.05, 0, 0.1))
    assert [obj.id for obj in shifted] == ids
    for obj, old in zip(shifted, before, strict=True):
        assert np.allclose(obj.transform[:3, 3] - old[:3, 3], (0.05, 0, 0.1))
    car.shift(ids, (-0.05, 0, -0.1))
    for way in ((1, 2), (1, 2, np.nan), "up"):
        with pytest.raises(UsageError):
            car.shift(ids, way)
