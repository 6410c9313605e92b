"""PointShell: the moving tool as points on its surface, each with a normal into the tool.

A mesh becomes a shell in three steps: orientation of the faces (`orientation`), sampling of points
on them (`kernels.surfaces.blue_noise`), and a sort along a Z-order curve. Successive points are
close in space, so a frame looks up the same brick many times in a row if it contains many points.
"""

import zipfile
from dataclasses import dataclass, field, replace
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb import mesh
from hapticdb.errors import FileError, UsageError
from hapticdb.kernels import curves
from hapticdb.kernels.surfaces import blue_noise
from hapticdb.pointshell.coverage import Ball, points_for
from hapticdb.pointshell.inset import sample_inset
from hapticdb.pointshell.orientation import Surface, orient
from hapticdb.poses import as_floats

MAX_POINTS = 10_000_000
"""Greatest number of points of a shell."""
DEFAULT_POINTS = 300
"""Default number of points of a shell."""
POINT_BYTES, HEAD_BYTES = 56, 1 << 20
"""Bytes of a point in a saved shell, its position, normal and inset; of all else, at most."""
ORDER_BITS = 10
"""Bits of the ordering curve: 2^10 steps along the longest side of the points' AABB."""

FORMAT = "hapticdb.pointshell.shell 1"
"""Name of the file format, stored in a saved shell."""

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PointShell:
    """The tool: points on its surface and unit normals into it.

    `from_mesh` and `from_file` sort the points along a Z-order curve, so neighbours by index are
    mostly close in space. Given arrays and saved shells keep their order.

    Raises `UsageError` for arrays of another shape, not finite, or normals not of unit length.
    """

    points: Floats
    """(N, 3) metres, tool's frame: the file's own, not re-centred."""
    normals: Floats
    """(N, 3) unit normals, into the tool."""
    center: Floats
    """(3,) centre of mass, metres: of a solid of uniform density for a closed surface (overlaps of
    bodies count twice), of the surface for an open one."""
    is_closed: bool = True
    """False if the surface has open edges: its inside is then a guess."""
    link: str = ""
    """Absolute path of the source file."""
    seed: int = 0
    defects: str = ""
    """Defects of that file, in words; not saved."""
    surface: Surface | Ball | None = field(default=None, repr=False)
    """Surface of the points, before their inset; not saved."""
    inset: Floats = field(default_factory=lambda: np.zeros(0), repr=False)
    """(N,) inward distance of each point from the surface, metres; zeros unless given."""
    chord: float = field(default=0.0, repr=False)
    """Chord error of the surface, metres, of STEP and IFC files; not saved."""
    has_unit: bool = field(default=False, repr=False)
    """Whether the caller or the file gave the unit of length; a saved shell is in metres."""
    named: tuple[str, ...] = field(default=(), repr=False)
    """Names of files referenced by that file; not saved."""

    def __post_init__(self) -> None:
        for name, shape in (("points", (-1, 3)), ("normals", (-1, 3)), ("center", (3,))):
            array = _as_floats(getattr(self, name), name)
            if array.ndim != len(shape) or array.shape[-1] != 3:
                raise UsageError(f"a shell's {name} have the shape {array.shape}, not {shape}")
            if name == "normals":  # PostgreSQL treats a product that underflows as an error
                array = np.where(np.abs(array) < 1e-100, 0.0, array)
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if len(self.points) == 0 or len(self.points) != len(self.normals):
            raise UsageError(
                f"a shell of {len(self.points)} points and {len(self.normals)} normals: "
                "give one normal for each of at least one point"
            )
        if np.any(np.abs(np.einsum("nk,nk->n", self.normals, self.normals) - 1.0) > 1e-6):
            raise UsageError("a shell's normals are not of unit length: divide them by their norms")
        inset = _as_floats(self.inset, "inset")
        inset = inset if inset.size else np.zeros(len(self.points))
        if inset.shape != (len(self.points),) or np.any(inset < 0.0):
            raise UsageError("a shell's inset: give 0 m or more for each point, or leave it out")
        inset.flags.writeable = False
        object.__setattr__(self, "inset", inset)

    def __len__(self) -> int:
        return len(self.points)

    def __repr__(self) -> str:
        size = ", ".join(f"{x:.4g}" for x in np.ptp(self.points, axis=0))
        kind = "closed" if self.is_closed else "open"
        return f"PointShell({len(self)} points, {size} m, {kind}, {self.link or 'from no file'})"

    @property
    def outline(self) -> Floats:
        """Positions (P, 3), metres, that span the tool's surface: its corners, if present.

        Else the points, moved back onto the surface by their insets.
        """
        if isinstance(self.surface, Surface):
            return self.surface.triangles.reshape(-1, 3)
        return self.points - self.inset[:, None] * self.normals

    @classmethod
    def from_file(
        cls,
        path: str | PathLike[str],
        points: int | None = None,
        *,
        spacing: float | None = None,
        unit: str | None = None,
        seed: int = 0,
        inset: float = 0.0,
    ) -> "PointShell":
        """Make the shell of all parts of a mesh file together, or load a saved one.

        path : a mesh file, or a shell saved as `.npz`, loaded unchanged
        points : number, 1 to 10^7; 300 unless given. With a spacing, the greatest number; 200,000
            unless given.
        spacing : approximate distance of neighbours, metres; sets the number, at least 300
        unit : of a file without one; metres unless given
        seed : random seed of the points: equal seeds give equal points
        inset : distance by which the points are drawn inward, metres. Give the distance law's
            onset, 1.5 voxels, for contact that begins at the surface; 0 for points on it, to
            preserve clearance. Thin walls, sharp edges and tips are drawn in as far as possible.

        Raises `UsageError` for numbers out of range, or a unit for a saved shell, whose unit is the
        metre; `FileError` for an unreadable file, or one without a surface.
        """
        path = Path(path)
        if path.suffix.lower() == ".npz":
            if unit is not None:
                raise UsageError(f"{path} is a saved shell, in metres: leave out the unit")
            return cls.load(path)
        _check_request(DEFAULT_POINTS if points is None else points, spacing, seed, inset)
        file = mesh.read_file(path, unit=unit)
        parts = [part for part in file.parts if not part.is_cloud]
        if not parts:
            raise FileError(f"{path}: no triangles, only points or nothing; a tool needs a surface")
        triangles = np.concatenate([part.triangles() for part in parts])
        try:
            shell = cls._from_triangles(triangles, points, spacing, seed, inset, file.link)
        except UsageError as error:
            raise FileError(f"{path}: {error}") from None
        found = "; ".join(filter(None, [file.defects.describe(), *file.notes]))
        chord = max(part.placed_chord for part in parts)
        has_unit = unit is not None or file.names_unit
        return replace(shell, defects=found, has_unit=has_unit, chord=chord, named=file.named)

    @classmethod
    def from_mesh(
        cls,
        vertices: ArrayLike,
        faces: ArrayLike,
        points: int | None = None,
        *,
        spacing: float | None = None,
        seed: int = 0,
        inset: float = 0.0,
    ) -> "PointShell":
        """Make the shell of a triangle mesh.

        vertices (V, 3), metres, define the shell's frame; faces (F, 3) are integers, in any order
        and winding; the others are as for `from_file`. Raises `UsageError` for numbers out of
        range, vertices that are not finite, faces with indices out of range, and meshes without
        area.
        """
        _check_request(DEFAULT_POINTS if points is None else points, spacing, seed, inset)
        corners = _as_floats(vertices, "vertices", finite=False)
        indices = np.asarray(faces)
        if corners.ndim != 2 or corners.shape[1] != 3:
            raise UsageError(f"vertices have the shape {corners.shape}, not (V, 3)")
        if indices.ndim != 2 or indices.shape[1] != 3 or indices.dtype.kind not in "iu":
            raise UsageError(f"faces are {indices.dtype} {indices.shape}, not integers (F, 3)")
        if indices.size and (indices.min() < 0 or indices.max() >= len(corners)):
            raise UsageError(f"faces name vertices outside 0 .. {len(corners) - 1}")
        return cls._from_triangles(corners[indices], points, spacing, seed, inset, "")

    @classmethod
    def sphere(cls, radius: float, points: int = 300) -> "PointShell":
        """Make the shell of a sphere about the origin; radius in metres, points spread evenly.

        Raises `UsageError` for numbers out of range.
        """
        _check_request(points, None, 0)
        if not (np.isfinite(radius) and radius > 0):
            raise UsageError(f"a sphere of radius {radius}: give metres above 0")
        outward = fibonacci_sphere(points)
        outward = outward[_curve_order(outward)]
        return cls(outward * radius, -outward, np.zeros(3), surface=Ball(float(radius)))

    @classmethod
    def _from_triangles(
        cls,
        triangles: Floats,
        points: int | None,
        spacing: float | None,
        seed: int,
        inset: float,
        link: str,
    ) -> "PointShell":
        surface = orient(triangles)
        n_points = DEFAULT_POINTS if points is None else points
        if spacing is not None:
            most = 200_000 if points is None else points  # these take a few seconds
            wanted = points_for(float(surface.areas.sum()), spacing)
            n_points = min(max(wanted, DEFAULT_POINTS), most)
        rng = np.random.default_rng(seed)
        if inset > 0.0:
            sampled, face_of, insets = sample_inset(surface, n_points, inset, rng)
        else:
            sampled, face_of = blue_noise.sample_surface(
                surface.triangles, surface.areas, surface.normals, n_points, rng
            )
            insets = np.zeros(n_points)
        order = _curve_order(sampled)
        return cls(
            sampled[order], surface.normals[face_of[order]], surface.center, surface.is_closed,
            link, seed, surface=surface, inset=insets[order],
        )  # fmt: skip

    def save(self, path: str | PathLike[str]) -> None:
        """Write the shell to a `.npz` file of exactly that name; `FileError` if that fails."""
        try:
            with Path(path).open("wb") as file:
                np.savez(
                    file, format=np.array(FORMAT), points=self.points, normals=self.normals,
                    center=self.center, is_closed=np.array(self.is_closed),
                    link=np.array(self.link), seed=np.array(self.seed), inset=self.inset,
                )  # fmt: skip
        except OSError as error:
            raise FileError(f"{path}: cannot write the shell: {error.strerror}") from None

    @classmethod
    def load(cls, path: str | PathLike[str]) -> "PointShell":
        """Read a shell written by `save`; `FileError` for a missing, damaged or other file."""
        try:
            with Path(path).open("rb") as file:
                is_zip = zipfile.is_zipfile(file)
                if is_zip:  # its directory, before anything is unpacked
                    sizes = (one.file_size for one in zipfile.ZipFile(file).infolist())
                    n_points = (sum(sizes) - HEAD_BYTES) // POINT_BYTES
                    if n_points > MAX_POINTS:
                        raise FileError(f"{path}: {n_points} points: a shell has 1 to {MAX_POINTS}")  # noqa: TRY301 - likewise
                file.seek(0)
                saved = np.load(file, allow_pickle=False) if is_zip else {}
                if str(saved.get("format")) != FORMAT:
                    raise FileError(f"{path}: not a saved shell, or of another version")  # noqa: TRY301 - told as it is
                return cls(
                    saved["points"], saved["normals"], saved["center"], bool(saved["is_closed"]),
                    str(saved["link"]), int(saved["seed"]), inset=saved["inset"], has_unit=True,
                )  # fmt: skip
        except FileNotFoundError:
            raise FileError(f"{path}: no such file") from None
        except FileError:
            raise
        except Exception as error:  # noqa: BLE001 - a foreign or damaged zip fails in any way
            cause = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise FileError(f"{path}: not a saved shell, or damaged: {cause}") from None


