"""Objects written as rows of the table `object`; `believed` reads them back."""

from typing import Any

import numpy as np

from hapticdb.store import believed
from hapticdb.store.base import Object, Rows

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


def contents(record: Object, rows: Rows, revision: int) -> dict[str, Any]:
    """Bindings of an object's columns."""
    return {
        "id": record.id,
        "name": record.name,
        "link": record.link,
        "digest": record.digest,
        "transform": np.asarray(record.transform, dtype=np.float64).reshape(-1).tolist(),
        "voxels": int(record.voxels),
        "bounds": np.asarray(record.bounds, dtype=np.float64).reshape(-1).tolist(),
        "attributes": believed.attributes_text(record, rows),
        "revision": revision,
    }
