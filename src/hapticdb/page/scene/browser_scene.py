"""View of one browser: visibility, highlights, colours, picking, distances."""

import time
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray
from viser import ClientHandle

from hapticdb.page.colours import FADED, MARKED, Colour, Rgba
from hapticdb.page.scene.contents import Contents
from hapticdb.page.scene.drawings import Audience
from hapticdb.page.scene.nodes import Member
from hapticdb.page.scene.picking import RayHit
from hapticdb.page.scene.surroundings import FIELD_OF_VIEW, add_shadow

Floats = NDArray[np.float64]
FLIGHT_STEPS = 18
"""Steps of a camera motion, in 0.6 s."""
SHEER = 70
"""Opacity of see-through objects, 0 to 255."""


@dataclass
class _ViewState:
    """State of one browser's view; ids of removed objects may stay in it."""

    hidden: set[int] = field(default_factory=set)
    isolated: frozenset[int] | None = None
    marked: set[int] = field(default_factory=set)
    sheer: set[int] = field(default_factory=set)
    spotlit: dict[int, Colour] = field(default_factory=dict)

    def sees(self, object_id: int) -> bool:
        isolated = self.isolated
        return object_id not in self.hidden and (isolated is None or object_id in isolated)

    def colour(self, member: Member) -> Colour | Rgba | None:
        if member.id in self.spotlit:
            return self.spotlit[member.id]
        if not self.sees(member.id):
            return None
        if self.spotlit:
            return FADED
        colour = MARKED if member.id in self.marked else member.colour
        return (*colour, SHEER) if member.id in self.sheer else colour


class BrowserScene:
    """The scene as seen by one browser, until `Contents.leave`.

    up : number of the vertical axis; ground : height of the shadow, metres.

    Changes by others show here too, unless hidden here. All methods are thread-safe, and accept ids
    of removed objects.
    """

    def __init__(self, client: ClientHandle, contents: Contents, up: int, ground: float) -> None:
        self._client, self._contents = client, contents
        self._up, self._ground = up, ground
        self._key = client.client_id
        self._state = _ViewState()
        contents.watch(self._key, Audience(client.scene), self._state.colour)
        self.shade()

    @property
    def hidden(self) -> set[int]:
        """Ids of the objects hidden in this browser."""
        return {i for i in list(self._contents.records) if not self._state.sees(i)}

    def show(self, ids: Iterable[int] | None = None) -> None:
        """Show objects; without ids show all, and end `isolate` and `see_through`."""
        with self._changed() as state:
            if ids is None:
                state.hidden, state.isolated, state.sheer = set(), None, set()
            else:
                shown = set(ids)
                state.hidden -= shown
                if state.isolated is not None:
                    state.isolated |= shown

    def hide(self, ids: Iterable[int]) -> None:
        """Hide objects in this browser, also from picking."""
        with self._changed() as state:
            state.hidden |= set(ids)

    def isolate(self, ids: Iterable[int]) -> None:
        """Hide all other objects; `show` without ids ends it."""
        with self._changed() as state:
            state.isolated = frozenset(ids)
            state.hidden -= state.isolated

    @contextmanager
    def _changed(self) -> Iterator[_ViewState]:
        """Redraw the objects with another visibility after the block, and the shadow."""
        with self._contents.lock:
            before, sheer = self.hidden, self._state.sheer
            yield self._state
            self._draw((before ^ self.hidden) | (sheer ^ self._state.sheer))
        self.shade()

    def shade(self) -> None:
        """Draw the shadow of the objects that are shown here."""
        boxes = self._contents.boxes(self._state.sees)
        add_shadow(self._client.scene, boxes, self._up, self._ground)

    def highlight(self, ids: Iterable[int]) -> None:
        """Highlight these objects alone."""
        with self._contents.lock:
            before, self._state.marked = self._state.marked, set(ids)
            self._draw(before ^ self._state.marked)

    def see_through(self, ids: Iterable[int]) -> None:
        """Make objects see-through; solid again if all of them are."""
        with self._contents.lock:
            wanted = set(ids)
            # all are see-through already: solid; else the missing ones join them
            self._state.sheer ^= (
                wanted if wanted <= self._state.sheer else wanted - self._state.sheer
            )
            self._draw(wanted)

    def spotlight(self, colours: Mapping[int, Colour]) -> None:
        """Show objects, hidden ones too, in these colours, and fade all others; {} ends it."""
        with self._contents.lock:
            before, self._state.spotlit = self._state.spotlit, dict(colours)
            # at its begin and end all other objects fade or return
            is_whole = bool(before) != bool(colours)
            self._draw(list(self._contents.records) if is_whole else before | self._state.spotlit)

    def fit(self, ids: set[int]) -> None:
        """Fly to objects that are shown."""
        boxes = self._contents.boxes(lambda i: i in ids)
        low, high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
        self.fly_to((low + high) / 2, max(float(np.linalg.norm(high - low)) / 2, 1e-9))

    def fly_to(self, middle: Floats, radius: float, side: Floats | None = None) -> None:
        """Move the camera, in short steps, until a sphere fills its view: centre (3,), metres.

        side : direction (3,) from the centre to the eye, taken at once; else as now.
        """
        camera = self._client.camera
        start = np.stack([camera.position, camera.look_at])
        if side is not None:
            start[0] = start[1] + side * float(np.linalg.norm(start[0] - start[1]))
        offset = start[0] - start[1]
        offset *= radius / np.sin(FIELD_OF_VIEW / 2) / max(float(np.linalg.norm(offset)), 1e-12)
        for step in range(1, FLIGHT_STEPS + 1):
            # smoothstep: the camera starts and ends at rest
            share = (step / FLIGHT_STEPS) ** 2 * (3.0 - 2.0 * step / FLIGHT_STEPS)
            eye, target = start + share * (np.stack([middle + offset, middle]) - start)
            with self._client.atomic():
                camera.position, camera.look_at = eye, target
            time.sleep(0.6 / FLIGHT_STEPS)

    def _draw(self, ids: Iterable[int]) -> None:
        with self._client.atomic():
            self._contents.see(self._key, ids)

    def pick(self, origin: ArrayLike, direction: ArrayLike) -> RayHit | None:
        """First visible object along a ray, world frame."""
        return self._contents.pick(origin, direction, self._state.sees)

    def measure(self, start: ArrayLike, end: ArrayLike, words: str) -> None:
        """Draw a line between two points (3,), metres, with a label."""
        ends = np.array([start, end], dtype=np.float64)
        distance = float(np.linalg.norm(ends[1] - ends[0]))
        scene = self._client.scene
        with self._client.atomic():
            scene.add_line_segments(
                "/distance/line", ends[None] - ends[0], colors=(24, 32, 44), thickness=3.0,
                thickness_units="screen", position=ends[0],
            )  # fmt: skip
            scene.add_point_cloud(
                "/distance/ends", ends - ends[0], colors=MARKED, point_shape="circle",
                point_size=max(distance, 1e-9) * 0.02, precision="float32", position=ends[0],
            )  # fmt: skip
            middle = tuple(ends.mean(axis=0))
            scene.add_label("/distance/label", words, position=middle, anchor="bottom-center")

    def clear_measure(self) -> None:
        """Remove the line and the label of `measure`."""
        with self._client.atomic():
            for name in ("/distance/line", "/distance/ends", "/distance/label"):
                self._client.scene.remove_by_name(name)
