"""Grid: metres <-> voxels <-> keys."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.errors import GridError
from hapticdb.kernels import curves
from hapticdb.kernels.records.rows import GRID
from hapticdb.units import length_text, place_text

CurveName = Literal["z", "hilbert", "lexicographic"]
CURVE_NAMES: tuple[CurveName, ...] = get_args(CurveName)
CURVE_CODES = {"lexicographic": 0, "z": 1, "hilbert": 2}
"""Numbers of the curves, as in `kernels.curves`, without its import of numba."""
MAX_BITS = 21
"""Bits of an axis, at most: three axes fit into the 63 bits of a key."""
BRICK_BITS = 3
"""Bits of an axis within a brick."""
CELL_BITS = 5
"""Bits of an axis within a cell."""
ROOM = 1.6
"""Edge of a fitted grid, in longest sides of the bounding box of all files."""


@dataclass(frozen=True)
class Grid:
    """A cube of ``2^bits`` voxels on each axis, and the order of its keys.

    Voxel (i, j, k) covers ``[i s, (i + 1) s)`` on each axis from the origin: each point has one
    voxel. Surfaces are voxelized with closed boxes.
    """

    voxel_size: float
    """Edge s of a voxel, metres."""
    origin: tuple[float, float, float]
    """Lower corner of voxel (0, 0, 0), metres, world frame."""
    bits: int
    """Bits on each axis, 1 to 21."""
    curve: CurveName = "z"
    """Order of the keys; see `hapticdb.kernels.curves`."""

    def __post_init__(self) -> None:
        if not (math.isfinite(self.voxel_size) and self.voxel_size > 0):
            raise GridError(f"voxel size {self.voxel_size} m: give a positive length")
        if not 1 <= self.bits <= MAX_BITS:
            raise GridError(f"{self.bits} bits an axis: give 1 to {MAX_BITS}")
        if self.curve not in CURVE_CODES:
            raise GridError(f"curve {self.curve!r}: choose one of {', '.join(CURVE_NAMES)}")
        if len(self.origin) != 3 or not all(math.isfinite(x) for x in self.origin):
            raise GridError(f"origin {self.origin}: give three finite coordinates in metres")
        if not all(math.isfinite(x + self.voxel_size * 2.0**self.bits) for x in self.origin):
            raise GridError(f"voxels of {self.voxel_size} m: the grid's far end is no number")
        object.__setattr__(self, "voxel_size", float(self.voxel_size))
        object.__setattr__(self, "origin", tuple(float(x) for x in self.origin))

    @property
    def side(self) -> int:
        """Voxels on each axis."""
        return 1 << self.bits

    @property
    def edge(self) -> float:
        """Edge of the whole cube, metres."""
        return self.voxel_size * self.side

    @property
    def bounds(self) -> NDArray[np.float64]:
        """Lower and upper corner (2, 3), metres, world frame."""
        low = np.array(self.origin)
        return np.stack([low, low + self.edge])

    @property
    def curve_code(self) -> int:
        """Number of the curve, for kernels."""
        return CURVE_CODES[self.curve]

    def for_kernels(self, shift: int) -> NDArray[np.void]:
        """Record () of `records.rows.GRID`, for rows whose keys are shifted by so many bits."""
        numbers = (*self.origin, self.voxel_size, self.side, self.bits, self.curve_code, shift)
        return np.array(numbers, GRID)

    @property
    def is_hierarchical(self) -> bool:
        """Whether a key's leading bits identify the cube around the voxel."""
        return self.curve != "lexicographic"

    def voxels_of(self, points: ArrayLike) -> NDArray[np.int64]:
        """Voxels (N, 3) of points (N, 3) in metres; they may lie outside the grid."""
        scaled = self.to_voxel_units(np.asarray(points, dtype=np.float64))
        return np.floor(scaled).astype(np.int64)

    def to_voxel_units(self, points: NDArray[np.float64]) -> NDArray[np.float64]:
        """Points (..., 3) in metres as multiples of the voxel size from the origin."""
        return np.asarray((points - np.array(self.origin)) / self.voxel_size)

    def centers(self, ijk: ArrayLike) -> NDArray[np.float64]:
        """Centres (N, 3) in metres of voxels (N, 3)."""
        voxels = np.asarray(ijk, dtype=np.int64)
        return np.asarray(np.array(self.origin) + self.voxel_size * (voxels + 0.5))

    def contains(self, ijk: ArrayLike) -> NDArray[np.bool_]:
        """Whether each voxel (N, 3) lies inside the grid, (N,)."""
        voxels = np.asarray(ijk, dtype=np.int64).reshape(-1, 3)
        return np.asarray(np.all((voxels >= 0) & (voxels < self.side), axis=1))

    def encode(self, ijk: ArrayLike) -> NDArray[np.int64]:
        """Keys (N,) of voxels (N, 3); `GridError` for a voxel outside, or not of integers."""
        given = np.asarray(ijk)
        if given.dtype.kind not in "iu" and given.size:
            raise GridError(f"voxels of type {given.dtype}: give integers, as voxels_of returns")
        voxels = given.astype(np.int64).reshape(-1, 3)
        inside = self.contains(voxels)
        if not inside.all():
            bad = voxels[~inside][0].tolist()
            raise GridError(f"voxel {bad} lies outside the grid of {self.side} voxels an axis")
        return curves.encode(voxels, self.bits, self.curve_code)

    def decode(self, keys: ArrayLike) -> NDArray[np.int64]:
        """Voxels (N, 3) of keys (N,); `GridError` for a key outside ``[0, 8^bits)``."""
        given = np.asarray(keys)
        if given.dtype.kind not in "iu" and given.size:
            raise GridError(f"keys of type {given.dtype}: give integers, as encode returns")
        if given.dtype == np.uint64 and given.size and int(given.max()) >= 1 << 63:
            raise GridError(f"a key lies outside the curve of {self.bits} bits an axis")
        values = given.astype(np.int64).reshape(-1)
        if values.size and (values.min() < 0 or int(values.max()) >> (3 * self.bits)):
            raise GridError(f"a key lies outside the curve of {self.bits} bits an axis")
        return curves.decode(values, self.bits, self.curve_code)

    def describe(self) -> str:
        """One line for people: voxels on each axis, voxel size, origin, curve."""
        return (
            f"{self.side}^3 voxels of {length_text(self.voxel_size)}, origin "
            f"{place_text(self.origin, self.voxel_size / 100)} m, {self.curve} order"
        )


