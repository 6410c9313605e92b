"""STEP through cascadio (OpenCASCADE): tessellated to GLB, in metres, names kept."""

import tempfile
from dataclasses import replace
from pathlib import Path

import cascadio

from hapticdb.mesh.formats import gltf
from hapticdb.mesh.raw import Parsed, UnreadableError


def read(path: Path) -> Parsed:
    """Parts of a STEP assembly, each solid's surface as triangles.

    The chord error is cascadio's default: 0.01 of the file's unit, or 0.5 rad between neighbouring
    triangles, whichever is coarser on that face.
    """
    if b"ISO-10303-21" not in path.read_bytes()[:1024]:
        raise UnreadableError("it is no STEP file: 'ISO-10303-21' does not stand at its start")
    with tempfile.TemporaryDirectory(prefix="hapticdb-step-") as folder:
        glb = Path(folder) / "tessellated.glb"
        cascadio.step_to_glb(str(path), str(glb))
        if not glb.is_file() or glb.stat().st_size == 0:
            raise UnreadableError("OpenCASCADE finds nothing in it that it can tessellate")
        return replace(gltf.read(glb), up=None)  # the solids keep their axes, whatever they mean
