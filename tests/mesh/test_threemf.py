"""3MF files as programs write them: read rightly, or told what is not read."""

import shutil
import zipfile
from pathlib import Path

import pytest

from hapticdb.mesh import parse_in_process
from mesh_files import MESH_3MF, cause, names, threemf

ITEM = '<item objectid="1"/>'


THING = f'<object id="1">{MESH_3MF}</object>'


def model_3mf(path: Path, name: str, resources: str, build: str = ITEM, **beside: str) -> Path:
    """An archive with a model of that name; `beside` : other members, '_' in names for '/'."""
    threemf(path, resources, build)
    with zipfile.ZipFile(path) as archive:
        model = archive.read("3D/3dmodel.model")
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(name, model)
        for other, content in beside.items():
            archive.writestr(other.replace("__", "/").replace("_DOT_", "."), content)
    return path


def test_threemf_missing_model_named(tmp_path: Path) -> None:
    path = model_3mf(tmp_path / "a.3mf", "3D/other.model", THING)
    assert "its root model 3d/3dmodel.model is missing; 3D/other.model is in it" in cause(path)
    path = model_3mf(tmp_path / "b.3mf", "read.me", THING)
    assert "it is no 3MF file: a ZIP archive without a model in it" in cause(path)
    path = model_3mf(tmp_path / "c.3mf", "3D\\3dmodel.model", THING)
    assert len(parse_in_process(path).parts) == 1


def test_threemf_objects_not_in_build_counted(tmp_path: Path) -> None:
    two = "".join(f'<object id="{n}">{MESH_3MF}</object>' for n in (1, 2))
    file = parse_in_process(threemf(tmp_path / "a.3mf", two, ITEM))
    assert file.notes == ("1 object is not in its build and is left out",)
    assert "2 objects are not in its build" in cause(threemf(tmp_path / "b.3mf", two, ""))


@pytest.mark.parametrize(
    ("settings", "kind"),
    [("Slic3r_PE_model", "NegativeVolume"), ("model_settings", "modifier_part")],
)
def test_threemf_slicer_volumes_note(tmp_path: Path, settings: str, kind: str) -> None:
    beside = {f"Metadata__{settings}_DOT_config": f'<a key="support_type"/><b subtype="{kind}"/>'}
    file = parse_in_process(model_3mf(tmp_path / "a.3mf", "3D/3dmodel.model", THING, **beside))
    assert file.notes == (f"1 object is of the type {kind}, and comes in like any other",)


def test_threemf_root_of_relationships(tmp_path: Path) -> None:
    path = threemf(tmp_path / "a.3mf", f'<object id="1" name="new">{MESH_3MF}</object>', ITEM)
    old = threemf(tmp_path / "b.3mf", f'<object id="1" name="old">{MESH_3MF}</object>', ITEM)
    with zipfile.ZipFile(old) as archive:
        other = archive.read("3D/3dmodel.model")
    with zipfile.ZipFile(path, "a") as archive:
        archive.writestr("3D/Other.model", other)
        archive.writestr("3D/My%20Other.model", other)
        archive.writestr("backup/3D/3dmodel.model", "no XML")
    assert names(parse_in_process(path)) == ["new"]
    for target in (
        "/3D/Other.model",
        "3D/%4Fther.model",
        "./3D/Other.model",
        "3D/My%20Other.model",
    ):
        named = tmp_path / "named.3mf"
        shutil.copy(path, named)
        with zipfile.ZipFile(named, "a") as archive:
            kind = "http://schemas.microsoft.com/3dmanufacturing/2013/01/3dmodel"
            link = f'<Relationship Target="{target}" Id="r" Type="{kind}"/>'
            archive.writestr("_rels/.rels", f"<Relationships>{link}</Relationships>")
        assert names(parse_in_process(named)) == ["old"]


def test_threemf_damage_beside_models(tmp_path: Path) -> None:
    beside = {"Metadata__model_settings_DOT_config": "settings of a slicer"}
    path = model_3mf(tmp_path / "a.3mf", "3D/3dmodel.model", THING, **beside)
    path.write_bytes(path.read_bytes().replace(b"settings of a slicer", b"Settings of a slicer"))
    assert len(parse_in_process(path).parts) == 1
