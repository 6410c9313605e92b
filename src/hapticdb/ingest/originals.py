"""Geometry of stored objects, read from the files that they were imported from."""

from collections.abc import Iterator, Sequence

import numpy as np

from hapticdb.errors import (
    FileError,
    GeometryChangedError,
    HapticDBError,
    MissingExtraError,
    UsageError,
)
from hapticdb.mesh import Part, read_file
from hapticdb.pointshell.shell import PointShell
from hapticdb.store.base import Object


def parts_of(objects: Sequence[Object], to_be: str, instead: str) -> Iterator[tuple[Object, Part]]:
    """Yield objects, ordered by file, with their geometry as it was imported; reads each file once.

    to_be, instead : words for messages: the failed action (``moved``), and what to do instead.
    Raises `GeometryChangedError` if an object's file is missing or has another geometry now.
    """
    for some, part in found_parts(objects, to_be, instead):
        if not isinstance(part, Part):
            raise part
        yield some[0], part


def found_parts(
    objects: Sequence[Object], to_be: str, instead: str
) -> Iterator[tuple[tuple[Object, ...], Part | HapticDBError]]:
    """Yield objects with their geometry, as `parts_of`, or with the error that there is none.

    A geometry comes with one object, an error with all objects that it means.
    """
    of_file: dict[tuple[str, str | None], list[Object]] = {}
    for obj in objects:
        unit = obj.attributes.get("unit")
        of_file.setdefault((obj.link, unit if isinstance(unit, str) else None), []).append(obj)
    for (link, unit), some in of_file.items():
        first = f"object {some[0].id} ({some[0].name})"
        if len(some) > 1:
            first += f" and {len(some) - 1} of the same file"
        try:
            parts = {(part.name, part.digest): part for part in read_file(link, unit=unit).parts}
        except MissingExtraError as error:
            yield tuple(some), error
            continue
        except FileError as error:
            unread = f"{first} cannot be {to_be}, its file cannot be read: {error}"
            yield tuple(some), GeometryChangedError(unread)
            continue
        for obj in some:
            part = parts.get((obj.name, obj.digest))
            yield (
                (obj,),
                part
                or GeometryChangedError(
                    f"object {obj.id} ({obj.name}) cannot be {to_be}: {link} no longer holds the "
                    f"geometry that was imported; {instead}"
                ),
            )


def shell_of_objects(
    objects: Sequence[Object],
    points: int | None,
    spacing: float | None,
    seed: int,
    inset: float = 0.0,
) -> PointShell:
    """Make one shell of several objects at their places; see `Environment.shell`."""
    if not objects:
        raise UsageError("a shell of no objects: name at least one")
    triangles = []
    for obj, part in parts_of(objects, "a tool", "give its mesh as a tool"):
        if part.is_cloud:
            raise UsageError(
                f"object {obj.id} ({obj.name}) is a point cloud, which has no surface: leave it out"
            )
        triangles.append(part.triangles(obj.transform))
    corners = np.concatenate(triangles).reshape(-1, 3)
    faces = np.arange(len(corners)).reshape(-1, 3)
    return PointShell.from_mesh(corners, faces, points, spacing=spacing, seed=seed, inset=inset)
