"""IFC: products with their names and attributes, in world coordinates, openings cut."""

from pathlib import Path

import ifcopenshell.api.owner.settings
import numpy as np
import pytest
from ifcopenshell import entity_instance

import hapticdb
from hapticdb.errors import FileError, MissingExtraError
from hapticdb.mesh import MeshFile, Part, parse_in_process, read_file
from ifc_files import Building


def volume(part: Part) -> float:
    a, b, c = np.moveaxis(part.triangles(), 1, 0)
    return float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)


def by_name(file: MeshFile) -> dict[str, Part]:
    return {part.name.rsplit("/", 1)[-1]: part for part in file.parts}


def test_ifc_products_placed(tmp_path: Path) -> None:
    one = Building()
    wall = one.add("IfcWall", "wall", one.shape(one.box(4000, 200, 2500)), (1.0, 2.0, 3.0))
    one.add("IfcColumn", None, one.shape(one.box(300, 300, 2500)), (0.0, 0.0, 3.0))
    file = read_file(one.written(tmp_path / "a.IFC"))
    assert [part.name for part in file.parts] == [
        "site/house/ground/wall", "site/house/ground/IfcColumn"
    ]  # fmt: skip
    assert file.parts[0].attributes == {
        "IfcClass": "IfcWall", "GlobalId": wall.GlobalId, "Storey": "ground"
    }  # fmt: skip
    assert file.parts[0].bounds == pytest.approx(np.array([[-1.0, 1.9, 3.0], [3.0, 2.1, 5.5]]))
    assert volume(file.parts[0]) == pytest.approx(2.0)
    assert (file.up, file.names_unit, file.notes) == ("z", True, ())
    assert [part.chord for part in file.parts] == [0.0, 0.0]


def test_ifc_openings_cut_spaces_left_out(tmp_path: Path) -> None:
    one = Building()
    wall = one.add("IfcWall", "wall", one.shape(one.box(4000, 200, 2500)), (0.0, 0.0, 3.0))
    one.opening(wall, one.shape(one.box(1000, 400, 1000)))
    one.add("IfcSpace", "room", one.shape(one.box(3000, 3000, 2500)))
    one.add("IfcSpace", "hall", one.shape(one.box(3000, 3000, 2500)))
    file = read_file(one.written(tmp_path / "a.ifc"))
    assert [part.name for part in file.parts] == ["site/house/ground/wall"]
    assert volume(file.parts[0]) == pytest.approx(2.0 - 0.2)
    assert file.notes == ("1 opening is left out", "2 spaces are left out")