@dataclass(frozen=True)
class GridOptions:
    """A user's options for a grid; the others are fitted to the files."""

    bits: int | None = None
    """Bits on each axis; 10 unless the other options determine them."""
    voxel_size: float | None = None
    """Edge of a voxel, metres."""
    extent: float | None = None
    """Edge of the grid in longest sides of the bounding box of all files."""
    origin: Sequence[float] | None = None
    """Lower corner, metres; the grid is centred on the files without it."""
    curve: CurveName | None = None
    """Z-order unless given."""

    def __post_init__(self) -> None:
        if None not in (self.bits, self.voxel_size, self.extent):
            raise GridError("bits, voxel size and extent contradict one another: give two of them")
        if self.extent is not None and not (math.isfinite(self.extent) and self.extent > 0):
            raise GridError(f"extent {self.extent}: give a positive number of longest sides")
        # refuse bad values now, before a file is read
        Grid(
            self.voxel_size if self.voxel_size is not None else 1.0,
            _triple(self.origin) if self.origin is not None else (0.0, 0.0, 0.0),
            self.bits if self.bits is not None else 1,
            self.curve or "z",
        )

    def fit(self, bounds: NDArray[np.float64]) -> Grid:
        """Grid for a scene of bounds (2, 3), metres: a cube, centred unless an origin is given."""
        longest = float((bounds[1] - bounds[0]).max())
        if longest <= 0 and self.voxel_size is None:
            raise GridError("all files are a single point: give --voxel-size")
        center = (bounds[0] + bounds[1]) / 2
        bits, size = self._resolve(longest)
        edge = size * (1 << bits)
        origin = center - edge / 2 if self.origin is None else np.array(_triple(self.origin))
        return Grid(size, _triple(origin), bits, self.curve or "z")

    def _resolve(self, longest: float) -> tuple[int, float]:
        """Bits on each axis and voxel size for a scene with that longest side."""
        wanted = (self.extent or ROOM) * longest
        if self.voxel_size is None:
            bits = self.bits or 10
            return bits, wanted / (1 << bits)
        if self.bits is not None:
            return self.bits, self.voxel_size
        bits = max(1, math.ceil(math.log2(max(wanted / self.voxel_size, 2.0))))
        if bits > MAX_BITS:
            raise GridError(
                f"voxel size {self.voxel_size} m needs {bits} bits an axis for a scene of "
                f"{longest:.6g} m; the most is {MAX_BITS}: give a larger one"
            )
        return bits, self.voxel_size

    def check_matches(self, grid: Grid, bounds: NDArray[np.float64] | None = None) -> None:
        """Refuse options at variance with an existing grid; `extent` needs the file's bounds."""
        differences = []
        if self.bits is not None and self.bits != grid.bits:
            differences.append(f"bits {self.bits} instead of {grid.bits}")
        if self.voxel_size is not None and not _is_close(self.voxel_size, grid.voxel_size):
            differences.append(f"voxel size {self.voxel_size:.9g} instead of {grid.voxel_size:.9g}")
        if self.origin is not None and not np.allclose(
            self.origin, grid.origin, rtol=0, atol=1e-9 * grid.edge
        ):
            differences.append(f"origin {_triple(self.origin)} instead of {grid.origin}")
        if self.curve is not None and self.curve != grid.curve:
            differences.append(f"curve {self.curve} instead of {grid.curve}")
        if self.extent is not None and bounds is not None and not differences:
            fitted = self.fit(bounds)
            if not np.allclose(fitted.origin, grid.origin, rtol=0, atol=1e-9 * grid.edge):
                differences.append(f"origin {fitted.origin} instead of {grid.origin}")
            if not _is_close(fitted.edge, grid.edge):
                differences.append(
                    f"extent {self.extent:g} (an edge of {fitted.edge:.6g} m) instead of an edge "
                    f"of {grid.edge:.6g} m"
                )
        if differences:
            raise GridError(
                f"the environment has another grid: {'; '.join(differences)}; "
                "leave these options out to use its grid"
            )


def corners_of(boxes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Corners (..., 8, 3) of boxes (..., 2, 3), lower and upper corner of each."""
    which = np.stack(np.meshgrid([0, 1], [0, 1], [0, 1]), axis=-1).reshape(-1, 3)
    return np.asarray(boxes[..., which, np.arange(3)])


def _is_close(a: float, b: float) -> bool:
    return math.isclose(a, b, rel_tol=1e-9)


def _triple(values: Sequence[float] | NDArray[np.float64]) -> tuple[float, float, float]:
    if len(values) != 3:
        raise GridError(f"origin {tuple(values)}: give three coordinates in metres")
    x, y, z = (float(v) for v in values)
    return x, y, z
