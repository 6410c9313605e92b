"""STEP files of solids of revolution about z, whose surfaces are known."""

import math
from pathlib import Path

from file_seeds import STEP

UNITS = {
    "mm": ("(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.))", 1e-3),
    "in": ("(CONVERSION_BASED_UNIT('INCH',#15)LENGTH_UNIT()NAMED_UNIT(#16))", 0.0254),
    "m": ("(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT($,.METRE.))", 1.0),
}
"""Units of length by their names: as STEP has them, and in metres."""
_INCH = """#15=LENGTH_MEASURE_WITH_UNIT(LENGTH_MEASURE(25.4),#17);
#16=DIMENSIONAL_EXPONENTS(1.,0.,0.,0.,0.,0.,0.);
#17=(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.));
"""


class _Solid:
    """Entities of a solid of revolution; lengths in the file's unit."""

    def __init__(self) -> None:
        self.lines: list[str] = []
        self.up = self.add("DIRECTION('',(0.,0.,1.))")
        self.along = self.add("DIRECTION('',(1.,0.,0.))")

    def add(self, text: str) -> str:
        self.lines.append(f"#{100 + len(self.lines)}={text};")
        return f"#{99 + len(self.lines)}"

    def point(self, x: float, z: float) -> str:
        return self.add(f"CARTESIAN_POINT('',({x:.12E},0.,{z:.12E}))")

    def axis(self, z: float) -> str:
        return self.add(f"AXIS2_PLACEMENT_3D('',{self.point(0, z)},{self.up},{self.along})")

    def bound(self, loop: str) -> str:
        return self.add(f"FACE_BOUND('',{loop},.T.)")

    def vertex_bound(self, x: float, z: float) -> str:
        vertex = self.add(f"VERTEX_POINT('',{self.point(x, z)})")
        return self.bound(self.add(f"VERTEX_LOOP('',{vertex})"))

    def circle(self, radius: float, z: float) -> str:
        end = self.add(f"VERTEX_POINT('',{self.point(radius, z)})")
        curve = self.add(f"CIRCLE('',{self.axis(z)},{radius:.12E})")
        return self.add(f"EDGE_CURVE('',{end},{end},{curve},.T.)")

    def circle_bound(self, edge: str, sense: str) -> str:
        side = self.add(f"ORIENTED_EDGE('',*,*,{edge},.{sense}.)")
        return self.bound(self.add(f"EDGE_LOOP('',({side}))"))

    def face(self, surface: str, *bounds: str, sense: str = "T") -> str:
        return self.add(f"ADVANCED_FACE('',({','.join(bounds)}),{self.add(surface)},.{sense}.)")

    def disc(self, edge: str, z: float, sense: str) -> str:
        return self.face(f"PLANE('',{self.axis(z)})", self.circle_bound(edge, sense), sense=sense)

    def written(self, path: Path, unit: str, *faces: str, is_open: bool = False) -> Path:
        head, _, rest = STEP.partition("#20=")
        tail = rest[rest.index("ENDSEC;") :]
        old, new = UNITS["mm"][0], UNITS[unit][0]
        kind = "MANIFOLD_SURFACE_SHAPE" if is_open else "ADVANCED_BREP_SHAPE"
        held = (
            ("OPEN_SHELL", "SHELL_BASED_SURFACE_MODEL")
            if is_open
            else ("CLOSED_SHELL", "MANIFOLD_SOLID_BREP")
        )
        shell = self.add(f"{held[0]}('',({','.join(faces)}))")
        body = self.add(f"{held[1]}('',{f'({shell})' if is_open else shell})")
        self.lines.append(f"#20={kind}_REPRESENTATION('',({body}),#14);")
        content = "\n".join(self.lines) + "\n"
        path.write_text(head.replace(old, new) + _INCH + content + tail)
        return path


def sphere(path: Path, radius: float, unit: str = "mm") -> Path:
    solid = _Solid()
    surface = f"SPHERICAL_SURFACE('',{solid.axis(0)},{radius:.12E})"
    return solid.written(path, unit, solid.face(surface, solid.vertex_bound(0, -radius)))


def torus(path: Path, ring: float, tube: float, unit: str = "mm") -> Path:
    solid = _Solid()
    surface = f"TOROIDAL_SURFACE('',{solid.axis(0)},{ring:.12E},{tube:.12E})"
    return solid.written(path, unit, solid.face(surface, solid.vertex_bound(ring + tube, 0)))


def cylinder(path: Path, radius: float, height: float, unit: str = "mm") -> Path:
    solid = _Solid()
    low, high = solid.circle(radius, 0), solid.circle(radius, height)
    side = solid.face(
        f"CYLINDRICAL_SURFACE('',{solid.axis(0)},{radius:.12E})",
        solid.circle_bound(low, "T"), solid.circle_bound(high, "F"),
    )  # fmt: skip
    return solid.written(path, unit, side, solid.disc(low, 0, "F"), solid.disc(high, height, "T"))


def cone(path: Path, radius: float, height: float, unit: str = "mm") -> Path:
    """Apex at the origin, base above."""
    solid = _Solid()
    base = solid.circle(radius, height)
    angle = math.atan(radius / height)
    side = solid.face(
        f"CONICAL_SURFACE('',{solid.axis(height)},{radius:.12E},{angle:.12E})",
        solid.vertex_bound(0, 0), solid.circle_bound(base, "F"),
    )  # fmt: skip
    return solid.written(path, unit, side, solid.disc(base, height, "T"))


def sheet(path: Path, radius: float, unit: str = "mm") -> Path:
    """A flat disc without thickness."""
    solid = _Solid()
    return solid.written(path, unit, solid.disc(solid.circle(radius, 0), 0, "T"), is_open=True)
