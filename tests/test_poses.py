"""Files of poses: written poses are read back, and an unreadable file is a one-line error."""

import warnings
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from hapticdb.errors import FileError, UsageError
from hapticdb.poses import (
    Order,
    pose_of_row,
    quaternion_of,
    read_poses,
    read_timed_poses,
    rotation_of,
    write_poses,
)

HEADER = "x,y,z,qw,qx,qy,qz\n"


ROWS = HEADER.encode()

components = st.floats(-1.0, 1.0, allow_subnormal=False)
quaternions = arrays(np.float64, (5, 4), elements=components).filter(
    lambda q: bool((np.linalg.norm(q, axis=1) > 1e-3).all())
)


@given(quaternions)
def test_quaternion_of_inverts_rotation_of(q: NDArray[np.float64]) -> None:
    unit = q / np.linalg.norm(q, axis=1, keepdims=True)
    rotation = rotation_of(unit)
    assert np.allclose(rotation @ rotation.transpose(0, 2, 1), np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.det(rotation), 1.0, atol=1e-12)
    assert np.allclose(rotation_of(quaternion_of(rotation)), rotation, atol=1e-12)
    assert np.allclose(np.abs((quaternion_of(rotation) * unit).sum(axis=1)), 1.0, atol=1e-12)


def test_rotation_of_scalar_first_right_handed() -> None:
    quarter = rotation_of([np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)])[0]
    assert np.allclose(quarter @ [1.0, 0.0, 0.0], [0.0, 1.0, 0.0])


@given(quaternions, arrays(np.float64, (5, 3), elements=st.floats(-1e6, 1e6)))
def test_write_poses_round_trip(
    tmp_path_factory: pytest.TempPathFactory, q: NDArray[np.float64], p: NDArray[np.float64]
) -> None:
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, :3, :3] = rotation_of(q / np.linalg.norm(q, axis=1, keepdims=True))
    poses[:, :3, 3] = p
    path = tmp_path_factory.mktemp("poses") / "path.csv"
    write_poses(path, poses)
    assert np.allclose(read_poses(path), poses, rtol=1e-14, atol=1e-12)
    assert [f.name for f in path.parent.iterdir()] == ["path.csv"]


