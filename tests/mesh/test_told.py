"""What a file names and does not bring, hides or moves is told, and its geometry is kept."""

from pathlib import Path

import numpy as np
import pytest

from hapticdb.mesh import parse_in_process
from mesh_files import area_and_volume, cause


def test_other_files_of_a_step_assembly_are_told(test_data: Path | None, tmp_path: Path) -> None:
    content = _step(test_data)
    named = content.replace(b"DATA;", b"DATA;\n#900=DOCUMENT_FILE('w.stp','','',#901,'',$);", 1)
    (tmp_path / "a.step").write_bytes(named)
    notes = parse_in_process(tmp_path / "a.step").notes
    assert notes == ("1 other file is named in it, and is not read",)


def _step(test_data: Path | None) -> bytes:
    if test_data is None:
        pytest.skip("HAPTICDB_TEST_DATA names no folder: there is no STEP file to change")
    return (test_data / "reports" / "s04_latin1.step").read_bytes()


def test_long_comments_and_names_of_a_step_file_do_no_harm(
    test_data: Path | None, tmp_path: Path
) -> None:
    content = _step(test_data)
    long = b"/* '" + b"x" * 3_000_000 + b" #1=; END-ISO-10303-21; */"
    changed = [long + content, content.replace(b"DATA;", b"DATA;" + long, 1)]
    changed += [content.replace("Träger".encode("latin-1"), b"/* no comment */" * 5_000)]
    for n, one in enumerate(changed):
        (tmp_path / f"{n}.step").write_bytes(one)
        file = parse_in_process(tmp_path / f"{n}.step")
        assert area_and_volume(file)[0] == pytest.approx(2 * np.pi * 5e-3 * 45e-3, rel=3e-3)
        assert not [note for note in file.notes if "/" not in note]
    (tmp_path / "open.step").write_bytes(content.replace(b"DATA;", b"DATA; /*", 1))
    assert "it seems cut short" in cause(tmp_path / "open.step")
