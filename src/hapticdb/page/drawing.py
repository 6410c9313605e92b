"""Nodes of one person's view, apart from the objects: hand, tool, arrows, contacts, marks."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from viser import (
    ArrowsHandle,
    ClientHandle,
    MeshHandle,
    SceneApi,
    SceneNodeHandle,
    TransformControlsHandle,
)

from hapticdb.page import colours
from hapticdb.page.tools import PageTool

Floats = NDArray[np.float64]

LEAST_DRAWN = 2e-4
"""Least change drawn: of positions as a share of the diagonal, of forces as a share of the cap."""
PLUMB: colours.Colour = (70, 80, 95)
"""Colour of the plumb line."""
CONTACT_SHARE = 0.004
"""Size of a contact mark, as a share of the scene's diagonal."""


def add_tool(
    scene: SceneApi, name: str, tool: PageTool, colour: colours.Colour, opacity: float | None
) -> MeshHandle:
    """Add a tool's surface to a scene; the pose of its handle is the tool's."""
    return scene.add_mesh_simple(
        name, tool.vertices, tool.faces, color=colour, opacity=opacity, side="double",
        flat_shading=not tool.is_round, cast_shadow=opacity is None, receive_shadow=False,
    )  # fmt: skip


def add_arrow(
    scene: SceneApi, name: str, colour: colours.Colour, width: float, middle: Floats
) -> ArrowsHandle:
    """Add a hidden arrow with a head of radius `width`, metres, at `middle` (3,)."""
    return scene.add_arrows(
        name, np.zeros((1, 2, 3)), colour, shaft_radius=0.35 * width, head_radius=width,
        head_length=2.2 * width, visible=False, position=middle,
    )  # fmt: skip


def add_marks(
    scene: SceneApi, name: str, places: Floats, words: str, size: float
) -> list[SceneNodeHandle]:
    """Mark points (N, 3), metres, with a label at the first; returns the nodes."""
    return [
        scene.add_point_cloud(
            name, places - places[0], (255, 214, 0), point_size=size, point_shape="circle",
            precision="float32", position=places[0],
        ),
        scene.add_label(f"{name}_words", words, position=tuple(places[0]), anchor="bottom-left"),
    ]  # fmt: skip


def put_at(node: SceneNodeHandle, pose: NDArray[np.floating]) -> None:
    """Set a node's pose (7,): metres, unit quaternion, scalar first."""
    node.position = pose[:3]
    node.wxyz = pose[3:]


