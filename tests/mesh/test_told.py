"""What a file names and does not bring, hides or moves is told, and its geometry is kept."""

from pathlib import Path

import numpy as np
import pytest

from hapticdb.mesh import parse_in_process
from mesh_files import MESH_3MF, area_and_volume, cause, names, threemf

ITEM = '<item objectid="1"/>'
OBJECT = f'<object id="1" name="a">{MESH_3MF}</object>'


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


# --- extensions that a 3MF requires, and meshes beside components -----------------------------


@pytest.mark.parametrize(
    ("required", "named"),
    [("", ""), ("m b", ""), ("v", "http://v.example/solid/2022/01"), ("m zz", "zz")],
)
def test_a_3mf_that_requires_what_is_not_read_is_refused(
    tmp_path: Path, required: str, named: str
) -> None:
    schemas = "http://schemas.microsoft.com/3dmanufacturing"
    spaces = f'xmlns:v="http://v.example/solid/2022/01" xmlns:m="{schemas}/material/2015/02"'
    spaces += f' xmlns:b="{schemas}/beamlattice/2017/02" requiredextensions="{required}"'
    path = threemf(tmp_path / "a.3mf", OBJECT, ITEM, f'unit="meter" {spaces}')
    if named:
        assert f"it requires the 3MF extension {named}, which is not read" in cause(path)
    else:
        assert area_and_volume(parse_in_process(path))[0] == 0.5


def test_an_object_of_a_3mf_with_a_mesh_and_components_keeps_both(tmp_path: Path) -> None:
    both = f'<object id="2" name="b">{MESH_3MF}<components><component objectid="1"/></components>'
    path = threemf(tmp_path / "a.3mf", f"{OBJECT}{both}</object>", '<item objectid="2"/>')
    assert names(parse_in_process(path)) == ["b", "b/a"]
