"""PointShell: the moving tool as points on its surface, each with a normal into the tool.

A mesh becomes a shell in three steps: its corners are joined where they coincide, each face learns
which of its sides is inside (whatever its winding), and points are spread over the faces.
"""

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from hapticdb import mesh
from hapticdb.errors import FileError, UsageError
from hapticdb.kernels import sampling

MAX_POINTS = 10_000_000
JOIN = 1e-6
"""Corners on open edges are joined up to this part of the bounding box's diagonal."""

FORMAT = "hapticdb.pointshell 1"

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True, eq=False)
class PointShell:
    """The tool: points on its surface and unit normals that point into it.

    Parameters
    ----------
    points : (N, 3)
        Metres, the tool's frame: the file's own, not re-centred.
    normals : (N, 3)
        Unit normals, into the tool.
    center : (3,)
        Centre of mass, metres, the same frame: of a solid of uniform density where the surface is
        closed (bodies that overlap count twice where they do), of the surface where it is open.
    is_closed : bool
        False where the surface has open edges, so that its inside is a guess.
    link : str
        The file that it was made from, absolute; empty if from none.
    seed : int
        The seed of the points' places.

    Raises
    ------
    UsageError
        Arrays of another shape, not finite, or normals that are not of unit length.
    """

    points: Floats
    normals: Floats
    center: Floats
    is_closed: bool = True
    link: str = ""
    seed: int = 0

    def __post_init__(self) -> None:
        for name, shape in (("points", (-1, 3)), ("normals", (-1, 3)), ("center", (3,))):
            array = _as_floats(getattr(self, name), name)
            if array.ndim != len(shape) or array.shape[-1] != 3:
                raise UsageError(f"a shell's {name} have the shape {array.shape}, not {shape}")
            array.flags.writeable = False
            object.__setattr__(self, name, array)
        if len(self.points) == 0 or len(self.points) != len(self.normals):
            raise UsageError(
                f"a shell of {len(self.points)} points and {len(self.normals)} normals: "
                "give one normal for each of at least one point"
            )
        if np.any(np.abs(np.einsum("nk,nk->n", self.normals, self.normals) - 1.0) > 1e-6):
            raise UsageError("a shell's normals are not of unit length: divide them by their norms")

    def __len__(self) -> int:
        return len(self.points)

    @classmethod
    def from_file(
        cls,
        path: str | PathLike[str],
        points: int = 300,
        *,
        unit: str | None = None,
        seed: int = 0,
    ) -> "PointShell":
        """Make the shell of all parts of a mesh file together, or load one that was saved.

        Parameters
        ----------
        path : path
            A mesh file. From a `.npz` the shell is loaded as it was saved, and `points` and `seed`
            are those of the file.
        points : int
            Number of points, 1 to 10^7.
        unit : str, optional
            Unit of a file that names none; metres otherwise.
        seed : int
            Seed of the points' places: equal seeds, equal points.

        Raises
        ------
        UsageError
            Numbers out of range, or a unit for a saved shell, which is in metres.
        FileError
            A file that cannot be read or holds no surface.
        """
        path = Path(path)
        if path.suffix.lower() == ".npz":
            if unit is not None:
                raise UsageError(f"{path} is a saved shell, in metres: leave out the unit")
            return cls.load(path)
        _check_request(points, seed)
        file = mesh.read_file(path, unit=unit)
        parts = [part for part in file.parts if not part.is_cloud]
        if not parts:
            raise FileError(f"{path}: no triangles, only points or nothing; a tool needs a surface")
        triangles = np.concatenate([part.triangles() for part in parts])
        try:
            return cls._from_triangles(triangles, points, seed, file.link)
        except UsageError as error:
            raise FileError(f"{path}: {error}") from None

    @classmethod
    def from_mesh(
        cls, vertices: ArrayLike, faces: ArrayLike, points: int = 300, *, seed: int = 0
    ) -> "PointShell":
        """Make the shell of a triangle mesh.

        Parameters
        ----------
        vertices : (V, 3)
            Metres; they define the shell's frame.
        faces : (F, 3)
            Vertices of each triangle, in any order and winding.
        points, seed : int
            As for `from_file`.

        Raises
        ------
        UsageError
            Numbers out of range, vertices not finite, faces that name no vertex, no area.
        """
        _check_request(points, seed)
        corners = _as_floats(vertices, "vertices", finite=False)
        indices = np.asarray(faces)
        if corners.ndim != 2 or corners.shape[1] != 3:
            raise UsageError(f"vertices have the shape {corners.shape}, not (V, 3)")
        if indices.ndim != 2 or indices.shape[1] != 3 or indices.dtype.kind not in "iu":
            raise UsageError(f"faces are {indices.dtype} {indices.shape}, not integers (F, 3)")
        if indices.size and (indices.min() < 0 or indices.max() >= len(corners)):
            raise UsageError(f"faces name vertices outside 0 .. {len(corners) - 1}")
        return cls._from_triangles(corners[indices], points, seed, "")

    @classmethod
    def _from_triangles(cls, triangles: Floats, points: int, seed: int, link: str) -> "PointShell":
        surface = _orient(triangles)
        places, face_of = sampling.sample_surface(
            surface.triangles, surface.areas, surface.normals, points, np.random.default_rng(seed)
        )
        return cls(places, surface.normals[face_of], surface.center, surface.is_closed, link, seed)

    def save(self, path: str | PathLike[str]) -> None:
        """Write the shell to a `.npz` file of exactly that name.

        Raises
        ------
        FileError
            The file cannot be written.
        """
        try:
            with Path(path).open("wb") as file:
                np.savez(
                    file,
                    format=np.array(FORMAT),
                    points=self.points,
                    normals=self.normals,
                    center=self.center,
                    is_closed=np.array(self.is_closed),
                    link=np.array(self.link),
                    seed=np.array(self.seed),
                )
        except OSError as error:
            raise FileError(f"{path}: cannot write the shell: {error.strerror}") from None

    @classmethod
    def load(cls, path: str | PathLike[str]) -> "PointShell":
        """Read a shell that `save` wrote.

        Raises
        ------
        FileError
            The file is missing, damaged, or no saved shell.
        """
        try:
            with Path(path).open("rb") as file, np.load(file, allow_pickle=False) as saved:
                _check_format(saved, path)
                return cls(
                    saved["points"],
                    saved["normals"],
                    saved["center"],
                    bool(saved["is_closed"]),
                    str(saved["link"]),
                    int(saved["seed"]),
                )
        except FileNotFoundError:
            raise FileError(f"{path}: no such file") from None
        except FileError:
            raise
        except Exception as error:  # noqa: BLE001 - a foreign or damaged zip fails in any way
            cause = str(error).splitlines()[0] if str(error) else type(error).__name__
            raise FileError(f"{path}: not a saved shell, or damaged: {cause}") from None


