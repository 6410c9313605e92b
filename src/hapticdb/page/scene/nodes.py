"""Objects gathered into few nodes: batches of one shape, and merged shapes of one colour."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from hapticdb.page.colours import Colour
from hapticdb.page.scene.drawings import Drawing, Geometry
from hapticdb.page.scene.facets import Facets, cube
from hapticdb.page.scene.shapes import PartShape
from hapticdb.poses import quaternion_of

LEAST_SAVED = 2_000
"""Triangles that a batch must save, compared with merging its objects, to be a node of its own. A
larger value makes fewer nodes and sends more bytes."""
MOST_MERGED = 24_000
"""Triangles of a merged node, unless one object alone has more. A larger value makes fewer nodes,
and sends more bytes when one object of the node is hidden, marked or moved."""
BOX_OPACITY = 0.3
"""Opacity of the boxes of objects whose shape is being read."""
_UNTURNED = np.array([1.0, 0.0, 0.0, 0.0])


@dataclass
class Member:
    """An object as nodes draw it.

    pose (4, 4): rigid world_from_shape, metres; box (2, 3): it holds the object, world frame;
    colour: its own; shape: None while it is a box.
    """

    id: int
    pose: NDArray[np.float64]
    box: NDArray[np.float64]
    colour: Colour
    shape: PartShape | None = None


Sight = Callable[[Member], Colour | None]
"""Colour in which an audience sees an object; None if it does not."""


class Node(Protocol):
    """Objects that are drawn together."""

    @property
    def name(self) -> str:
        """Path of its node in the browser's scene."""

    @property
    def members(self) -> dict[int, Member]:
        """Its objects by id; objects may leave it, none may join."""

    @property
    def is_cheap_to_move(self) -> bool:
        """Whether a moved object sends few bytes."""

    def drawings(self, sight: Sight) -> dict[str, Drawing]:
        """What an audience sees of it, by names of nodes; nodes without a drawing are gone."""


class BatchNode:
    """One shape at one or more places; without a shape, the boxes of objects as cubes."""

    def __init__(self, name: str, members: Sequence[Member], shape: PartShape | None) -> None:
        self.name = name
        self.members = {member.id: member for member in members}
        self._slots = list(members)
        """Its members; one that has left is not seen, and keeps its place."""
        self._is_boxes = shape is None
        if shape is None:
            self._geometry = Geometry("box", _cube32, 0.87, BOX_OPACITY)
        else:
            self._geometry = Geometry(shape.serial, lambda: shape.drawn, shape.radius)
        self._poses = np.tile(np.eye(4), (len(members), 1, 1))
        self._edges = np.ones((len(members), 3))

    @property
    def is_cheap_to_move(self) -> bool:
        """Whether a moved object sends few bytes: its node's places, 28 bytes each.

        Boxes are there for a few seconds only.
        """
        return self._is_boxes or len(self._slots) <= 256

    def drawings(self, sight: Sight) -> dict[str, Drawing]:
        """Its only node; hidden objects have size 0."""
        colours = [sight(one) if one.id in self.members else None for one in self._slots]
        is_seen = np.array([colour is not None for colour in colours], dtype=np.float64)
        for slot, member in enumerate(self._slots):
            if member.id not in self.members:
                continue
            if self._is_boxes:
                self._poses[slot, :3, 3] = member.box.mean(axis=0)
                self._edges[slot] = np.maximum(member.box[1] - member.box[0], 1e-9)
            else:
                self._poses[slot] = member.pose
        drawing = Drawing(
            self._geometry,
            quaternion_of(self._poses[:, :3, :3]),
            self._poses[:, :3, 3].copy(),
            is_seen[:, None] * self._edges if self._is_boxes else is_seen,
            np.array([colour or (0, 0, 0) for colour in colours], dtype=np.uint8),
        )
        return {} if drawing.is_blank else {self.name: drawing}


def _cube32() -> Facets:
    vertices, faces = cube()
    return Facets(vertices.astype(np.float32), faces.astype(np.uint32))


