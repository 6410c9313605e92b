"""What one browser sees: hidden, isolated, highlighted and coloured objects, clicks, distances."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.page.scene.colours import MARKED, Rgb
from hapticdb.page.scene.contents import Contents
from hapticdb.page.scene.drawings import Audience
from hapticdb.page.scene.nodes import Member
from hapticdb.page.scene.picking import Struck

if TYPE_CHECKING:
    from viser import ClientHandle

INK: Rgb = (24, 32, 44)
"""Colour of lines and labels of distances."""


@dataclass
class _Look:
    """State of one browser; ids of objects that are gone may stay in it."""

    hidden: set[int] = field(default_factory=set)
    isolated: frozenset[int] | None = None
    marked: set[int] = field(default_factory=set)
    colours: dict[int, Rgb] = field(default_factory=dict)

    def sees(self, object_id: int) -> bool:
        isolated = self.isolated
        return object_id not in self.hidden and (isolated is None or object_id in isolated)

    def colour(self, member: Member) -> Rgb | None:
        if not self.sees(member.id):
            return None
        if member.id in self.marked:
            return MARKED
        return self.colours.get(member.id, member.colour)


@dataclass(frozen=True)
class Picked:
    """The part that a click met.

    Attributes
    ----------
    id, name : int, str
        The object.
    size : (3,) float64
        Edges of its bounding box, metres.
    voxels : int
        Voxels that its surface touches.
    file : str
        Name of its file, without the folder.
    point, normal : (3,) float64
        Where the ray met it, metres, and the unit normal there towards the eye, world frame.
    distance : float
        From the eye, metres.
    """

    id: int
    name: str
    size: NDArray[np.float64]
    voxels: int
    file: str
    point: NDArray[np.float64]
    normal: NDArray[np.float64]
    distance: float


class BrowserScene:
    """The scene as one browser sees it. `SceneView.browser` makes it.

    What others do is seen here, too, as long as it is not hidden here. All methods may be called
    from any thread, and take ids of objects that are there no longer.
    """

    def __init__(self, client: "ClientHandle", contents: Contents) -> None:
        self._client = client
        self._contents = contents
        self._key = client.client_id
        self._look = _Look()
        self._audience = Audience(client.scene)
        contents.watch(self._key, self._audience, self._look.colour)

    def close(self) -> None:
        """Forget this browser; call it when the browser has disconnected."""
        self._contents.leave(self._key)

    # -- what is seen ------------------------------------------------------------------------

    @property
    def hidden(self) -> set[int]:
        """Ids of the objects that this browser does not see."""
        return {i for i in list(self._contents.records) if not self._look.sees(i)}

    @property
    def bytes_sent(self) -> int:
        """Bytes of triangles, places and colours sent to this browser alone, uncompressed."""
        return self._audience.bytes_sent

    @property
    def highlighted(self) -> set[int]:
        """Ids of the objects that are highlighted."""
        return set(self._look.marked)

    def sees(self, object_id: int) -> bool:
        """Whether this browser sees an object."""
        return self._look.sees(object_id)

    def show(self, ids: Iterable[int] | None = None) -> None:
        """See objects again; all of them, and the end of `isolate`, without ids."""
        with self._contents.lock:
            before = self.hidden
            if ids is None:
                self._look.hidden, self._look.isolated = set(), None
            else:
                shown = set(ids)
                self._look.hidden -= shown
                if self._look.isolated is not None:
                    self._look.isolated |= shown
            self._draw(before ^ self.hidden)

    def hide(self, ids: Iterable[int]) -> None:
        """Hide objects from this browser; they are not picked then."""
        with self._contents.lock:
            hidden = set(ids)
            self._look.hidden |= hidden
            self._draw(hidden)

    def isolate(self, ids: Iterable[int]) -> None:
        """Hide all objects but these; `show` without ids ends it."""
        with self._contents.lock:
            before = self.hidden
            self._look.isolated = frozenset(ids)
            self._look.hidden -= self._look.isolated
            self._draw(before ^ self.hidden)

    def highlight(self, ids: Iterable[int]) -> None:
        """Highlight these objects and no others; none without ids."""
        with self._contents.lock:
            before, self._look.marked = self._look.marked, set(ids)
            self._draw(before ^ self._look.marked)

    def colour(self, ids: Iterable[int], colour: Rgb | None) -> None:
        """See objects in a colour, sRGB 0 to 255; in their own again with None."""
        with self._contents.lock:
            wanted = set(ids)
            for object_id in wanted:
                if colour is None:
                    self._look.colours.pop(object_id, None)
                else:
                    self._look.colours[object_id] = colour
            self._draw(wanted)

    def _draw(self, ids: Iterable[int]) -> None:
        with self._client.atomic():
            self._contents.see(self._key, ids)

    # -- clicks ------------------------------------------------------------------------------

    def pick(self, origin: ArrayLike, direction: ArrayLike) -> Picked | None:
        """The part that a ray meets first, of those that this browser sees.

        Parameters
        ----------
        origin, direction : (3,) array
            The ray of a click, world frame: `ray_origin` and `ray_direction` of viser's event.
        """
        struck = self._contents.pick(origin, direction, self._look.sees)
        return None if struck is None else picked(struck, self._contents)

    def measure(self, start: ArrayLike, end: ArrayLike) -> float:
        """Draw the distance between two points (3,), metres, as a line and a label; returns it."""
        ends = np.array([start, end], dtype=np.float64)
        distance = float(np.linalg.norm(ends[1] - ends[0]))
        scene = self._client.scene
        with self._client.atomic():
            scene.add_line_segments(
                "/distance/line", ends[None], colors=INK, thickness=3.0, thickness_units="screen"
            )
            scene.add_point_cloud(
                "/distance/ends",
                ends,
                colors=MARKED,
                point_size=max(distance, 1e-9) * 0.02,
                point_shape="circle",
                precision="float32",
            )
            scene.add_label(
                "/distance/label",
                in_words(distance),
                position=tuple(ends.mean(axis=0)),
                anchor="bottom-center",
            )
        return distance

    def clear_measure(self) -> None:
        """Remove the line and the label of `measure`."""
        with self._client.atomic():
            for name in ("/distance/line", "/distance/ends", "/distance/label"):
                self._client.scene.remove_by_name(name)


def picked(struck: Struck, contents: Contents) -> Picked | None:
    """What is known of a struck object; None if it has just gone."""
    obj = contents.records.get(struck.id)
    if obj is None:
        return None
    return Picked(
        obj.id,
        obj.name,
        obj.bounds[1] - obj.bounds[0],
        obj.voxels,
        obj.link.replace("\\", "/").rpartition("/")[2],
        struck.point,
        struck.normal,
        struck.distance,
    )


def in_words(metres: float) -> str:
    """A distance for people: '12.4 mm', '1.83 m'."""
    if metres < 1e-3:
        return f"{1e6 * metres:.3g} µm"
    return f"{1e3 * metres:.4g} mm" if metres < 1 else f"{metres:.4g} m"