class _Surface(NamedTuple):
    """Triangles whose inside is known: what points are spread over."""

    triangles: Floats  # (F, 3, 3), none twice
    areas: Floats  # (F,), zero where degenerate
    normals: Floats  # (F, 3), into the tool
    center: Floats  # (3,)
    is_closed: bool


class _Edges(NamedTuple):
    """Edges of the faces (F, 3) of a topology, every edge of a face with a number of its own."""

    number: Ints  # (3 F,) edge of each face's side: corners 0 1, 1 2, 2 0
    is_forward: NDArray[np.bool_]  # (3 F,) whether the side runs from the lesser corner on
    uses: Ints  # (E,) faces at each edge


def _check_request(points: int, seed: int) -> None:
    if not 1 <= points <= MAX_POINTS:
        raise UsageError(f"{points} points: a shell has 1 to {MAX_POINTS}")
    if seed < 0:
        raise UsageError(f"seed {seed}: give 0 or more")


def _check_format(saved: object, path: str | PathLike[str]) -> None:
    if not isinstance(saved, np.lib.npyio.NpzFile) or str(saved.get("format")) != FORMAT:
        raise FileError(f"{path}: not a saved shell, or of another version")


def _as_floats(array: ArrayLike, name: str, *, finite: bool = True) -> Floats:
    """Copy an array as C-contiguous float64."""
    try:
        floats = np.array(array, dtype=np.float64, order="C")
    except (TypeError, ValueError):
        raise UsageError(f"{name} are no array of numbers") from None
    if finite and not np.isfinite(floats).all():
        raise UsageError(f"{name} hold values that are not finite")
    return floats


