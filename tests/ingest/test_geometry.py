"""Geometry of objects from the database: bit for bit that of their file, each shape read once."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

import hapticdb
from assemblies import assembly, write_obj
from hapticdb.ingest import geometry
from hapticdb.ingest.geometry import parts_of
from hapticdb.mesh import parse_in_process
from recorded_scene import write_parts
from servers import Place


def test_parts_from_store_equal_file(
    tmp_path: Path, place: Place, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On both engines; objects of one shape share its arrays."""
    here, there = write_parts(tmp_path, 12), place()
    parts = {part.name: part for part in parse_in_process(here.with_suffix(".glb")).parts}
    hapticdb.copy_environment(here, there)
    for url in (str(here), there):
        with hapticdb.open(url, read_only=True) as env:
            asked: list[str] = []
            read = env.store.surfaces

            def surfaces(digests: Sequence[str]) -> dict[str, bytes]:
                asked.extend(digests)  # noqa: B023 - called in this turn
                return read(digests)  # noqa: B023

            monkeypatch.setattr(env.store, "surfaces", surfaces)
            found = list(parts_of(env.store, env.objects()[::-1]))
            assert [obj.id for obj, _ in found] == [obj.id for obj in env.objects()[::-1]]
            assert (
                len(asked) == len(set(asked)) == len({obj.digest for obj, _ in found}) < len(found)
            )
            arrays: dict[str, set[int]] = {}
            for obj, part in found:
                wanted = parts[obj.name]
                assert part.digest == obj.digest == wanted.digest
                assert part.vertices.tobytes() == wanted.vertices.tobytes()
                np.testing.assert_array_equal(part.faces, wanted.faces)
                assert (part.colours is not None) == (obj.name == "rod")
                if part.colours is not None and wanted.colours is not None:
                    np.testing.assert_array_equal(part.colours, wanted.colours)
                np.testing.assert_array_equal(part.triangles(), wanted.triangles())
                arrays.setdefault(obj.digest, set()).add(id(part.vertices))
            assert all(len(one) == 1 for one in arrays.values())


def test_import_files_surface_too_large(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(geometry, "MOST_BYTES", 100)
    file = write_obj(tmp_path / "assembly.obj", assembly(2))
    with pytest.raises(hapticdb.errors.FileError, match="part 'ball 0': its surface takes"):
        hapticdb.import_files(tmp_path / "e.db", [file])
    assert not (tmp_path / "e.db").exists()
