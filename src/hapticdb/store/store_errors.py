"""Errors common to the stores of all engines."""

from hapticdb.errors import (
    ConflictError,
    EnvironmentExistsError,
    NewerVersionError,
    NotAnEnvironmentError,
    ObjectNotFoundError,
    UsageError,
)
from hapticdb.store.base import Layout, Object

FORMAT = 1
"""Format of the tables of this version: `schema.sql` of each engine."""


def no_object(object_id: int, url: str) -> ObjectNotFoundError:
    """Build the error for an unknown id."""
    return ObjectNotFoundError(
        f"no object {object_id} in {url}; 'hapticdb objects {url}' lists them"
    )


def present_already(record: Object, url: str) -> EnvironmentExistsError:
    """Build the error for a part already in the environment."""
    return EnvironmentExistsError(
        f"{record.name} of {record.link} is in {url} already; remove it first"
    )


def made_before(url: str) -> NotAnEnvironmentError:
    """Build the error for an environment of a format before 1."""
    return NotAnEnvironmentError(f"{url} was made before 0.1; import it again, into a new one")


def check_format(url: str, found: int) -> None:
    """Refuse an environment of a newer format."""
    if found > FORMAT:
        raise NewerVersionError(
            f"{url} has format {found}, newer than the {FORMAT} known here: install a newer "
            "hapticdb"
        )


def check_outside(depth: int, url: str) -> None:
    """Refuse to query for commits of others inside a snapshot, which hides them."""
    if depth:
        raise UsageError(f"{url}: inside a snapshot nothing changes: ask before or after it")


def check_unwritten(record: Object, known: Object, url: str) -> None:
    """Refuse to replace an object written after `record` was derived from it."""
    if record.revision and record.revision != known.revision:
        raise ConflictError(
            f"object {known.id} ({known.name}) of {url} was written by another meanwhile "
            f"(revision {known.revision}, not {record.revision}): read it again, then decide"
        )


def wants_distances(layout: Layout, wish: bool | None) -> bool:  # noqa: FBT001 - as given
    """Whether a new environment has distances: as given, else with bricks; or UsageError."""
    if wish and layout == "voxel":  # a row of distances belongs to a brick
        raise UsageError("the layout voxel has no distances: leave them out, or choose bricks")
    return layout == "brick" if wish is None else wish
