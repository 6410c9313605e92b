"""Objects of the scene, their nodes, and the audiences of the nodes."""

from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from itertools import count
from threading import RLock

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hapticdb.page.colours import colour_of
from hapticdb.page.scene.drawings import Audience, Drawing, PointDrawing
from hapticdb.page.scene.nodes import Appearance, BatchNode, Member, Node, gathered
from hapticdb.page.scene.picking import RayHit, Targets
from hapticdb.page.scene.polar_decomposition import decompose
from hapticdb.page.scene.shapes import PartShape
from hapticdb.store.base import Object

ALL = "all"
"""Key of the audience of all browsers."""
MOST_SINGLE = 128
"""Greatest number of moved objects with a node of their own; further ones are merged anew."""


class Contents:
    """Objects, nodes, ray targets and audiences; thread-safe.

    audience : nodes of all browsers together.
    """

    def __init__(self, audience: Audience) -> None:
        # reentrant: `add` calls `remove` and `refresh` under it
        self.lock = RLock()
        self.records: dict[int, Object] = {}
        """Objects by id, as last read from the database."""
        self._members: dict[int, Member] = {}
        self._home: dict[int, Node] = {}
        self._targets = Targets(self._members)
        self._audiences: dict[Hashable, tuple[Audience, Appearance]] = {
            ALL: (audience, lambda member: member.colour)
        }
        self._shown: dict[str, Mapping[str, Drawing | PointDrawing]] = {}
        self._stale: dict[str, Node] = {}
        self._numbers = count()
        self._loose: set[int] = set()
        self._preview: dict[int, NDArray[np.float64]] = {}

    def add(self, objects: Sequence[Object]) -> None:
        """Show objects as their AABBs, until `shape` replaces these."""
        with self.lock:
            members = []
            for obj in objects:
                self.remove([obj.id])
                self.records[obj.id] = obj
                pose = decompose(obj.transform).pose
                members.append(Member(obj.id, pose, obj.bounds, colour_of(obj)))
            if members:
                self._settle([BatchNode(self._name(), members, None)])
            self.refresh()

    def remove(self, ids: Iterable[int]) -> None:
        """Remove objects; unknown ids are ignored."""
        with self.lock:
            for object_id in ids:
                if self.records.pop(object_id, None) is not None:
                    self._leave(object_id)
                    del self._members[object_id]
                    self._targets.changed()
                    self._loose.discard(object_id)
                    self._preview.pop(object_id, None)

    def shape(self, found: Sequence[tuple[Object, PartShape, NDArray[np.float64]]]) -> None:
        """Set objects' shapes and poses (4, 4); objects changed meanwhile are skipped.

        An object in rigid motion meanwhile has its shape at its newer placement.
        """
        with self.lock:
            members = []
            for read, shape, pose in found:
                # shapes are read in another thread: the object may have changed since
                now = self.records.get(read.id)
                if now is None or not (now is read or is_same_shape(now, read)):
                    continue
                member = self._members[read.id]
                # a preview or a commit meanwhile: rigid, so the shape is only carried along
                moved = motion(read.transform, self._preview.get(read.id, now.transform))
                member.shape, member.pose = shape, moved @ pose
                member.box = shape.bounds(member.pose)
                if shape.colour is not None:
                    member.colour = shape.colour[:3]
                self._leave(read.id)
                members.append(member)
            self._settle(gathered(members, self._name))
            self.refresh()

    def move(self, object_id: int, transform: ArrayLike, record: Object | None = None) -> bool:
        """Show an object at a placement (4, 4), world_from_part; False for an unknown id.

        record : the object after a committed move. Without it the move is a preview, until the next
        commit of the object.
        """
        placed = np.asarray(transform, dtype=np.float64)
        with self.lock:
            if object_id not in self.records:
                return False
            base = self.records[object_id].transform
            member = self._members[object_id]
            # relative to what is shown: previews do not add up on the record
            at = self._preview.get(object_id, base)
            member.pose = motion(at, placed) @ member.pose
            if record is None:
                self._preview[object_id] = placed
            else:
                self.records[object_id] = record
                self._preview.pop(object_id, None)
            if member.shape is not None:
                member.box = member.shape.bounds(member.pose)
            elif record is not None:
                member.box = record.bounds
            self._moved(member)
            return True

    def _moved(self, member: Member) -> None:
        home = self._home[member.id]
        self._targets.changed()
        # a merged mesh is sent whole at each move: out of it at the first one
        if not home.is_cheap_to_move and member.shape and len(self._loose) < MOST_SINGLE:
            self._leave(member.id)
            self._loose.add(member.id)
            self._settle([BatchNode(self._name(), [member], member.shape)])
        else:
            self._stale[home.name] = home

    def _leave(self, object_id: int) -> None:
        """Remove an object from its node."""
        home = self._home.pop(object_id, None)
        if home is not None:
            del home.members[object_id]
            self._stale[home.name] = home

    def _settle(self, nodes: Iterable[Node]) -> None:
        """Make new nodes the homes of their members."""
        for node in nodes:
            for member in node.members.values():
                self._members[member.id] = member
                self._home[member.id] = node
            self._targets.changed()
            self._stale[node.name] = node

    def _name(self) -> str:
        return f"/parts/{next(self._numbers)}"

    def watch(self, key: Hashable, audience: Audience, appearance: Appearance) -> None:
        """Add the audience of one browser."""
        with self.lock:
            self._audiences[key] = (audience, appearance)
            self.see(key, self._home)

    def leave(self, key: Hashable) -> None:
        """Remove a browser's audience."""
        with self.lock:
            self._audiences.pop(key, None)

    def see(self, key: Hashable, ids: Iterable[int]) -> None:
        """Redraw objects for one browser, after a change of its view."""
        with self.lock:
            if key not in self._audiences:
                return
            audience, appearance = self._audiences[key]
            nodes = {self._home[i].name: self._home[i] for i in ids if i in self._home}
            for node in nodes.values():
                self._sync(node, audience, appearance)

    def refresh(self) -> None:
        """Redraw changed nodes for all audiences."""
        with self.lock:
            # collected: several changes of a node are one drawing
            stale, self._stale = self._stale, {}
            for node in stale.values():
                for audience, appearance in self._audiences.values():
                    self._sync(node, audience, appearance)

    def _sync(self, node: Node, audience: Audience, appearance: Appearance) -> None:
        """Update an audience's scene nodes to its view of a node's objects."""
        wanted: Mapping[str, Drawing | PointDrawing]
        wanted = node.drawings(appearance) if node.members else {}
        # first in the dict, so `_shown` is new when the browsers are compared with it
        if audience is self._audiences[ALL][0]:
            before = self._shown.pop(node.name, {})
            for name in before.keys() - wanted.keys():
                audience.drop(name)
            if wanted:
                self._shown[node.name] = wanted
            for name, drawing in wanted.items():
                audience.put(name, drawing)
            return
        shared = self._shown.get(node.name, {})
        # what this browser has of the node by itself: put or blanked earlier
        own = {name for name in audience.names if name.partition("-")[0] == node.name}
        for name in wanted.keys() | shared.keys() | own:
            # copy on write: a browser gets a node of its own only where its view differs
            if name in wanted and not (name in shared and wanted[name].equals(shared[name])):
                audience.put(name, wanted[name])
            elif name in shared and name not in wanted:
                audience.blank(name)
            else:
                audience.drop(name)

    def pick(
        self, origin: ArrayLike, direction: ArrayLike, sees: Callable[[int], bool]
    ) -> RayHit | None:
        """Nearest object along a ray, world frame, among those of `sees`; None without a hit."""
        with self.lock:
            return self._targets.first(origin, direction, sees)

    def boxes(self, sees: Callable[[int], bool] = lambda _: True) -> NDArray[np.float64]:
        """AABBs (n, 2, 3) of the objects of `sees` as shown now, metres."""
        with self.lock:
            boxes = [member.box for member in self._members.values() if sees(member.id)]
        return np.array(boxes).reshape(-1, 2, 3)

    def box(self) -> NDArray[np.float64] | None:
        """AABB (2, 3) of all objects as shown now, metres; None without objects."""
        boxes = self.boxes()
        return np.stack([boxes[:, 0].min(0), boxes[:, 1].max(0)]) if len(boxes) else None

    def waiting(self) -> int:
        """Number of objects without a shape yet."""
        with self.lock:
            return sum(member.shape is None for member in self._members.values())


def is_same_shape(one: Object, other: Object) -> bool:
    """Whether two states of an object differ by a rigid motion at most."""
    return (
        one.digest == other.digest
        and one.link == other.link
        and decompose(one.transform).key == decompose(other.transform).key
    )


def motion(before: NDArray[np.float64], after: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rigid motion (4, 4), world frame, between two placements of equal stretch."""
    if np.array_equal(before, after):
        return np.eye(4)
    start, end = decompose(before).pose, decompose(after).pose
    back = np.eye(4)
    back[:3, :3] = start[:3, :3].T
    back[:3, 3] = -back[:3, :3] @ start[:3, 3]
    return np.asarray(end @ back)
