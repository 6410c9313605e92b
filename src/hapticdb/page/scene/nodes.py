"""Few nodes for many objects: instances of one shape, and merged shapes of one colour."""

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels import curves
from hapticdb.page.colours import Colour, Rgba
from hapticdb.page.scene.drawings import Drawing, Geometry, PointDrawing
from hapticdb.page.scene.facets import Facets, cube
from hapticdb.page.scene.shapes import Dots, PartShape, Piece
from hapticdb.poses import quaternion_of

MOST_MERGED = 24_000
"""Greatest number of triangles of a merged node with more than one object."""
_OPAQUE = 255


@dataclass
class Member:
    """An object in its node.

    pose (4, 4) : rigid, world_from_shape, metres; box (2, 3) : AABB, world frame; colour : its own;
    shape : None while it is shown as its AABB.
    """

    id: int
    pose: NDArray[np.float64]
    box: NDArray[np.float64]
    colour: Colour
    shape: PartShape | None = None


Appearance = Callable[[Member], Colour | Rgba | None]
"""Colour of an object for an audience, with an opacity if transparent; None if hidden."""


class BatchNode:
    """Instances of one shape; without a shape, AABBs of objects as scaled cubes."""

    def __init__(self, name: str, members: Sequence[Member], shape: PartShape | None) -> None:
        self.name = name
        self.members = {member.id: member for member in members}
        self._slots = list(members)
        """Instances in order; a removed member is invisible, and its slot stays."""
        self._is_boxes = shape is None
        self._geometries: list[tuple[Rgba | None, Geometry]]
        self._geometries = [(None, Geometry("box", cube, 0.87, 0.3))]
        if shape is not None:
            self._geometries = [
                (piece.colour, _geometry_of((shape.serial, n), piece, shape.radius))
                for n, piece in enumerate(shape.pieces)
            ]
        self._poses = np.tile(np.eye(4), (len(members), 1, 1))
        self._edges = np.ones((len(members), 3))

    @property
    def is_cheap_to_move(self) -> bool:
        """Whether a move sends few bytes: all poses of the node, 28 bytes each."""
        return self._is_boxes or len(self._slots) <= 256

    def drawings(self, appearance: Appearance) -> dict[str, Drawing]:
        """A drawing for each piece of the shape and each opacity; hidden objects have size 0."""
        colours = [appearance(one) if one.id in self.members else None for one in self._slots]
        opacities = np.array([(*colour, _OPAQUE)[3] if colour else -1 for colour in colours])
        for slot, member in enumerate(self._slots):
            if member.id not in self.members:
                continue
            if self._is_boxes:
                self._poses[slot, :3, 3] = member.box.mean(axis=0)
                # never 0, which would hide a flat box
                self._edges[slot] = np.maximum(member.box[1] - member.box[0], 1e-9)
            else:
                self._poses[slot] = member.pose
        wxyzs, positions = quaternion_of(self._poses[:, :3, :3]), self._poses[:, :3, 3].copy()
        found = {}
        # a geometry has one opacity
        for opacity in set(opacities.tolist()) - {-1}:
            is_seen = (opacities == opacity).astype(np.float64)
            sizes = is_seen[:, None] * self._edges if self._is_boxes else is_seen
            for n, (painted, geometry) in enumerate(self._geometries):
                shades = [
                    # the file's colour of the piece, unless the audience colours the object
                    ((painted if colour == member.colour else None) or colour or (0, 0, 0))[:3]
                    for colour, member in zip(colours, self._slots, strict=True)
                ]
                name, drawn = f"{self.name}-{n}" if n else self.name, geometry
                if opacity != _OPAQUE:
                    name, drawn = f"{name}-o{opacity}", replace(geometry, opacity=opacity / _OPAQUE)
                found[name] = Drawing(
                    drawn, wxyzs, positions, sizes, np.array(shades, dtype=np.uint8)
                )
        return found


class _CloudNode:
    """Points of one cloud."""

    is_cheap_to_move = True

    def __init__(self, name: str, member: Member, shape: PartShape, dots: Dots) -> None:
        self.name = name
        self.members = {member.id: member}
        self._serial, self._dots = shape.serial, dots

    def drawings(self, appearance: Appearance) -> dict[str, PointDrawing]:
        """The only drawing."""
        (member,) = self.members.values()
        colour = appearance(member)
        if colour is None:
            return {}
        wxyz, at = quaternion_of(member.pose[None, :3, :3])[0], member.pose[:3, 3].copy()
        own = None if colour == member.colour else colour[:3]
        return {self.name: PointDrawing(self._serial, self._dots, wxyz, at, own)}


def _geometry_of(key: Hashable, piece: Piece, radius: float) -> Geometry:
    """Geometry of a piece of a shape, with the opacity of its colour."""
    return Geometry(key, lambda: piece.facets, radius, _opacity(piece.colour))