def _check_request(points: int, spacing: float | None, seed: int, inset: float = 0.0) -> None:
    for number, what in ((points, "points"), (seed, "a seed")):
        if isinstance(number, bool) or not isinstance(number, (int, np.integer)):
            raise UsageError(f"{what} {number!r}: give a whole number")
    if not 1 <= points <= MAX_POINTS:
        raise UsageError(f"{points} points: a shell has 1 to {MAX_POINTS}")
    if seed < 0:
        raise UsageError(f"seed {seed}: give 0 or more")
    if spacing is not None and not (np.isfinite(spacing) and spacing > 0.0):
        raise UsageError(f"a spacing of {spacing} m: give metres above 0")
    if not (np.isfinite(inset) and inset >= 0.0):
        raise UsageError(f"an inset of {inset} m: give 0 or more")


def _as_floats(array: ArrayLike, name: str, *, finite: bool = True) -> Floats:
    """Copy of an array as C-contiguous float64."""
    floats = as_floats(array, name).copy()
    if finite and not np.isfinite(floats).all():
        raise UsageError(f"{name} hold values that are not finite")
    return floats


def _curve_order(points: Floats) -> NDArray[np.intp]:
    """Indices (N,) that sort points (N, 3) along a Z-order curve of cubic steps."""
    low = points.min(axis=0)
    extent = float((points.max(axis=0) - low).max()) or 1.0
    # Half a step less than 2^ORDER_BITS. Planes of a tool often lie at its box's ends, middle and
    # quarters; with a step's border there, rounding errors would decide the order of the points.
    steps = ((points - low) * ((2**ORDER_BITS - 0.5) / extent)).astype(np.int64)
    return np.argsort(curves.encode(steps, ORDER_BITS, curves.Z_ORDER), kind="stable")


def fibonacci_sphere(n_points: int) -> Floats:
    """Points (N, 3) on the unit sphere along a spiral of the golden angle (Fibonacci lattice)."""
    heights = 1 - (2 * np.arange(n_points) + 1) / n_points
    angles = np.pi * (1 + 5**0.5) * np.arange(n_points)
    radii = np.sqrt(1 - heights**2)
    return np.stack([radii * np.cos(angles), radii * np.sin(angles), heights], axis=1)
