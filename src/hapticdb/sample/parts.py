"""What an assembly is made of: named parts, placed in the world."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hapticdb.sample.shapes import Floats, Mesh, mirrored, moved

Color = tuple[float, float, float]

PAINT: Color = (0.16, 0.38, 0.58)
STEEL: Color = (0.62, 0.64, 0.67)
CAST: Color = (0.50, 0.52, 0.50)
DARK: Color = (0.20, 0.21, 0.23)
RUBBER: Color = (0.13, 0.13, 0.14)
CHROME: Color = (0.80, 0.82, 0.85)
COPPER: Color = (0.72, 0.45, 0.26)
LEATHER: Color = (0.55, 0.33, 0.20)
CLOTH: Color = (0.42, 0.40, 0.38)
GLASS: Color = (0.68, 0.82, 0.86)
RED: Color = (0.78, 0.16, 0.13)
AMBER: Color = (0.92, 0.68, 0.25)
SPRING: Color = (0.85, 0.60, 0.15)


@dataclass(frozen=True)
class SamplePart:
    """One part: its name (a path joined by '/'), its mesh, and where it stands.

    Parts that are instances of one shape share the mesh; `world_from_part` is a rigid (4, 4)
    transform; `color` is red, green and blue in 0..1.
    """

    name: str
    mesh: Mesh
    world_from_part: Floats
    color: Color

    @property
    def vertices(self) -> Floats:
        """Vertices (V, 3) in metres, part frame."""
        return self.mesh.vertices

    @property
    def faces(self) -> NDArray[np.int64]:
        """Faces (F, 3) of vertex numbers, wound outward."""
        return self.mesh.faces

    def triangles(self) -> Floats:
        """Corners (F, 3, 3) in metres, world frame."""
        return moved(self.mesh, self.world_from_part).vertices[self.faces]


@dataclass
class Assembly:
    """Parts in the order in which they were added."""

    parts: list[SamplePart] = field(default_factory=list)

    def add(self, name: str, mesh: Mesh, color: Color, placement: Floats | None = None) -> None:
        """Add a part; without a placement its mesh is in the world frame."""
        self.parts.append(
            SamplePart(name, mesh, np.eye(4) if placement is None else placement, color)
        )

    def add_pair(self, name: str, left: Mesh, color: Color) -> None:
        """Add a part of the left side, in the world frame, and its mirror image on the right."""
        self.add(f"{name}_left", left, color)
        self.add(f"{name}_right", mirrored(left), color)