def _edges_of(faces: Ints) -> _Edges:
    tail, head = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    keys = np.minimum(tail, head) * (faces.max(initial=0) + 1) + np.maximum(tail, head)
    _, number, uses = np.unique(keys, return_inverse=True, return_counts=True)
    return _Edges(number.astype(np.int64), tail < head, uses.astype(np.int64))


def _join_corners(triangles: Floats) -> Ints:
    """Corners (F, 3) by number, equal where they coincide: files such as STL do not say.

    Corners that are equal to the bit are one. Where that leaves open edges, their corners are
    joined within `JOIN`, too: two parts' roundings of one edge.
    """
    corners = triangles.reshape(-1, 3) + 0.0  # -0.0 is 0.0
    order = np.lexsort(corners.T)
    is_new = np.ones(len(corners), dtype=bool)
    is_new[1:] = (corners[order[1:]] != corners[order[:-1]]).any(axis=1)
    number = np.empty(len(corners), dtype=np.int64)
    number[order] = np.cumsum(is_new) - 1
    faces = number.reshape(-1, 3)
    edges = _edges_of(faces)
    is_open = (edges.uses == 1)[edges.number]
    if not is_open.any():
        return faces
    loose = np.unique(
        np.concatenate((faces.ravel()[is_open], np.roll(faces, -1, axis=1).ravel()[is_open]))
    )
    places = corners[order[is_new]]
    tolerance = JOIN * float(np.linalg.norm(np.ptp(places, axis=0)))
    pairs = loose[cKDTree(places[loose]).query_pairs(tolerance, output_type="ndarray")]
    return _components(pairs, len(places))[faces]


