"""Objects as rows of the table `object`, there and back."""

import json
from typing import Any

import numpy as np

from hapticdb.store.base import Object

OBJECTS = (
    "SELECT id, name, link, digest, transform, voxels, bounds, attributes::text, revision"
    " FROM object"
)
INSERT_OBJECT = """
INSERT INTO object (id, name, link, digest, transform, voxels, bounds, attributes, revision)
VALUES (CASE WHEN %(id)s > 0 AND NOT EXISTS (SELECT 1 FROM object WHERE id = %(id)s)
             THEN %(id)s ELSE %(new_id)s END,
        %(name)s, %(link)s, %(digest)s, %(transform)s, %(voxels)s, %(bounds)s, %(attributes)s,
        %(revision)s)
RETURNING id"""
UPDATE_OBJECT = """
UPDATE object SET digest = %(digest)s, transform = %(transform)s, voxels = %(voxels)s,
       bounds = %(bounds)s, attributes = %(attributes)s, revision = %(revision)s
 WHERE id = %(id)s"""


def object_of(row: tuple[Any, ...]) -> Object:
    """Read an object from its row."""
    return Object(
        id=row[0],
        name=row[1],
        link=row[2],
        digest=row[3],
        transform=np.array(row[4], dtype=np.float64).reshape(4, 4),
        voxels=row[5],
        bounds=np.array(row[6], dtype=np.float64).reshape(2, 3),
        attributes=json.loads(row[7]),
        revision=row[8],
    )


def contents(record: Object, revision: int) -> dict[str, Any]:
    """Bindings of an object's columns."""
    return {
        "id": record.id,
        "name": record.name,
        "link": record.link,
        "digest": record.digest,
        "transform": np.asarray(record.transform, dtype=np.float64).reshape(-1).tolist(),
        "voxels": int(record.voxels),
        "bounds": np.asarray(record.bounds, dtype=np.float64).reshape(-1).tolist(),
        "attributes": json.dumps(dict(record.attributes), sort_keys=True),
        "revision": revision,
    }
