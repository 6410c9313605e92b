"""Files of poses: a line for each pose, position in metres and unit quaternion.

The header names the columns, ``x,y,z,qw,qx,qy,qz``, in any order. Other columns are ignored, except
``t``, seconds, for `read_timed_poses`. Lines of numbers between blanks need no header: 8 as of TUM,
``t x y z qx qy qz qw``, or 7, without t, as of OMPL's `printAsMatrix`; ``#`` begins a comment. A
.npy file has an array (M, 4, 4), or (M, 7) with the scalar first. Quaternions are normalised; ``q``
and ``-q`` are the same pose. A warning is issued if the columns seem to be in another order than
their names.
"""

import codecs
import csv
import io
import math
import os
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.errors import FileError, UsageError
from hapticdb.tabular.tables import new_file
from hapticdb.units import metres_of

COLUMNS = ("x", "y", "z", "qw", "qx", "qy", "qz")

FARTHEST = 1e9
"""Largest coordinate of a position, metres."""

_HINT = f"expected a header {','.join(COLUMNS)} and one pose a line"

Order = Literal["wxyz", "xyzw"]
"""Order of a quaternion's numbers."""


def as_floats(values: ArrayLike, name: str) -> NDArray[np.float64]:
    """Values as a C-contiguous array of float64, without a copy if they are one.

    Raises `UsageError` for complex numbers, masked arrays, text, lists of unequal lengths.
    """
    if type(values) is np.ndarray and values.dtype == np.float64:
        return values if values.flags.c_contiguous else np.ascontiguousarray(values)
    if isinstance(values, np.ma.MaskedArray):
        raise UsageError(f"{name} that is a masked array: give numbers, or fill it first")
    try:
        given = np.asarray(values)
    except (TypeError, ValueError):
        given = np.empty(0, dtype=object)
    if given.dtype.kind not in "iuf":
        raise UsageError(f"{name} of {given.dtype} values: give an array of real numbers")
    return np.ascontiguousarray(given, dtype=np.float64)


def rotation_of(quaternions: ArrayLike) -> NDArray[np.float64]:
    """Rotation matrices (M, 3, 3) of unit quaternions (M, 4), the scalar first."""
    w, x, y, z = np.asarray(quaternions, dtype=np.float64).reshape(-1, 4).T
    rows = [
        [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)],
        [2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)],
        [2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)],
    ]
    return np.asarray(np.moveaxis(np.array(rows), 2, 0))


def quaternion_of(rotations: ArrayLike) -> NDArray[np.float64]:
    """Unit quaternions (M, 4), the scalar first and not negative, of rotations (M, 3, 3).

    Each of the four products of one component with the whole quaternion is linear in the matrix.
    The longest product is used, so no rotation divides by a small number (Shepperd 1978).
    """
    r = np.asarray(rotations, dtype=np.float64).reshape(-1, 3, 3)
    xx, yy, zz = r[:, 0, 0], r[:, 1, 1], r[:, 2, 2]
    x, y, z = r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]
    xy, xz, yz = r[:, 0, 1] + r[:, 1, 0], r[:, 0, 2] + r[:, 2, 0], r[:, 1, 2] + r[:, 2, 1]
    products = np.array(
        [
            [1.0 + xx + yy + zz, x, y, z],
            [x, 1.0 + xx - yy - zz, xy, xz],
            [y, xy, 1.0 - xx + yy - zz, yz],
            [z, xz, yz, 1.0 - xx - yy + zz],
        ]
    )
    longest = np.argmax(products[np.arange(4), np.arange(4)], axis=0)
    chosen = np.moveaxis(products, 2, 0)[np.arange(len(r)), longest]
    chosen /= np.linalg.norm(chosen, axis=1, keepdims=True)
    return np.asarray(np.where(chosen[:, :1] < 0.0, -chosen, chosen))


def write_poses(path: str | os.PathLike[str], poses: ArrayLike) -> None:
    """Write poses (M, 4, 4), `world_from_tool` in metres, whole or not at all; replaces a file."""
    matrices = as_floats(poses, "poses")
    if matrices.ndim != 3 or matrices.shape[1:] != (4, 4):
        raise UsageError(f"poses must have the shape (M, 4, 4), not {matrices.shape}")
    if not np.isfinite(matrices).all():
        raise UsageError("poses must be finite numbers")
    rows = np.hstack([matrices[:, :3, 3], quaternion_of(matrices[:, :3, :3])]) + 0.0
    lines = [",".join(COLUMNS), *(",".join(f"{value:.15g}" for value in row) for row in rows)]
    with new_file(Path(path), "poses", replaces=True) as part:
        part.write_text("\n".join(lines) + "\n", encoding="ascii", newline="\n")