@pytest.mark.parametrize(
    "content",
    [
        b"\xef\xbb\xbfx,y,z,qw,qx,qy,qz\r\n1,2,3,1,0,0,0\r\n",
        b"x,y,z,qw,qx,qy,qz\r1,2,3,1,0,0,0\r",
        b" X , Y,Z,QW,QX,QY,QZ\n\n 1, 2 ,3,1,0,0,0\n\n\n",
        b"time,qw,qx,qy,qz,x,y,z\n9,1,0,0,0,1,2,3\n",
        b"x;y;z;qw;qx;qy;qz\n1,0;2;3;1;0,0;0;0\n",
        b"x\ty\tz\tqw\tqx\tqy\tqz\n1\t2\t3\t1\t0\t0\t0\n",
        "x;y;z;qw;qx;qy;qz\n1;2;3;1;0;0;0\n".encode("utf-16"),
        b'"x","y","z","qw","qx","qy","qz"\n"1","2","3","1","0","0","0"',
    ],
)
def test_read_poses_csv_variants(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "p.csv"
    path.write_bytes(content)
    assert np.array_equal(read_poses(path)[0, :3, 3], [1.0, 2.0, 3.0])


@pytest.mark.parametrize(
    ("content", "says"),
    [
        (b"", "empty"),
        (b" \n\n", "empty"),
        (ROWS, "no poses"),
        (b"1,2,3,1,0,0,0\n", "no header"),
        (b"x,y,z,qw,qx,qy\n1,2,3,1,0,0\n", "lacks qz"),
        (b"x,x,y,z,qw,qx,qy,qz\n1,1,2,3,1,0,0,0\n", "x twice"),
        (ROWS + b"1,2,3,1,0,0,0\n1,2,oh,1,0,0,0\n", "line 3: z is 'oh'"),
        (ROWS + b"1,2,3,1,0,0\n", "line 2: no value for qz"),
        (ROWS + b"1,2,,1,0,0,0\n", "line 2: z is ''"),
        (ROWS + b"nan,2,3,1,0,0,0\n", "line 2: x is nan"),
        (ROWS + b"1,2,3,inf,0,0,0\n", "line 2: qw is inf"),
        (ROWS + b"1,-1e300,3,1,0,0,0\n", "line 2: y is -1e+300 m, farther than any"),
        (ROWS + b"1,2,3,0,0,0,0\n", "line 2: the quaternion"),
        (ROWS + b"1,2,3,1e300,1.7e308,1.7e308,1.7e308\n", "line 2: the quaternion"),
        (b"\x89PNG\r\n\x1a\n\x00\x00\xff\xfe", "no text file"),
        (b"glTF\x02\x00\x00\x00", "no text file"),
        (ROWS + b'"1,2,3,1,0,0,0\n', "line 2"),
    ],
)
def test_read_poses_bad_file(tmp_path: Path, content: bytes, says: str) -> None:
    path = tmp_path / "p.csv"
    path.write_bytes(content)
    with pytest.raises(FileError) as caught:
        read_poses(path)
    message = str(caught.value)
    assert says in message
    assert str(path) in message
    assert "\n" not in message


def test_read_poses_missing_file_and_folder(tmp_path: Path) -> None:
    for path, words in ((tmp_path / "none.csv", "no file of poses"), (tmp_path, "cannot read")):
        with pytest.raises(FileError, match=words):
            read_poses(path)


def test_write_poses_bad_input(tmp_path: Path) -> None:
    for poses in (np.eye(4), np.full((1, 4, 4), np.nan)):
        with pytest.raises(UsageError):
            write_poses(tmp_path / "p.csv", poses)
    with pytest.raises(FileError):
        write_poses(tmp_path / "none" / "p.csv", np.eye(4)[None])
    assert not list(tmp_path.iterdir())


def test_read_timed_poses_optional_times(tmp_path: Path) -> None:
    path = tmp_path / "p.csv"
    path.write_text("T,qw,qx,qy,qz,x,y,z\n-1,2,0,0,0,1,2,3\n0.5,1,0,0,0,4,5,6\n")
    times, poses = read_timed_poses(path)
    assert times is not None
    assert times.tolist() == [-1.0, 0.5]
    assert np.array_equal(poses, read_poses(path))
    assert np.array_equal(poses[:, :3, 3], [[1, 2, 3], [4, 5, 6]])


@pytest.mark.parametrize(
    ("rows", "says"),
    [
        ("0,0,0,1,0,0,0,1\n0,0,0,1,0,0,0,1\n", "t must increase, but 1 follows 1"),
        ("0,0,0,1,0,0,0,2\n0,0,0,1,0,0,0,1\n", "t must increase, but 1 follows 2"),
        ("0,0,0,1,0,0,0,soon\n", "line 2: t is 'soon'"),
        ("0,0,0,1,0,0,0,nan\n", "line 2: t is nan"),
        ("0,0,0,1,0,0,0\n", "line 2: no value for t"),
    ],
)
def test_read_timed_poses_bad_times(tmp_path: Path, rows: str, says: str) -> None:
    path = tmp_path / "p.csv"
    path.write_text("x,y,z,qw,qx,qy,qz,t\n" + rows)
    with pytest.raises(FileError, match=says) as caught:
        read_timed_poses(path)
    assert "\n" not in str(caught.value)
    assert np.isfinite(read_poses(path)).all()


TURN = [0.0, 0.6, 0.0, 0.8]
"""Quaternion qx, qy, qz, qw of a pose at 1, 2, 3."""


@pytest.mark.parametrize(
    ("name", "text", "order"),
    [
        ("tum.txt", "# timestamp tx ty tz qx qy qz qw\n0.5 1 2 3 0 0.6 0 0.8\n", None),
        ("tum.tsv", "0.5\t1\t2\t3\t0\t0.6\t0\t0.8\n", None),
        ("ompl.txt", "1 2 3 0 0.6 0 0.8 \n\n", None),
        ("scalar.txt", "1 2 3 0.8 0 0.6 0\n", "wxyz"),
        ("bare.csv", "1,2,3,0,0.6,0,0.8\n", "xyzw"),
        ("wrong.csv", HEADER + "1,2,3,0,0.6,0,0.8\n", "xyzw"),
        ("named.txt", "qx qy qz qw x y z\n0 0.6 0 0.8 1 2 3\n", None),
    ],
)
def test_read_poses_of_other_programs(
    tmp_path: Path, name: str, text: str, order: Order | None
) -> None:
    (tmp_path / name).write_text(text)
    expected = pose_of_row([1.0, 2.0, 3.0], np.roll(TURN, 1))
    assert np.allclose(read_poses(tmp_path / name, order=order), expected, atol=1e-15)


def test_read_poses_npy(tmp_path: Path) -> None:
    path = tmp_path / "poses.npy"
    expected = np.stack([np.eye(4), pose_of_row([1.0, 2.0, 3.0], np.roll(TURN, 1))])
    np.save(path, expected)
    assert read_poses(path).tobytes() == expected.tobytes()
    assert read_poses(path, unit="mm")[1, :3, 3].tolist() == [1e-3, 2e-3, 3e-3]
    np.save(path, [[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0], [1.0, 2.0, 3.0, 0.8, 0.0, 0.6, 0.0]])
    assert np.allclose(read_poses(path), expected, atol=1e-15)
    np.save(path, [[1, 2, 3, *TURN]])
    assert np.allclose(read_poses(path, order="xyzw"), expected[1:], atol=1e-15)
    with pytest.warns(UserWarning, match="all qw are 0"):
        read_poses(path)
    for wrong, said in (
        (np.eye(4), "the shape"), (np.zeros((0, 7)), "no pose"),
        (np.zeros((1, 7)), "pose 0: the quaternion"), (np.array(["a"]), "<U1"),
    ):  # fmt: skip
        np.save(path, wrong)
        with pytest.raises((FileError, UsageError), match=said):
            read_poses(path)
    path.write_bytes(b"")
    with pytest.raises(FileError, match=r"no \.npy file of numbers"):
        read_poses(path)
    with pytest.raises(UsageError, match="wxyz or xyzw"):
        read_poses(path, order="zyxw")  # type: ignore[arg-type]


UPRIGHT, TURNED = (0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.6, 0.8)
"""Quaternions qx, qy, qz, qw: the identity, and a turn about z."""


@pytest.mark.parametrize(
    ("rows", "is_doubted"),
    [
        ([UPRIGHT, TURNED], True),
        ([TURNED, TURNED], True),
        ([(1, 0, 0, 0), UPRIGHT], False),  # a half turn about z, after no turn
        ([(0, 1, 0, 0)] * 2, False),  # half turns about x, and about y
        ([(0, 0, 1, 0), TURNED], False),
    ],
)
def test_read_poses_quaternion_order_warning(
    tmp_path: Path, rows: list[tuple[float, ...]], is_doubted: bool
) -> None:
    path = tmp_path / "path.csv"
    path.write_text(HEADER + "\n".join(",".join(map(str, (0, 0, 0, *q))) for q in rows))
    for read in (read_poses, read_timed_poses):
        with warnings.catch_warnings(record=True) as told:
            warnings.simplefilter("always")
            read(path)
        assert any("qx,qy,qz,qw?" in str(one.message) for one in told) == is_doubted
