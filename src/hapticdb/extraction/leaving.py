"""When a part is out: its bounding sphere is clear of the box of all that stands."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Exit(NamedTuple):
    """Where a part counts as out.

    low, high (3,) : corners of the box of all that stands; center (3,) : middle of the part at its
    start; radius : of its bounding sphere with a margin; out : distance from the start at which
    it counts as out in any case, or None. Metres.
    """

    low: Floats
    high: Floats
    center: Floats
    radius: float
    out: float | None

    def distances(self, directions: Floats) -> Floats:
        """Metres (D,) along each unit direction (D, 3) until the part is out."""
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            up = (self.high + self.radius - self.center) / directions
            down = (self.low - self.radius - self.center) / directions
        ways = np.where(directions > 0.0, up, np.where(directions < 0.0, down, np.inf))
        ways = np.maximum(ways.min(axis=1), 0.0)
        return np.asarray(ways if self.out is None else np.minimum(ways, self.out))

    def is_out(self, shifts: Floats) -> NDArray[np.bool_]:
        """Whether the part is out with its middle shifted by (n, 3) metres."""
        middles = self.center + shifts
        gaps = np.maximum(np.maximum(self.low - middles, middles - self.high), 0.0)
        is_clear = gaps.max(axis=1) >= (1.0 - 1e-9) * self.radius
        if self.out is None:
            return np.asarray(is_clear)
        return np.asarray(is_clear | (np.linalg.norm(shifts, axis=1) >= (1.0 - 1e-9) * self.out))

    def goals(self, directions: Floats) -> Floats:
        """Shifts (D, 3) at which the part is out, one along each unit direction (D, 3)."""
        return np.asarray(directions * self.distances(directions)[:, None])