class _MergedNode:
    """Different shapes of one colour at their places, as one geometry.

    Objects that an audience sees in another colour are drawn by nodes beside it, one a colour. If
    one is hidden, marked or moved, the rest is merged anew.
    """

    def __init__(self, name: str, members: Sequence[Member]) -> None:
        self.name = name
        self.members = {member.id: member for member in members}
        boxes = np.stack([member.box for member in members])
        self._low, self._high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
        self._center = (self._low + self._high) / 2

    @property
    def is_cheap_to_move(self) -> bool:
        """Whether a moved object sends few bytes: no, all triangles of the node."""
        return False

    def drawings(self, sight: Sight) -> dict[str, Drawing]:
        """Its node, and one for each other colour."""
        of_colour: dict[tuple[str, Colour], list[Member]] = {}
        for member in self.members.values():
            colour = sight(member)
            if colour is not None:
                own = colour == member.colour
                name = self.name if own else f"{self.name}-{bytes(colour).hex()}"
                of_colour.setdefault((name, colour), []).append(member)
        return {name: self._drawing(some, colour) for (name, colour), some in of_colour.items()}

    def _drawing(self, members: list[Member], colour: Colour) -> Drawing:
        key = tuple(
            (member.id, member.shape and member.shape.serial, member.pose.tobytes())
            for member in members
        )
        radius = float(np.linalg.norm(self._high - self._low)) / 2
        geometry = Geometry(key, lambda: merged(members, self._center), radius)
        return Drawing(
            geometry,
            _UNTURNED[None],
            self._center[None],
            np.ones(1),
            np.array([colour], dtype=np.uint8),
        )


def merged(members: Sequence[Member], center: NDArray[np.float64]) -> Facets:
    """All triangles of members with shapes, at their places, metres from a centre (3,)."""
    vertices, faces, n_vertices = [], [], 0
    for member in members:
        if member.shape is None:
            continue
        drawn = member.shape.drawn
        turn, at = member.pose[:3, :3], member.pose[:3, 3] - center
        vertices.append((drawn.vertices @ turn.T + at).astype(np.float32))
        faces.append(drawn.faces + np.uint32(n_vertices))
        n_vertices += len(drawn.vertices)
    return Facets(np.concatenate(vertices), np.concatenate(faces))


def gathered(members: Sequence[Member], names: Callable[[], str]) -> list[Node]:
    """Nodes for members with shapes: batches where a shape repeats enough, the rest merged.

    names : gives a new name for each node.
    """
    of_shape: dict[int, list[Member]] = {}
    for member in members:
        of_shape.setdefault(id(member.shape), []).append(member)
    nodes: list[Node] = []
    rest: dict[Colour, list[Member]] = {}
    for same in of_shape.values():
        shape = same[0].shape
        if shape is None:
            continue
        saved = (len(same) - 1) * shape.n_triangles
        if saved >= LEAST_SAVED or shape.n_triangles > MOST_MERGED:
            nodes.append(BatchNode(names(), same, shape))
        else:
            for member in same:
                rest.setdefault(member.colour, []).append(member)
    for same in rest.values():
        nodes.extend(_MergedNode(names(), run) for run in _runs(same))
    return nodes


def _runs(members: list[Member]) -> list[list[Member]]:
    """Members cut into runs of at most `MOST_MERGED` triangles that lie near one another."""
    centers = np.array([member.box.mean(axis=0) for member in members])
    low = centers.min(axis=0)
    size = max(float((centers - low).max()), 1e-12)
    steps = np.minimum((centers - low) / size * 1024, 1023).astype(np.int64)
    order = np.argsort(_interleaved(steps), kind="stable").tolist()
    runs: list[list[Member]] = []
    n_triangles = 0
    for index in order:
        member = members[index]
        own = member.shape.n_triangles if member.shape is not None else 0
        if not runs or n_triangles + own > MOST_MERGED:
            runs.append([])
            n_triangles = 0
        runs[-1].append(member)
        n_triangles += own
    return runs


def _interleaved(steps: NDArray[np.int64]) -> NDArray[np.int64]:
    """Z-order (n,) of steps (n, 3) below 1024."""
    order = np.zeros(len(steps), dtype=np.int64)
    for bit in range(10):
        for axis in range(3):
            order |= ((steps[:, axis] >> bit) & 1) << (3 * bit + axis)
    return order