def read_poses(
    path: str | os.PathLike[str], *, unit: str = "m", order: Order | None = None
) -> NDArray[np.float64]:
    """Poses (M, 4, 4) `world_from_tool`, metres, of a file with positions in `unit`.

    order : of the four numbers of a quaternion, whatever their names; unless given by the header.
    Matrices of a .npy file stay on disk until they are used.
    """
    metres = metres_of(unit)
    if order not in {None, "wxyz", "xyzw"}:
        raise UsageError(f"order {order!r}: give wxyz or xyzw")
    is_array = Path(path).suffix.lower() == ".npy"
    poses = _read_array(path, order) if is_array else poses_of(_read_rows(path, order))
    if metres != 1.0:
        poses[:, :3, 3] *= metres
    return poses


def _read_array(path: str | os.PathLike[str], order: Order | None) -> NDArray[np.float64]:
    """Poses (M, 4, 4) of a .npy file; raises `FileError`."""
    try:
        found = as_floats(np.load(path, mmap_mode="c"), "poses")
    except (EOFError, OSError, ValueError) as error:
        why = getattr(error, "strerror", None) or error
        if "pickle" in str(why):  # numpy takes any other file for one
            why = "it begins as another file"
        raise FileError(f"{path}: no .npy file of numbers: {why}") from None
    if found.shape[1:] not in {(4, 4), (7,)}:
        raise FileError(f"{path}: it has the shape {found.shape}; give (M, 4, 4), or (M, 7)")
    if not len(found):
        raise FileError(f"{path}: it has no pose")
    if found.ndim == 3:
        return found
    names = [*"xyz", *(f"q{one}" for one in order or "wxyz")]
    places = {name: names.index(name) for name in COLUMNS}
    rows = [_pose(row, places, f"{path}, pose {n}") for n, row in enumerate(found.tolist())]
    return poses_of(_ordered(path, np.array(rows), order))


def read_timed_poses(
    path: str | os.PathLike[str],
) -> tuple[NDArray[np.float64] | None, NDArray[np.float64]]:
    """Times (M,), s, ascending, or None, and poses (M, 4, 4) `world_from_tool` of a file."""
    rows = _read_rows(path, optional="t")
    if rows.shape[1] == len(COLUMNS):
        return None, poses_of(rows)
    times = rows[:, -1]
    late = np.flatnonzero(np.diff(times) <= 0.0)
    if len(late):
        first, second = times[late[0]], times[late[0] + 1]
        raise FileError(f"{path}: t must increase, but {second:.9g} follows {first:.9g}; {_HINT}")
    return times.copy(), poses_of(rows)


def pose_of_row(position: ArrayLike, quaternion: ArrayLike) -> NDArray[np.float64]:
    """Pose (4, 4) of a position (3,) and a quaternion (4,), scalar first, of any length but 0."""
    given = as_floats(quaternion, "a quaternion")
    length = float(np.linalg.norm(given))
    if not (length > 1e-9 and math.isfinite(length)):
        raise UsageError(f"the quaternion {given.tolist()} is no rotation")
    row = np.concatenate([as_floats(position, "a position"), given / length])
    return np.asarray(poses_of(row[None])[0])


def row_of_pose(pose: NDArray[np.float64]) -> NDArray[np.float64]:
    """Position and unit quaternion (7,), scalar first, of a pose (4, 4)."""
    return np.concatenate([pose[:3, 3], quaternion_of(pose[:3, :3])[0]])


