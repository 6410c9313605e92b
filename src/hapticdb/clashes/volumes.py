"""Volumes of overlaps, by the booleans of manifold3d."""

import importlib.util
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np

from hapticdb.clashes.clash_results import Clashes
from hapticdb.errors import MissingExtraError, UsageError, pip_line
from hapticdb.ingest.geometry import parts_of
from hapticdb.mesh.part import Part
from hapticdb.pointshell.orientation import faces_of, orient
from hapticdb.store.base import Object, Store
from hapticdb.verdicts import Kind

if TYPE_CHECKING:
    from manifold3d import Manifold

MOST_SOLIDS = 64
"""Shapes in memory. More: fewer are read again."""


def with_volumes(store: Store, found: Clashes, least: float = 0.0) -> Clashes:
    """Give each overlap its volume, cubic metres, where both surfaces are closed.

    least : overlaps of a smaller known volume are dropped.

    Raises
    ------
    UsageError
        If `least` is out of range.
    MissingExtraError
        If the extra `volume` is not installed.
    """
    if not 0.0 <= least < np.inf:
        raise UsageError(f"a least volume of {least} m3: give 0 or more")
    if importlib.util.find_spec("manifold3d") is None:
        raise MissingExtraError(f"volumes need one more package: {pip_line('volume')}")
    overlaps = [one for one in found.pairs if one.kind == Kind.OVERLAPPING]
    objects = {obj.id: obj for obj in store.objects({i for one in overlaps for i in one[:2]})}
    solids: dict[str, Object] = {obj.digest: obj for obj in objects.values()}

    @lru_cache(maxsize=MOST_SOLIDS)
    def solid(digest: str) -> "Manifold | None":
        return _solid(next(parts_of(store, [solids[digest]]))[1])

    measured = []
    for one in found.pairs:
        a, b = objects.get(one.a), objects.get(one.b)
        if one.kind == Kind.OVERLAPPING and a is not None and b is not None:
            volume = _common(a, b, solid(a.digest), solid(b.digest))
            if volume is not None and volume < least:
                continue
            measured.append(one._replace(volume=volume))
        else:
            measured.append(one)
    return replace(found, current=tuple(measured), rest=found.rest.none())


def _common(a: Object, b: Object, one: "Manifold | None", other: "Manifold | None") -> float | None:
    """Common volume of two objects, cubic metres; None if unknown."""
    if one is None or other is None or not (size := abs(np.linalg.det(a.transform[:3, :3]))):
        return None
    a_from_b = np.linalg.solve(a.transform, b.transform)  # near the origin: digits are kept
    return float((one ^ other.transform(a_from_b[:3])).volume()) * float(size)


def _solid(part: Part) -> "Manifold | None":
    """Solid in the part's frame; None unless the surface is one closed oriented manifold."""
    from manifold3d import Error, Manifold, Mesh64  # noqa: PLC0415 - an extra

    triangles = part.triangles(np.eye(4))
    try:
        surface = orient(triangles)
    except UsageError:  # no triangle, or no area
        return None
    corners = faces_of(triangles)
    first, second, third = np.moveaxis(surface.triangles, 1, 0)
    inward = np.einsum("fk,fk->f", np.cross(second - first, third - first), surface.normals)
    at = np.unique(corners, return_index=True)[1]
    turned = surface.faces[inward > 0.0]
    corners[turned] = corners[turned, ::-1]
    solid = Manifold(Mesh64(triangles.reshape(-1, 3)[at], corners.astype(np.uint64)))
    return solid if solid.status() == Error.NoError and solid.volume() > 0.0 else None