def _opacity(colour: Rgba | None) -> float | None:
    return None if colour is None or colour[3] == _OPAQUE else colour[3] / _OPAQUE


class _MergedNode:
    """Different shapes, mostly of one colour, merged into one geometry.

    Pieces in another colour for an audience have separate nodes, one a colour. If one is hidden,
    highlighted or moved, the rest is merged anew.
    """

    is_cheap_to_move = False  # sends all triangles of the node

    def __init__(self, name: str, members: Sequence[Member]) -> None:
        self.name = name
        self.members = {member.id: member for member in members}
        boxes = np.stack([member.box for member in members])
        self._low, self._high = boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)
        self._center = (self._low + self._high) / 2

    def drawings(self, appearance: Appearance) -> dict[str, Drawing]:
        """A drawing for the node's own colour, and one for each other colour."""
        of_colour: dict[tuple[str, Rgba], list[tuple[Member, int]]] = {}
        for member in self.members.values():
            colour = appearance(member)
            if colour is None or member.shape is None:
                continue
            for n, piece in enumerate(member.shape.pieces):
                # an audience's colour keeps the piece's opacity; an opacity of its own wins
                shade = (*colour[:3], _OPAQUE if piece.colour is None else piece.colour[3])
                if len(colour) == 4:
                    shade = colour
                elif piece.colour is not None and colour == member.colour:
                    shade = piece.colour
                own = shade == (*member.colour, _OPAQUE)
                # behind a hyphen: `Contents` finds the node by the text before it
                name = self.name if own else f"{self.name}-{bytes(shade).hex()}"
                of_colour.setdefault((name, shade), []).append((member, n))
        return {name: self._drawing(some, colour) for (name, colour), some in of_colour.items()}

    def _drawing(self, pieces: list[tuple[Member, int]], colour: Rgba) -> Drawing:
        # equal bytes are equal triangles, which are not sent again
        key = tuple(
            (member.id, member.shape and member.shape.serial, n, member.pose.tobytes())
            for member, n in pieces
        )
        radius = float(np.linalg.norm(self._high - self._low)) / 2
        make = partial(merged, pieces, self._center)
        return Drawing(
            Geometry(key, make, radius, _opacity(colour)),
            np.array([[1.0, 0.0, 0.0, 0.0]]),
            self._center[None],
            np.ones(1),
            np.array([colour[:3]], dtype=np.uint8),
        )


Node = BatchNode | _CloudNode | _MergedNode
"""Group of objects in one node; `members` may shrink, never grow. `drawings` : its scene nodes for
an audience, by name."""


def merged(pieces: Sequence[tuple[Member, int]], center: NDArray[np.float64]) -> Facets:
    """Pieces (member, index) merged in metres, relative to a centre (3,), world frame."""
    vertices, faces, n_vertices = [], [], 0
    for member, n in pieces:
        if member.shape is None:
            continue
        drawn = member.shape.pieces[n].facets
        # about the node's centre in double precision; rounded to float32 last
        turn, at = member.pose[:3, :3], member.pose[:3, 3] - center
        vertices.append((drawn.vertices @ turn.T + at).astype(np.float32))
        faces.append(drawn.faces + np.uint32(n_vertices))
        n_vertices += len(drawn.vertices)
    return Facets(np.concatenate(vertices), np.concatenate(faces))


def gathered(members: Sequence[Member], names: Callable[[], str]) -> list[Node]:
    """Nodes with new names for members with shapes: repeated shapes instanced, others merged."""
    of_shape: dict[int, list[Member]] = {}
    for member in members:
        # by identity: equal parts share one shape
        of_shape.setdefault(id(member.shape), []).append(member)
    nodes: list[Node] = []
    rest: dict[Colour, list[Member]] = {}
    for same in of_shape.values():
        shape = same[0].shape
        if shape is None:
            continue
        if shape.dots is not None:
            nodes.extend(_CloudNode(names(), one, shape, shape.dots) for one in same)
            continue
        saved = (len(same) - 1) * shape.n_triangles  # over merging
        if saved >= 2_000 or shape.n_triangles > MOST_MERGED:
            nodes.append(BatchNode(names(), same, shape))
        else:
            for member in same:
                rest.setdefault(member.colour, []).append(member)
    for same in rest.values():
        nodes.extend(_MergedNode(names(), run) for run in _runs(same))
    return nodes


def _runs(members: list[Member]) -> list[list[Member]]:
    """Runs of at most `MOST_MERGED` triangles, along the Z-order of their centres."""
    centers = np.array([member.box.mean(axis=0) for member in members])
    low = centers.min(axis=0)
    size = max(float((centers - low).max()), 1e-12)
    steps = np.minimum((centers - low) / size * 1024, 1023).astype(np.int64)
    # along the Z-order neighbours in space are in one run
    order = np.argsort(curves.encode(steps, 10, curves.Z_ORDER), kind="stable").tolist()
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