def poses_of(rows: NDArray[np.float64]) -> NDArray[np.float64]:
    """Poses (M, 4, 4) of rows that begin with position and unit quaternion."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = rotation_of(rows[:, 3:7])
    poses[:, :3, 3] = rows[:, :3]
    return poses


def _read_text(path: Path) -> str:
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise FileError(f"no file of poses at {path}") from None
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror}") from error
    if not content.strip():
        raise FileError(f"{path} is empty; {_HINT}")
    try:
        is_utf_16 = content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE))
        text = content.decode("utf-16" if is_utf_16 else "utf-8-sig")
    except UnicodeDecodeError:
        text = "\0"
    if "\0" in text:
        raise FileError(f"{path} is no text file; {_HINT}")
    return text


def _read_rows(
    path: str | os.PathLike[str], order: Order | None = None, optional: str = ""
) -> NDArray[np.float64]:
    """Numbers (M, 7) by `COLUMNS`, quaternions normalised; (M, 8) with the optional column."""
    text = _read_text(Path(path))
    head = re.sub(r"\A(\s*(#.*)?[\r\n])*", "", text).strip().splitlines()[:1] or [""]
    sign = next((sign for sign in ",;\t " if sign in head[0].strip()), ",")
    if sign != ",":  # as spreadsheets write it with decimal commas
        text = text.replace(",", ".")
    reader = csv.reader(
        io.StringIO(text, newline=""), delimiter=sign, strict=True, skipinitialspace=sign == " "
    )
    places: dict[str, int] = {}
    rows: list[list[float]] = []
    try:
        for fields in reader:
            if not any(field.strip() for field in fields) or fields[0].lstrip().startswith("#"):
                continue
            where = f"{path}, line {reader.line_num}"
            if not places:
                names = _names_of(fields, order or ("xyzw" if sign in "\t " else None))
                places = _columns(names or fields, where, optional, None if names else order)
                if not names:
                    continue
            rows.append(_pose(fields, places, where))
    except csv.Error as error:
        raise FileError(f"{path}, line {reader.line_num}: {error}; {_HINT}") from error
    if not rows:
        raise FileError(f"{path} holds no poses after its header; {_HINT}")
    return _ordered(path, np.array(rows), order)


def _ordered(
    path: str | os.PathLike[str], rows: NDArray[np.float64], order: Order | None
) -> NDArray[np.float64]:
    """Rows as given; a warning if their quaternions seem to be in another order."""
    # a quaternion near the identity is turned by 120 degrees at most
    if order is None and (np.abs(rows[:, 3]) < 1e-9).all() and abs(rows[0, 6]) > 0.5:
        warnings.warn(
            f"{path}: all qw are 0, and the first pose is half a turn from the identity: are the "
            "columns qx,qy,qz,qw? Then read_poses(order='xyzw') reads them",
            stacklevel=4,
        )
    return rows


def _names_of(fields: list[str], order: Order | None) -> list[str]:
    """Names of the columns of a line of 7 or 8 numbers; empty for another one."""
    try:
        numbers = [*map(float, filter(str.strip, fields))]
    except ValueError:
        return []
    names = ["t", *"xyz", *(f"q{one}" for one in order or "")]
    return names[-len(numbers) :] if len(names) == 8 and len(numbers) in {7, 8} else []


def _columns(fields: list[str], where: str, optional: str, order: Order | None) -> dict[str, int]:
    """Index of each of `COLUMNS` in the header, and of the optional column if it is there."""
    names = [field.strip().lower() for field in fields]
    missing = [name for name in COLUMNS if name not in names]
    if len(missing) == len(COLUMNS):
        raise FileError(f"{where}: no header; {_HINT}")
    if missing:
        raise FileError(f"{where}: the header lacks {', '.join(missing)}; {_HINT}")
    wanted = [*COLUMNS, optional] if optional in names else COLUMNS
    doubled = [name for name in wanted if names.count(name) > 1]
    if doubled:
        raise FileError(f"{where}: the header names {', '.join(doubled)} twice; {_HINT}")
    places = {name: names.index(name) for name in wanted}
    turned = sorted(places[name] for name in COLUMNS[3:])
    return places | {f"q{one}": place for one, place in zip(order or "", turned, strict=False)}


def _pose(fields: Sequence[str | float], places: dict[str, int], where: str) -> list[float]:
    """Numbers of one line, all finite, with the quaternion normalised."""
    values: list[float] = []
    for name, place in places.items():
        if place >= len(fields):
            raise FileError(f"{where}: no value for {name}")
        try:
            value = float(fields[place])
        except ValueError:
            raise FileError(
                f"{where}: {name} is {str(fields[place])[:40]!r}, not a number"
            ) from None
        if not math.isfinite(value):
            raise FileError(f"{where}: {name} is {value}, not a finite number")
        if name in {"x", "y", "z"} and abs(value) > FARTHEST:
            raise FileError(f"{where}: {name} is {value:g} m, farther than any place; {_HINT}")
        values.append(value)
    norm = math.hypot(*values[3:7])
    if not (norm > 1e-9 and math.isfinite(norm)):
        raise FileError(f"{where}: the quaternion {values[3:7]} is no rotation")
    return [*values[:3], *(value / norm for value in values[3:7]), *values[7:]]