class HandDrawing:
    """Hand and tool of one person, in their view alone.

    diagonal : of the scene's AABB, metres; unit of arrow and mark sizes; middle (3,) : centre of
    that AABB, origin of the points, since viser sends float32; cap : greatest force sent, N.
    """

    def __init__(self, client: ClientHandle, diagonal: float, middle: Floats, cap: float) -> None:
        self._client = client
        self._diagonal = diagonal
        self.middle = middle
        """Position of the nodes with points relative to it."""
        self.cap = cap
        self._ghost: MeshHandle | None = None
        self._seen = np.full(12, 1e300)
        self._marked = np.empty((0, 3))
        scene = client.scene
        self.gizmo: TransformControlsHandle = scene.add_transform_controls(
            "/hand", scale=110.0, fixed=True, line_width=3.0, disable_sliders=True,
            opacity=0.9, depth_test=False, visible=False, translation_limits=((-1e9, 1e9),) * 3,
        )  # fmt: skip
        # Visible until the hand moves. Browsers place letters in float32: far away they scatter.
        step = float(np.spacing(np.abs(middle).max().astype(np.float32)))
        self.words = scene.add_label(
            "/hand/words", "", anchor="top-right", visible=step < LEAST_DRAWN * diagonal
        )
        nothing = np.zeros((1, 2, 3))
        self._force = add_arrow(scene, "/force", colours.FORCE, 0.01 * diagonal, middle)
        self._torque = add_arrow(scene, "/torque", colours.TORQUE, 0.008 * diagonal, middle)
        self._tether = scene.add_line_segments(
            "/tether", nothing, (120, 120, 130), thickness=2.0, thickness_units="screen",
            visible=False, position=self.middle,
        )  # fmt: skip
        self._plumb = scene.add_line_segments(
            "/plumb", nothing, PLUMB, thickness=1.5, thickness_units="screen", visible=False,
            position=self.middle,
        )  # fmt: skip
        self._spot = scene.add_point_cloud(
            "/spot", np.zeros((1, 3)), PLUMB, point_size=3 * CONTACT_SHARE * diagonal,
            point_shape="circle", point_shading="flat", precision="float32", visible=False,
            position=self.middle,
        )  # fmt: skip
        self._contacts = scene.add_point_cloud(
            "/contacts", np.zeros((1, 3)), colours.FORCE, point_size=CONTACT_SHARE * diagonal,
            point_shape="circle", precision="float32", visible=False, position=self.middle,
        )  # fmt: skip

    def show_ghost(self, tool: PageTool, colour: colours.Colour, pose: Floats) -> None:
        """Show a tool's ghost at the gizmo, both at a pose (7,)."""
        if self._ghost is not None:
            self._ghost.remove()
        self.gizmo.visible = True
        self.words.text = f"drag the {tool.name}"
        put_at(self.gizmo, pose)
        self._ghost = add_tool(self._client.scene, "/hand/ghost", tool, colour, 0.28)

    def show(self, tool: Floats, hand: Floats, wrench: Floats) -> None:
        """Show the wrench (6,), N and N m, at the tool (7,), and a line from the hand (7,)."""
        # forces in units of the scene: one threshold for positions and forces
        seen = np.concatenate([tool[:3], hand[:3], wrench / self.cap * self._diagonal])
        if np.abs(seen - self._seen).max() < LEAST_DRAWN * self._diagonal:
            return
        self._seen = seen
        with self._client.atomic():
            # a torque is drawn as its force at this lever
            place, lever = tool[:3], 0.03 * self._diagonal
            self.point(self._force, place, wrench[:3])
            self.point(self._torque, place, wrench[3:] / lever)
            apart = float(np.linalg.norm(hand[:3] - place))
            self._tether.visible = apart > 0.002 * self._diagonal
            if self._tether.visible:
                self._tether.points = self._sent([[place, hand[:3]]])

    def _sent(self, points: ArrayLike) -> NDArray[np.float32]:
        """Points relative to `middle`."""
        return np.asarray(np.asarray(points) - self.middle, np.float32)

    def point(self, arrow: ArrowsHandle, start: Floats, force: Floats) -> None:
        """Show a force (3,), N, at a position by an arrow with its node at `middle`."""
        longest = 0.22 * self._diagonal  # at the force cap
        arrow_vector = force * (longest / self.cap)
        length = float(np.linalg.norm(arrow_vector))
        is_seen = length > 1e-3 * longest
        if is_seen:
            arrow_vector = arrow_vector * (min(length, longest) / length)
            arrow.points = self._sent([[start, start + arrow_vector]])
        arrow.visible = is_seen

    def show_contacts(self, points: Floats, palette: NDArray[np.uint8]) -> None:
        """Mark contacts (n, 3), metres, in colours (n, 3)."""
        is_touching = bool(len(points))
        is_other = len(points) != len(self._marked) or bool(
            (np.abs(points - self._marked) > LEAST_DRAWN * self._diagonal).any()
        )
        if is_touching and is_other:
            self._marked = points
            with self._client.atomic():
                self._contacts.points = self._sent(points)
                self._contacts.colors = palette
        self._contacts.visible = is_touching

    def plumb(self, hand: Floats, below: Floats | None) -> None:
        """Draw a line from the hand to a point below it; none without a point."""
        if below is None:
            self._plumb.visible = self._spot.visible = False
            return
        with self._client.atomic():
            ends = self._sent([[hand, below]])
            if not (self._plumb.visible and np.array_equal(self._plumb.points, ends)):
                self._plumb.points, self._spot.points = ends, ends[0, 1:]
            self._plumb.visible = self._spot.visible = True

    def rest(self) -> None:
        """Hide the wrench, the contacts and the line to the tool."""
        # far from all values: the next `show` draws
        self._seen = np.full(12, 1e300)
        for node in (self._force, self._torque, self._tether, self._contacts):
            node.visible = False
