"""Vertex positions of a glTF scene: morph weights, skins and instances."""

from itertools import count
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.mesh.formats.accessors import Accessors, extension_of, item, objects_of, whole
from hapticdb.mesh.parsed import UnreadableError
from hapticdb.poses import rotation_of

Floats = NDArray[np.float64]
INSTANCING = "EXT_mesh_gpu_instancing"


class Pose(NamedTuple):
    """Deformation of a mesh: weights of its morph targets, and its node's skin."""

    mesh: int
    weights: tuple[float, ...]
    skin: int | None


def pose_of(node: dict[str, Any], number: int, mesh: dict[str, Any]) -> Pose:
    """Pose of a node's mesh."""
    weights = node.get("weights") or mesh.get("weights") or ()
    skin = None if "skin" not in node else whole(node["skin"], "the 'skin' of a node")
    return Pose(number, tuple(float(weight) for weight in weights), skin)


def parent_from_node(node: dict[str, Any]) -> Floats:
    """Transform (4, 4) of a node: its matrix, or T R S."""
    if "matrix" in node:
        return np.array(node["matrix"], dtype=np.float64).reshape(4, 4).T
    transform = np.eye(4)
    if "rotation" in node:
        xyzw = np.array(node["rotation"], dtype=np.float64).reshape(4)
        length = np.linalg.norm(xyzw)
        if length != 0:
            transform[:3, :3] = rotation_of(np.roll(xyzw / length, 1))[0]
    if "scale" in node:
        transform[:3, :3] *= np.array(node["scale"], dtype=np.float64).reshape(3)
    if "translation" in node:
        transform[:3, 3] = np.array(node["translation"], dtype=np.float64).reshape(3)
    return transform


def instances(node: dict[str, Any], accessors: Accessors) -> list[Floats | None]:
    """Transforms (4, 4) of a node's instances in its frame; None alone if it has none."""
    attributes = (extension_of(node, INSTANCING) or {}).get("attributes")
    if not attributes:
        return [None]
    columns = {name.lower(): accessors.array(number) for name, number in attributes.items()}
    if len({len(column) for column in columns.values()}) > 1:
        raise UnreadableError("the attributes of its instances are not of one length")
    rows = zip(*columns.values(), strict=True)  # other attributes, such as _ID, have no effect
    return [parent_from_node(dict(zip(columns, row, strict=True))) for row in rows]


def joints_of(
    tree: dict[str, Any], skin: int, worlds: dict[int, Floats], accessors: Accessors
) -> Floats:
    """Joint matrices (J, 4, 4) of a skin: world transform times inverse bind matrix."""
    found = item(objects_of(tree, "skins"), skin, "skin")
    if any(joint not in worlds for joint in found["joints"]):
        raise UnreadableError(f"a joint of its skin {skin} is not in its scene")
    joints = np.array([worlds[joint] for joint in found["joints"]])
    if "inverseBindMatrices" in found:
        bound = accessors.array(found["inverseBindMatrices"]).astype(np.float64)
        joints = joints @ bound.reshape(-1, 4, 4).transpose(0, 2, 1)
    return joints


def positions(
    piece: dict[str, Any], pose: Pose, joints: Floats | None, accessors: Accessors
) -> NDArray[Any]:
    """Positions (V, 3) of a primitive in a pose, morphed and skinned."""
    attributes = piece["attributes"]
    found: NDArray[Any] = accessors.array(attributes["POSITION"])
    if found.shape[1] != 3:
        raise UnreadableError("its vertices do not have three coordinates each")
    for weight, target in zip(pose.weights, piece.get("targets", ()), strict=False):
        if weight and "POSITION" in target:
            found = found + weight * accessors.array(target["POSITION"]).astype(np.float64)
    if joints is None or "JOINTS_0" not in attributes:
        return found
    blended, total = np.zeros((len(found), 4, 4)), np.zeros((len(found), 1, 1))
    for n in count():
        if f"JOINTS_{n}" not in attributes:
            break
        numbers = accessors.array(attributes[f"JOINTS_{n}"]).astype(np.int64)
        shares = accessors.array(attributes[f"WEIGHTS_{n}"]).astype(np.float64)
        for joint, share in zip(numbers.T, shares.T, strict=True):
            blended += share[:, None, None] * joints[joint]
            total += share[:, None, None]
    blended = np.where(total > 0, blended / np.where(total > 0, total, 1), np.eye(4))
    turned: NDArray[Any] = (blended[:, :3, :3] @ found[:, :, None])[:, :, 0]
    return turned + blended[:, :3, 3]
