"""Steps of an editor: what was done to one object, and what undoes it."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from hapticdb.store.base import Object

Kind = Literal["move", "take out", "put back"]


@dataclass(frozen=True, eq=False)
class EditStep:
    """One edit of one object, which was one transaction.

    Attributes
    ----------
    kind : {"move", "take out", "put back"}
        What was done.
    before : Object
        The object before it; for "put back", as it was when it was taken out.
    transform : (4, 4) float64
        world_from_part after it, metres; for "take out", where the object was.
    """

    kind: Kind
    before: Object
    transform: NDArray[np.float64]

    @property
    def object_id(self) -> int:
        """Id of the object."""
        return self.before.id

    def describe(self) -> str:
        """One line for people: what was done, to which object."""
        whom = f"{self.before.id} ({self.before.name})"
        if self.kind == "take out":
            return f"took out {whom}"
        if self.kind == "put back":
            return f"put back {whom}"
        way = self.transform[:3, 3] - self.before.transform[:3, 3]
        turned = self.transform[:3, :3] @ np.linalg.inv(self.before.transform[:3, :3])
        angle = np.degrees(np.arccos(np.clip((np.trace(turned) - 1.0) / 2.0, -1.0, 1.0)))
        told = f"moved {whom} by {1000 * float(np.linalg.norm(way)):.4g} mm"
        return f"{told}, turned it by {angle:.3g} degrees" if angle > 0.01 else told
