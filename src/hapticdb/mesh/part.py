"""Contents of a mesh file: parts, their placements, defects."""

import hashlib
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

_WORDS = {
    "degenerate": "degenerate",
    "non_finite": "non-finite",
    "out_of_range": "out of range",
    "incomplete": "incomplete",
    "unsupported": "of an unsupported kind",
    "empty": "empty",
}


@dataclass(frozen=True)
class Defects:
    """Counts of the defects of a file or a part; `+` adds them."""

    degenerate: int = 0
    """Triangles of zero area after placement. They stay, and mark the voxels that they touch."""
    non_finite: int = 0
    """Triangles and points with a NaN or infinite coordinate. Dropped."""
    out_of_range: int = 0
    """Triangles with a vertex index out of range. Dropped."""
    incomplete: int = 0
    """Faces of fewer than three corners. Dropped."""
    unsupported: int = 0
    """Pieces without a surface or of an unsupported kind: lines, curves, points among triangles."""
    empty: int = 0
    """Nodes, solids and meshes without any triangle or point."""

    def __add__(self, other: "Defects") -> "Defects":
        return Defects(**{name: getattr(self, name) + getattr(other, name) for name in _WORDS})

    def __bool__(self) -> bool:
        return self != _NONE

    def describe(self) -> str:
        """Format the counts above zero, '12 degenerate, 3 non-finite'; '' without defects."""
        return ", ".join(f"{n} {_WORDS[name]}" for name, n in vars(self).items() if n)


_NONE = Defects()


@dataclass(frozen=True, eq=False, slots=True)
class Part:
    """One instance in a file: a triangle mesh or a point cloud, and its placement."""

    name: str
    """Node path below the root, joined by '/'; unique within the file."""
    vertices: NDArray[np.float64]
    """(V, 3) metres, part frame, finite, each used; instances of one mesh share the array."""
    faces: NDArray[np.int64] | None
    """(F, 3) indices of vertices; None for a point cloud."""
    world_from_part: NDArray[np.float64]
    """(4, 4) affine transform, metres; it may mirror, scale or flatten."""
    defects: Defects = field(default_factory=Defects)
    shared: dict[str, str] = field(default_factory=dict, repr=False)
    """Cache of the digest; instances of one mesh share the dictionary."""
    colours: NDArray[np.uint8] | None = None
    """(F, 4) red, green, blue (sRGB) and opacity of each triangle, or (V, 4) of each point of a
    cloud; None if the file has none."""
    chord: float = 0.0
    """Chord error, metres, part frame: greatest distance between the triangles and the tessellated
    CAD surface; 0.0 for exact triangles."""
    attributes: dict[str, str] = field(default_factory=dict)
    """Attributes from the file: class, identifier, storey."""

    @property
    def placed_chord(self) -> float:
        """Chord error, metres, world frame: `chord` times the placement's greatest stretch."""
        linear = self.world_from_part[:3, :3]
        return self.chord * float(np.linalg.norm(linear, 2)) if self.chord else 0.0

    @property
    def is_cloud(self) -> bool:
        """Whether the part is a point cloud."""
        return self.faces is None

    @property
    def digest(self) -> str:
        """SHA-256 of geometry, colours and chord error, 64 hex digits, without placement."""
        if "digest" not in self.shared:
            chord = np.array([self.chord]) if self.chord else None
            content = hashlib.sha256(b"cloud" if self.faces is None else b"mesh")
            for array in (self.vertices, self.faces, self.colours, chord):
                if array is not None:
                    little = np.ascontiguousarray(array, dtype=array.dtype.newbyteorder("<"))
                    content.update(len(little).to_bytes(8, "little"))
                    content.update(little.data)
            self.shared["digest"] = content.hexdigest()
        return self.shared["digest"]

    def world_points(
        self, world_from_part: NDArray[np.float64] | None = None
    ) -> NDArray[np.float64]:
        """Vertices (V, 3), metres, world frame; `world_from_part` replaces the file's placement."""
        placed = self.world_from_part if world_from_part is None else world_from_part
        return np.asarray(self.vertices @ placed[:3, :3].T + placed[:3, 3], dtype=np.float64)

    def triangles(self, world_from_part: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
        """Corners (F, 3, 3) as `world_points`; (0, 3, 3) for a point cloud."""
        if self.faces is None:
            return np.empty((0, 3, 3))
        return self.world_points(world_from_part)[self.faces]

    def surface(self) -> NDArray[np.float64]:
        """Corners (F, 3, 3) of the placed triangles; a cloud's points as triangles of zero area."""
        if self.faces is None:
            return np.repeat(self.world_points()[:, None], 3, axis=1)
        return self.triangles()

    @property
    def bounds(self) -> NDArray[np.float64]:
        """AABB (2, 3) of the placed part, metres, enlarged by the chord error."""
        points, chord = self.world_points(), self.placed_chord
        return np.stack([points.min(axis=0) - chord, points.max(axis=0) + chord])


@dataclass(frozen=True, eq=False)
class MeshFile:
    """All usable parts of one file, at least one, in the order of the file."""

    link: str
    """Absolute path of the file, symbolic links resolved."""
    parts: list[Part]
    defects: Defects
    """Sum over the parts, and over dropped or empty geometry outside of them."""
    names_unit: bool = False
    """Whether the file gives or suggests its unit of length."""
    up: str | None = None
    """Up axis, x, y or z; None if neither the format nor the file defines it."""
    notes: tuple[str, ...] = ()
    """Content not read, or read otherwise than meant; a line each."""
    named: tuple[str, ...] = ()
    """Names of the referenced files searched by `read_file`: buffers, materials, pictures."""

    @property
    def bounds(self) -> NDArray[np.float64]:
        """AABB (2, 3) of all parts, metres, world frame."""
        boxes = np.stack([part.bounds for part in self.parts])
        return np.stack([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])