def _components(pairs: Ints, n: int) -> Ints:
    """Component (n,) of each node of the graph with those edges (E, 2)."""
    ones = np.ones(len(pairs), dtype=np.int8)
    graph = coo_array((ones, (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    labels: Ints = connected_components(graph, directed=False)[1].astype(np.int64)
    return labels


def _neighbours(number: Ints, sides: Ints) -> Ints:
    """Pairs (P, 2) of the given sides that lie on one edge, each with the next."""
    order = sides[np.argsort(number[sides], kind="stable")]
    is_pair = number[order[1:]] == number[order[:-1]]
    return np.stack((order[:-1][is_pair], order[1:][is_pair]), axis=1)


def _drop_repeated(faces: Ints) -> Ints:
    """Faces to keep, by number, ascending: each set of corners once.

    Bodies glued together may have the wall between them twice. Once would leave them open there, so
    a patch of repeated faces goes altogether where more of its border would be open than closed.
    """
    is_face = (faces != np.roll(faces, -1, axis=1)).all(axis=1)
    whole = np.flatnonzero(is_face)
    if len(whole) == 0:
        return whole
    _, first, counts = np.unique(
        np.sort(faces[whole], axis=1), axis=0, return_index=True, return_counts=True
    )
    kept = whole[np.sort(first)]
    is_even = (counts % 2 == 0)[np.argsort(first)]
    if not is_even.any():
        return kept
    edges = _edges_of(faces[kept])
    sides = np.flatnonzero(np.repeat(is_even, 3))
    pairs = _neighbours(edges.number, sides)
    patch = _components(pairs // 3, len(kept))
    within = np.bincount(edges.number[sides], minlength=len(edges.uses))
    is_border = (within == 1) & (edges.uses > 1)
    border = sides[is_border[edges.number[sides]]]
    is_odd = edges.uses[edges.number[border]] % 2 == 1
    lean = np.bincount(patch[border // 3], np.where(is_odd, 1.0, -1.0), len(kept))
    is_wall: NDArray[np.bool_] = is_even & (lean[patch] > 0.0)
    return kept[~is_wall]


def _wind(faces: Ints, edges: _Edges) -> tuple[Ints, NDArray[np.bool_]]:
    """Patches of faces that hang together by edges of two faces, and a winding that agrees in each.

    Returns the patch (F,) of each face and whether the face is to be flipped (F,). A patch that has
    one side only (Moebius) falls into single faces.
    """
    n = len(faces)
    pairs = _neighbours(edges.number, np.flatnonzero((edges.uses == 2)[edges.number]))
    f, g = pairs[:, 0] // 3, pairs[:, 1] // 3
    # The double cover: node f is the face as it stands, node n + f the face flipped.
    agrees = edges.is_forward[pairs[:, 0]] != edges.is_forward[pairs[:, 1]]
    links = np.concatenate(
        (
            np.stack((f, np.where(agrees, g, g + n)), axis=1),
            np.stack((f + n, np.where(agrees, g + n, g)), axis=1),
        )
    )
    sheet = _components(links, 2 * n)
    is_one_sided = sheet[:n] == sheet[n:]
    patch = np.minimum(sheet[:n], sheet[n:])
    is_flipped = (sheet[:n] > sheet[n:]) & ~is_one_sided
    patch[is_one_sided] = 2 * n + np.flatnonzero(is_one_sided)
    return np.unique(patch, return_inverse=True)[1].astype(np.int64), is_flipped


class _Sides(NamedTuple):
    """Faces in the course of learning which of their sides is inside, about a common origin."""

    triangles: Floats  # (F, 3, 3)
    centroids: Floats  # (F, 3)
    normals: Floats  # (F, 3) unit, by a winding that agrees in each patch; zero where degenerate
    areas: Floats  # (F,)
    patch: Ints  # (F,)
    body: Ints  # (F,) 0 all open bodies together, then the closed ones
    is_flipped: NDArray[np.bool_]  # (F,) whether the file winds the face the other way


def _orient(triangles: Floats) -> _Surface:
    """Find for each triangle (F, 3, 3) the side that is inside, whatever its winding.

    Faces that hang together get one winding, and lines through them vote on the side (a line that
    crosses a body an odd number of times ahead comes from inside it). Each closed body is asked by
    itself, so that bodies may overlap; one that lies inside another whole is a void in it, one in a
    void is a body again. All open bodies are asked together; where no line tells, `_guess` does.
    """
    if not np.isfinite(triangles).all():
        n_bad = int((~np.isfinite(triangles)).any(axis=(1, 2)).sum())
        raise UsageError(f"{n_bad} triangles have a corner that is not finite: repair the mesh")
    if len(triangles) == 0:
        raise UsageError("no triangles: a tool needs a surface")
    corners = triangles.reshape(-1, 3)
    origin = corners.min(axis=0) / 2.0 + corners.max(axis=0) / 2.0
    local = triangles - origin
    faces = _join_corners(local)
    kept = _drop_repeated(faces)
    normals, areas = sampling.normals_of(local[kept])
    total = float(areas.sum())
    if not 0.0 < total < np.inf:
        raise UsageError("its triangles have no area, or more than can be counted")
    faces, local = faces[kept], local[kept]
    edges = _edges_of(faces)
    patch, is_flipped = _wind(faces, edges)
    normals[is_flipped] *= -1.0
    body = _bodies(len(faces), edges)
    sides = _Sides(local, local.mean(axis=1), normals, areas, patch, body, is_flipped)
    signs = _vote(sides)
    inward = normals * signs[:, None]
    center, has_volume = _center(sides, inward)
    is_closed = has_volume and not bool((edges.uses % 2).any())
    if not is_closed:
        center = np.einsum("f,fk->k", areas, sides.centroids) / total
    sampled = areas > 0.0
    return _Surface(
        triangles[kept][sampled], areas[sampled], inward[sampled], center + origin, is_closed
    )


def _bodies(n_faces: int, edges: _Edges) -> Ints:
    """Body (F,) of each face: 1, 2, ... what hangs together by edges, 0 whatever is open."""
    pairs = _neighbours(edges.number, np.arange(3 * n_faces))
    body = _components(pairs // 3, n_faces)
    is_open = np.zeros(n_faces, dtype=bool)
    is_open[body[np.flatnonzero((edges.uses % 2 == 1)[edges.number]) // 3]] = True
    body += 1
    body[is_open[body - 1]] = 0
    return np.unique(np.append(body, 0), return_inverse=True)[1][:-1].astype(np.int64)


def _vote(sides: _Sides) -> Floats:
    """For each face (F,) 1 where its normal points inside, -1 where outside."""
    tree = sampling.triangle_tree(sides.triangles, sides.body)
    votes = sampling.side_votes(
        tree, sides.patch, sides.body, sides.areas, sides.centroids, sides.normals
    )
    signs = np.sign(votes).astype(np.float64)[sides.patch]
    _guess(sides, signs)
    signs[_voids(sides, tree)[sides.body]] *= -1.0
    return signs


def _guess(sides: _Sides, signs: Floats) -> None:
    """Fill in the signs (F,) that no line could tell: still zero.

    A patch that bulges has its inside where its middle is. Flat ones all face one way: out of the
    side that the file's winding calls the outer one, or, where the winding contradicts itself,
    towards the positive end of the axis that they face most.
    """
    silent = np.flatnonzero(signs == 0.0)
    if len(silent) == 0:
        return
    patch = np.unique(sides.patch[silent], return_inverse=True)[1]
    areas, normals, centroids = sides.areas[silent], sides.normals[silent], sides.centroids[silent]
    total = np.maximum(np.bincount(patch, areas), np.finfo(np.float64).tiny)
    middle = np.stack([np.bincount(patch, areas * x) for x in centroids.T], axis=1) / total[:, None]
    arm = middle[patch] - centroids
    bulge = np.bincount(patch, areas * (normals * arm).sum(axis=1))
    size = np.bincount(patch, areas * np.linalg.norm(arm, axis=1))
    guess = np.where(np.abs(bulge) > 1e-6 * size, np.sign(bulge), 0.0)[patch]
    flat = guess == 0.0
    wound = np.where(sides.is_flipped[silent], -areas, areas)
    outer = wound[flat] @ normals[flat]
    if np.linalg.norm(outer) < 0.5 * areas[flat].sum():
        outer = np.linalg.eigh((normals[flat].T * areas[flat]) @ normals[flat])[1][:, -1]
        outer = outer * np.sign(outer[np.argmax(np.abs(outer))])
    facing = normals @ outer
    is_outward = (facing > 0.0) | ((facing == 0.0) & (wound >= 0.0))
    signs[silent] = np.where(flat, np.where(is_outward, -1.0, 1.0), guess)


def _voids(sides: _Sides, tree: sampling.TriangleTree) -> NDArray[np.bool_]:
    """Whether each body (B,) is the wall of a void: whole inside an odd number of closed bodies."""
    n_bodies = int(sides.body.max()) + 1
    low = np.full((n_bodies, 3), np.inf)
    high = np.full((n_bodies, 3), -np.inf)
    np.minimum.at(low, sides.body, sides.triangles.min(axis=1))
    np.maximum.at(high, sides.body, sides.triangles.max(axis=1))
    low[0], high[0] = np.inf, -np.inf  # what is open encloses nothing
    pairs = [
        (inner, outer)
        for inner in range(1, n_bodies)
        for outer in np.flatnonzero(((low <= low[inner]) & (high >= high[inner])).all(axis=1))
        if outer != inner
    ]
    is_void = np.zeros(n_bodies, dtype=bool)
    if pairs:
        nests = np.array(pairs, dtype=np.int64)
        encloses = sampling.enclosures(tree, nests, sides.body, sides.areas, sides.centroids)
        is_void = np.bincount(nests[:, 0], encloses, n_bodies) % 2 == 1
    return is_void


def _center(sides: _Sides, inward: Floats) -> tuple[Floats, bool]:
    """Centre of mass of the solid, and whether there is one: a volume beyond rounding."""
    a, b, c = sides.triangles[:, 0], sides.triangles[:, 1], sides.triangles[:, 2]
    # A face with its outward normal n spans with the origin the volume (centroid . n) area / 3.
    volumes = -(inward * sides.centroids).sum(axis=1) * sides.areas / 3.0
    volume = float(volumes.sum())
    if not volume > 1e-9 * float(np.abs(volumes).sum()):
        return np.zeros(3), False
    return np.einsum("f,fk->k", volumes, a + b + c) / (4.0 * volume), True  # no BLAS: no threads