@pytest.mark.parametrize("version", ["IFC2X3", "IFC4X3"])
def test_ifc_other_schemas(tmp_path: Path, version: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def user(model: ifcopenshell.file) -> entity_instance:  # which IFC2X3 requires
        person = model.create_entity("IfcPerson", FamilyName="p")
        firm = model.create_entity("IfcOrganization", Name="o")
        return model.create_entity("IfcPersonAndOrganization", person, firm)

    def program(model: ifcopenshell.file) -> entity_instance:
        firm = model.create_entity("IfcOrganization", Name="o")
        return model.create_entity("IfcApplication", firm, "1", "a", "a")

    monkeypatch.setattr(ifcopenshell.api.owner.settings, "get_user", user)
    monkeypatch.setattr(ifcopenshell.api.owner.settings, "get_application", program)
    one = Building(version)
    one.add("IfcWall", "wall", one.shape(one.box(4000, 200, 2500)), (0.0, 0.0, 3.0))
    one.add("IfcSpace", "room", one.shape(one.box(3000, 3000, 2500)))
    file = read_file(one.written(tmp_path / "a.ifc"))
    assert [part.name for part in file.parts] == ["site/house/ground/wall"]
    assert volume(file.parts[0]) == pytest.approx(2.0)
    assert file.notes == ("1 space is left out",)


def test_ifc_instances_share_shape(tmp_path: Path) -> None:
    one = Building()
    shape = one.shape(one.box(300, 300, 2500))
    for n in range(2):
        placed = one.shape(mapped(one, shape), "MappedRepresentation")
        one.add("IfcColumn", "column", placed, (n, 0, 0))
    file = parse_in_process(one.written(tmp_path / "a.ifc"))
    assert file.parts[0].vertices is file.parts[1].vertices
    assert [part.name for part in file.parts][1].endswith("column #2")
    assert (file.parts[1].bounds - file.parts[0].bounds)[:, 0] == pytest.approx(1.0)


def mapped(one: Building, shape: entity_instance) -> entity_instance:
    maps = [*one.model.by_type("IfcRepresentationMap")]
    source = maps[0] if maps else one.make(
        "IfcRepresentationMap", MappingOrigin=one.axes(), MappedRepresentation=shape
    )  # fmt: skip
    where = one.make("IfcCartesianTransformationOperator3D", LocalOrigin=one.point(0, 0, 0))
    return one.make("IfcMappedItem", MappingSource=source, MappingTarget=where)


@pytest.mark.parametrize("chord", [1e-3, 1e-4])
def test_ifc_chord_error_of_curved_products(tmp_path: Path, chord: float) -> None:
    one, radius = Building(), 0.1
    one.add("IfcColumn", "post", one.shape(one.cylinder(100, 2500)))
    one.add("IfcColumn", "ball", one.shape(one.sphere(100), "CSG"))
    one.add("IfcRoof", "sheet", one.shape(one.sheet(), "Tessellation"))
    parts = by_name(parse_in_process(one.written(tmp_path / "a.ifc"), chord=chord))
    for name, n_axes in (("post", 2), ("ball", 3)):
        corners = parts[name].triangles(np.eye(4))
        between = np.einsum("cs,fsd->fcd", [[0.5, 0.5, 0.0], [1 / 3] * 3], corners)[..., :n_axes]
        inside = np.linalg.norm(between, axis=2)
        if name == "post":  # the caps are flat
            inside = inside[np.ptp(corners[..., 2], axis=1) > 0.0]
        true = radius - inside.min()
        assert 0.5 * parts[name].chord < true <= parts[name].chord < 3.0 * chord
    assert parts["sheet"].chord == 0.0  # its triangle is the shape


@pytest.mark.parametrize(
    ("change", "cause"),
    [
        (lambda _: "", "it is empty"),
        (lambda _: "solid a", "damaged or not supported"),
        (lambda text: text.replace("'IFC4'", "'IFC9'"), "Unsupported schema: IFC9"),
        (lambda text: text[: text.index("DATA;") + 5], "it holds no triangles.*|.*cut short.*"),
    ],
)  # fmt: skip
def test_ifc_broken_files(tmp_path: Path, change: object, cause: str) -> None:
    assert callable(change)
    one = Building()
    one.add("IfcWall", "wall", one.shape(one.box(4000, 200, 2500)))
    path = one.written(tmp_path / "a.ifc")
    path.write_text(change(path.read_text()))
    with pytest.raises(FileError, match=f"cannot read .*a.ifc: .*({cause})") as refused:
        read_file(path)
    assert "\n" not in str(refused.value)


def test_ifc_without_bodies(tmp_path: Path) -> None:
    one = Building()
    one.add("IfcSpace", "room", one.shape(one.box(3000, 3000, 2500)))
    line = one.make("IfcPolyline", Points=[one.point(0, 0, 0), one.point(1, 0, 0)])
    one.add("IfcAnnotation", "axis", one.shape(line, "Curve3D"))
    with pytest.raises(FileError, match=r"no usable triangle.*1 space is left out, 1 product is"):
        read_file(one.written(tmp_path / "a.ifc"))


def test_ifc_truncated_file(tmp_path: Path) -> None:
    one = Building()
    one.add("IfcWall", "wall", one.shape(one.box(4000, 200, 2500)))
    path = one.written(tmp_path / "a.ifc")
    path.write_text(path.read_text()[: -len("ENDSEC;\nEND-ISO-10303-21;\n")])
    assert "END-ISO-10303-21" in read_file(path).notes[0]


def test_ifc_missing_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = Building().written(tmp_path / "a.ifc")
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    with pytest.raises(MissingExtraError, match=r"\.ifc files need more packages: .*pip install"):
        read_file(path)


def test_ifc_attributes_stored_and_replaced(tmp_path: Path) -> None:
    one = Building()
    wall = one.add("IfcWall", "wall", one.shape(one.box(4000, 200, 2500)), (0.0, 0.0, 3.0))
    path, url = one.written(tmp_path / "a.ifc"), str(tmp_path / "a.db")
    hapticdb.import_files(url, [path], hapticdb.ImportOptions())
    with hapticdb.open(url) as env:
        (found,) = env.find(f"GlobalId={wall.GlobalId}")
        assert found.attributes == {
            "IfcClass": "IfcWall", "GlobalId": wall.GlobalId, "Storey": "ground", "up": "z"
        }  # fmt: skip
        wall.GlobalId = "0" * 22
        one.written(path)
        env.add(path, replace=True)
        assert env.find("IfcClass=Ifc*")[0].attributes["GlobalId"] == "0" * 22
