"""MJCF, compiled by MuJoCo: a body without joints belongs to the link of its parent."""

import warnings
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import FileError, MissingExtraError, pip_line
from hapticdb.machines import solids
from hapticdb.machines.machine import FIXED, HINGE, SLIDE, Joint, LinkSurface, Machine
from hapticdb.poses import rotation_of

Floats = NDArray[np.float64]


def machine_of_mjcf(path: Path) -> Machine:
    """Machine of an MJCF file."""
    try:
        import mujoco  # noqa: PLC0415 - an extra
    except ImportError:
        raise MissingExtraError(f"MJCF needs MuJoCo: {pip_line('machines')}") from None
    mujoco.set_mju_user_warning(lambda text: warnings.warn(f"{path}: {text}", stacklevel=1))
    try:
        model = mujoco.MjModel.from_xml_path(str(path))
    except ValueError as error:
        raise FileError(f"{path}: {' '.join(str(error).split())}") from None
    finally:
        mujoco.set_mju_user_warning(None)
    with np.errstate(invalid="ignore"):  # infinite places: `read_machine` refuses them
        return _Reading(path, model, mujoco).machine()


class _Reading:
    """State of one reading; bodies of MuJoCo by their numbers."""

    def __init__(self, path: Path, model: Any, mujoco: Any) -> None:  # noqa: ANN401 - untyped
        self._path, self._model = path, model
        self._geom, self._joint, self._equal = mujoco.mjtGeom, mujoco.mjtJoint, mujoco.mjtEq
        self._bodies = _named("body", [model.body(n).name for n in range(model.nbody)])
        self._hinges = _named("joint", [model.joint(n).name for n in range(model.njnt)])
        self._names, self._joints = [self._bodies[0]], list[Joint]()
        self._link = {0: 0}
        self._notes: list[str] = []

    def machine(self) -> Machine:
        model = self._model
        carriers = model.body_weldid.tolist()
        for body in range(1, model.nbody):
            if carriers[body] == body:
                self._add(body)
        pieces: dict[int, list[Floats]] = {}
        is_colliding = (model.geom_contype | model.geom_conaffinity) != 0
        colliding = {carriers[body] for body in model.geom_bodyid[is_colliding].tolist()}
        for geom, body in enumerate(model.geom_bodyid.tolist()):
            carrier = carriers[body]
            if is_colliding[geom] or carrier not in colliding:
                pieces.setdefault(self._link[carrier], []).extend(self._surface(geom, body))
        surfaces = {
            link: LinkSurface(np.concatenate(found), 0.0) for link, found in pieces.items() if found
        }
        return Machine(
            str(self._path), tuple(self._names), surfaces, self._following(), self._excluded(),
            tuple(self._notes),
        )  # fmt: skip

    def _add(self, body: int) -> None:
        """Add a link for a body, and one without surface between each two of its joints.

        A body without joints is a mocap body, fixed where the file has it.
        """
        model = self._model
        parent = self._link[int(model.body_weldid[model.body_parentid[body]])]
        origin = self._in_carrier(int(model.body_parentid[body])) @ _pose(
            model.body_pos[body], model.body_quat[body]
        )
        first, count = int(model.body_jntadr[body]), int(model.body_jntnum[body])
        for n in range(first, first + count):
            kind, name = self._joint(int(model.jnt_type[n])), self._hinges[n]
            if kind not in {self._joint.mjJNT_HINGE, self._joint.mjJNT_SLIDE}:
                raise FileError(
                    f"{self._path}: joint {name!r} is free or a ball: known are hinge and slide"
                )
            low, high = model.jnt_range[n] if model.jnt_limited[n] else (-np.inf, np.inf)
            child = len(self._names)
            is_last = n == first + count - 1
            self._names.append(self._bodies[body] if is_last else f"before {name}")
            self._joints.append(
                Joint(
                    name, HINGE if kind == self._joint.mjJNT_HINGE else SLIDE, parent, child,
                    origin, model.jnt_axis[n].copy(), model.jnt_pos[n].copy(),
                    float(model.qpos0[model.jnt_qposadr[n]]), float(low), float(high),
                )
            )  # fmt: skip
            parent, origin = child, np.eye(4)
        if not count:
            self._names.append(self._bodies[body])
            name, child = f"before {self._bodies[body]}", len(self._names) - 1
            self._joints.append(Joint(name, FIXED, parent, child, origin, np.zeros(3)))
            parent = child
        self._link[body] = parent

    def _in_carrier(self, body: int) -> Floats:
        """Pose (4, 4) of a body in the frame of the one that carries it."""
        model, pose = self._model, np.eye(4)
        while body != model.body_weldid[body]:
            pose = _pose(model.body_pos[body], model.body_quat[body]) @ pose
            body = int(model.body_parentid[body])
        return pose

    def _surface(self, geom: int, body: int) -> list[Floats]:
        """Triangles of a geom, link's frame; none of a plane."""
        model, kinds = self._model, self._geom
        kind, size = kinds(int(model.geom_type[geom])), model.geom_size[geom]
        name = model.geom(geom).name or str(geom)
        if kind == kinds.mjGEOM_PLANE:
            self._notes.append(f"the plane {name} of {self._path} is left out: import a floor")
            return []
        if kind == kinds.mjGEOM_MESH:
            one = model.mesh(model.geom_dataid[geom])
            vertices = model.mesh_vert[one.vertadr[0] :][: one.vertnum[0]].astype(np.float64)
            triangles = vertices[model.mesh_face[one.faceadr[0] :][: one.facenum[0]]]
        elif kind == kinds.mjGEOM_BOX:
            triangles = solids.box(2.0 * size)
        elif kind == kinds.mjGEOM_CYLINDER:
            triangles = solids.cylinder(size[0], 2.0 * size[1])
        elif kind in {kinds.mjGEOM_CAPSULE, kinds.mjGEOM_SPHERE}:
            length = 2.0 * size[1] if kind == kinds.mjGEOM_CAPSULE else 0.0
            triangles = solids.capsule(size[0], length)
        elif kind == kinds.mjGEOM_ELLIPSOID:
            triangles = solids.capsule(1.0, 0.0) * size
        else:
            raise FileError(f"{self._path}: geom {name} is a height field or SDF: make it a mesh")
        pose = self._in_carrier(body) @ _pose(model.geom_pos[geom], model.geom_quat[geom])
        return [triangles @ pose[:3, :3].T + pose[:3, 3]]

    def _following(self) -> tuple[Joint, ...]:
        """Joints, with those that follow others by an equality."""
        model, found = self._model, list(self._joints)
        for n in np.flatnonzero(model.eq_active0).tolist():
            kind, data = self._equal(int(model.eq_type[n])), model.eq_data[n].tolist()
            first, second = int(model.eq_obj1id[n]), int(model.eq_obj2id[n])
            if kind != self._equal.mjEQ_JOINT or second < 0 or any(data[2:5]):
                raise FileError(
                    f"{self._path}: equality {n} is no linear one of two joints: closed "
                    "kinematics are not read, leave it out"
                )
            one, other = found[first], found[second]
            if one.driver:
                raise FileError(
                    f"{self._path}: joint {one.name!r} follows both {one.driver!r} and "
                    f"{other.name!r}: leave out one of them"
                )
            offset = one.zero + data[0] - data[1] * other.zero
            found[first] = one._replace(driver=other.name, factor=data[1], offset=offset)
        return tuple(found)

    def _excluded(self) -> frozenset[frozenset[str]]:
        """Pairs of <exclude>, and links with the one that carries them, but for the world."""
        model, names = self._model, self._names
        carriers = model.body_weldid.tolist()
        pairs = {
            frozenset((self._link[carriers[one >> 16]], self._link[carriers[one & 0xFFFF]]))
            for one in model.exclude_signature.tolist()
        }
        for body, link in self._link.items():
            above = self._link[carriers[int(model.body_parentid[body])]]
            if above:
                pairs.add(frozenset((link, above)))
        return frozenset(frozenset(names[n] for n in pair) for pair in pairs)


def _named(kind: str, names: list[str]) -> list[str]:
    """Names, all different: those without one get their kind and number."""
    found = []
    for n, name in enumerate(names):
        own = name or f"{kind} {n}"
        while not name and own in names:
            own += "'"
        found.append(own)
    return found


def _pose(place: Floats, quaternion: Floats) -> Floats:
    pose = np.eye(4)
    pose[:3, :3] = rotation_of(quaternion)[0]
    pose[:3, 3] = place
    return pose
