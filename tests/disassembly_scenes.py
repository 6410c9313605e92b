"""Assemblies of boxes with an order of disassembly that is known by construction."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from extraction_scenes import SIZE, box, imported, joined

Floats = NDArray[np.float64]
Corners = tuple[float, float, float]
Boxes = list[tuple[Corners, Corners]]
Scene = dict[str, Boxes]
"""Boxes of each part: lower and upper corner, metres. All gaps are of 3 voxels or more."""

POT: Boxes = [
    ((-0.02, -0.02, -0.02), (0.22, 0.22, 0.0)),
    ((-0.02, -0.02, 0.0), (0.0, 0.22, 0.2)),
    ((0.2, -0.02, 0.0), (0.22, 0.22, 0.2)),
    ((0.0, -0.02, 0.0), (0.2, 0.0, 0.2)),
    ((0.0, 0.2, 0.0), (0.2, 0.22, 0.2)),
]
"""Open at its top."""

STACK: Scene = {
    "pot": POT,
    "content": [((0.05, 0.05, 0.03), (0.15, 0.15, 0.08))],
    "lid": [((0.03, 0.03, 0.11), (0.17, 0.17, 0.13))],
    "weight": [((0.03, 0.03, 0.16), (0.17, 0.17, 0.18))],
}
"""Content, lid and weight in a pot, one above the other."""


def link(x: float, axis: int) -> Boxes:
    """A square link of a chain in the plane of x and another axis, 0.16 m wide, 0.02 m thick."""

    def at(a: tuple[float, float], b: tuple[float, float]) -> tuple[Corners, Corners]:
        across = [(x + a[0], x + a[1]), (-0.01, 0.01), (-0.01, 0.01)]
        across[axis] = b
        return tuple(low for low, _ in across), tuple(high for _, high in across)  # type: ignore[return-value]

    return [
        at((-0.08, 0.08), (-0.08, -0.06)),
        at((-0.08, 0.08), (0.06, 0.08)),
        at((-0.08, -0.06), (-0.06, 0.06)),
        at((0.06, 0.08), (-0.06, 0.06)),
    ]


CHAIN: Scene = {
    "left": link(0.0, 1),
    "right": link(0.07, 2),
    "beside": [((0.4, 0.0, 0.0), (0.42, 0.02, 0.02))],
}
"""Two links of a chain, which never come apart, and an object that holds nothing."""

WINDOW: Scene = {
    "pot": [
        *(one for one in POT if one[0] != (0.2, -0.02, 0.0)),
        ((0.2, -0.02, 0.0), (0.22, 0.06, 0.2)),
        ((0.2, 0.14, 0.0), (0.22, 0.22, 0.2)),
        ((0.2, 0.06, 0.0), (0.22, 0.14, 0.04)),
        ((0.2, 0.06, 0.12), (0.22, 0.14, 0.2)),
    ],
    "content": [((0.05, 0.05, 0.05), (0.15, 0.15, 0.11))],
    "rod": [((0.18, 0.09, 0.07), (0.35, 0.11, 0.09))],
    "lid": [((-0.02, -0.02, 0.23), (0.22, 0.22, 0.25))],
}
"""Content in a pot with a lid above; a rod comes in through a window that the content is too large
for. The lid has to go; the rod is in the way, but taking it off does not help."""


def made(folder: Path, scene: Scene) -> Path:
    parts = {name: joined(*(box(*each) for each in boxes)) for name, boxes in scene.items()}
    return imported(folder, 2.0 * SIZE, **parts)


def least_gap(moving: Boxes, standing: Boxes, shifts: Floats) -> float:
    """Least distance along an axis between boxes shifted by (n, 3) and boxes that stand.

    Above zero if and only if no box meets another at any of the shifts.
    """
    mine, others = np.array(moving), np.array(standing)
    low = shifts[:, None, None] + mine[None, :, None, 0]
    high = shifts[:, None, None] + mine[None, :, None, 1]
    gaps = np.maximum(others[None, None, :, 0] - high, low - others[None, None, :, 1])
    return float(gaps.max(axis=-1).min())


def held_by_a_head() -> Scene:
    """A plate on a base, held by the head of a bolt whose shaft fills its hole; all in contact."""
    return {
        "base": [((-0.2, -0.1, 0.0), (0.2, 0.1, 0.1))],
        "plate": [
            ((-0.2, -0.1, 0.1), (-0.02, 0.1, 0.12)),
            ((0.02, -0.1, 0.1), (0.2, 0.1, 0.12)),
            ((-0.02, -0.1, 0.1), (0.02, -0.02, 0.12)),
            ((-0.02, 0.02, 0.1), (0.02, 0.1, 0.12)),
        ],
        "bolt": [
            ((-0.02, -0.02, 0.1), (0.02, 0.02, 0.135)),
            ((-0.03, -0.03, 0.12), (0.03, 0.03, 0.14)),
        ],
    }
