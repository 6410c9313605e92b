"""What a file names and does not bring, hides or moves is told, and its geometry is kept."""

import struct
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from hapticdb.mesh import parse_in_process
from mesh_files import COLLADA, MESH_3MF, area_and_volume, cause, gltf, names, text, threemf

TRIANGLE_OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nusemtl red\nf 1 2 3\n"
ITEM = '<item objectid="1"/>'
OBJECT = f'<object id="1" name="a">{MESH_3MF}</object>'


def missing(which: str, n: int = 1) -> str:
    files = "1 file with its colours or pictures is" if n == 1 else f"{n} files with its colours or"
    return f"{files}{' pictures are' if n > 1 else ''} not readable beside it: {which}"


# --- files that are not there -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("line", "which", "is_red"),
    [
        ("red.mtl", "", True),
        ("./red.mtl", "", True),
        ("gone.mtl", "gone.mtl", False),
        ("red.mtl gone.mtl", "gone.mtl", True),
        ("my gone.mtl", "my gone.mtl", False),
        ("../red.mtl", "../red.mtl", False),
        ("..\\red.mtl", "..\\red.mtl", False),
        ("..%2Fred.mtl", "..%2Fred.mtl", False),
        (f"{'x' * 300}.mtl", f"{'x' * 56}.mtl", False),
        ("50%25.mtl", "", True),
        ("gone.mtl\nmtllib gone.mtl", "gone.mtl", False),
    ],
)
def test_obj_missing_material_file_note(
    tmp_path: Path, line: str, which: str, is_red: bool
) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    for place in (tmp_path, folder):
        for name in ("red.mtl", "50%25.mtl"):
            text(place / name, "newmtl red\nKd 1 0 0\n")
    file = parse_in_process(text(folder / "a.obj", f"mtllib {line}\n{TRIANGLE_OBJ}"))
    assert file.notes == ((missing(which),) if which else ())
    assert area_and_volume(file)[0] == 0.5
    assert (file.parts[0].colours is not None) == is_red


def test_obj_missing_texture_note(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    text(tmp_path / "in" / "there it is.png", "x")
    materials = (
        "map_Kd in\\there it is.png\nmap_d -s 1 1 1 gone.png\nmap_Kd gone.png\nbump no.png\n"
    )
    text(tmp_path / "a.mtl", f"newmtl red\nKd 1 0 0\n{materials}")
    file = parse_in_process(text(tmp_path / "a.obj", f"mtllib a.mtl\n{TRIANGLE_OBJ}"))
    assert file.notes == (missing("gone.png"),)


def test_gltf_collada_missing_texture_note(tmp_path: Path) -> None:
    text(tmp_path / "there it is.png", "x")
    uris = ["gone%20one.png", "there%20it%20is.png", "data:image/png;base64,aaaa", 3, "gone.png"]
    images: list[Any] = [*({"uri": uri} for uri in uris), {"bufferView": 0}, 7]
    path = gltf({"images": images}, tmp_path / "a.gltf")
    assert parse_in_process(path).notes == (missing("gone.png, gone%20one.png", 2),)
    library = (
        '<library_images><image id="a"><init_from>file:///no/gone.png</init_from></image>'
        '<image id="b"><init_from><ref>there%20it%20is.png</ref></init_from></image>'
        '<image id="c"><init_from><hex format="png">89504e47</hex></init_from></image>'
        "</library_images><library_effects><effect><newparam><surface><init_from>a</init_from></surface></newparam>"
        "</effect></library_effects>"
    )
    path = text(tmp_path / "a.dae", COLLADA.replace("<library_g", f"{library}<library_g", 1))
    assert parse_in_process(path).notes == (missing("/no/gone.png"),)


def test_step_external_files_note(test_data: Path | None, tmp_path: Path) -> None:
    content = _step(test_data)
    named = content.replace(b"DATA;", b"DATA;\n#900=DOCUMENT_FILE('w.stp','','',#901,'',$);", 1)
    (tmp_path / "a.step").write_bytes(named)
    notes = parse_in_process(tmp_path / "a.step").notes
    assert notes == ("1 other file is named in it, and is not read",)


def _step(test_data: Path | None) -> bytes:
    if test_data is None:
        pytest.skip("HAPTICDB_TEST_DATA names no folder: there is no STEP file to change")
    return (test_data / "reports" / "s04_latin1.step").read_bytes()


# --- what moves, and what is hidden -----------------------------------------------------------


def test_gltf_collada_animated_nodes_note(tmp_path: Path) -> None:
    targets = [
        {"node": n, "path": path} for n, path in ((0, "scale"), (0, "weights"), (7, "scale"))
    ]
    moving = {"animations": [{"channels": [{"sampler": 0, "target": one} for one in targets]}]}
    told = ("1 node is moved by animations, which are not read",)
    assert parse_in_process(gltf(moving, tmp_path / "a.gltf")).notes == told
    for damaged in (3, [3], [{"channels": [{"target": {"node": [], "path": 1}}]}]):
        assert not parse_in_process(gltf({"animations": damaged}, tmp_path / "b.gltf")).notes
    names_of = ("a/translate.X", "a/translate.Y", "b/transform(3)(0)", "lamp/colour")
    channels = "".join(f'<channel source="#s" target="{name}"/>' for name in names_of)
    library = f"<library_animations><animation>{channels}</animation></library_animations>"
    path = text(tmp_path / "a.dae", COLLADA.replace("<library_g", f"{library}<library_g", 1))
    assert parse_in_process(path).notes == ("2 nodes are moved by animations, which are not read",)


def test_collada_threemf_hidden_items_note(
    tmp_path: Path,
) -> None:
    extra = "<extra><technique><visibility>0</visibility></technique></extra>"
    path = text(tmp_path / "a.dae", COLLADA.replace("<scale>", f"{extra}<scale>", 1))
    told = ("1 node is hidden in it, and comes in like any other",)
    assert parse_in_process(path).notes == told
    path = threemf(tmp_path / "a.3mf", OBJECT, '<item objectid="1" printable="0"/>')
    told = ("1 object is of the type not printable, and comes in like any other",)
    assert parse_in_process(path).notes == told


# --- extensions that a 3MF requires, and meshes beside components -----------------------------


@pytest.mark.parametrize(
    ("required", "named"),
    [("", ""), ("m b", ""), ("v", "http://v.example/solid/2022/01"), ("m zz", "zz")],
)
def test_threemf_required_extensions(tmp_path: Path, required: str, named: str) -> None:
    schemas = "http://schemas.microsoft.com/3dmanufacturing"
    spaces = f'xmlns:v="http://v.example/solid/2022/01" xmlns:m="{schemas}/material/2015/02"'
    spaces += f' xmlns:b="{schemas}/beamlattice/2017/02" requiredextensions="{required}"'
    path = threemf(tmp_path / "a.3mf", OBJECT, ITEM, f'unit="meter" {spaces}')
    if named:
        assert f"it requires the 3MF extension {named}, which is not read" in cause(path)
    else:
        assert area_and_volume(parse_in_process(path))[0] == 0.5


def test_threemf_object_with_mesh_and_components(tmp_path: Path) -> None:
    both = f'<object id="2" name="b">{MESH_3MF}<components><component objectid="1"/></components>'
    path = threemf(tmp_path / "a.3mf", f"{OBJECT}{both}</object>", '<item objectid="2"/>')
    assert names(parse_in_process(path)) == ["b", "b/a"]


# --- units that a comment names ---------------------------------------------------------------


@pytest.mark.parametrize(
    ("comment", "metres"),
    [
        ("This file uses centimeters as units for non-parametric coordinates.", 0.01),
        ("The units used in this file are centimeters.", 0.01),
        ("File units = inches", 0.0254),
        ("units: mm", 0.001),
        ("Unit = Foot", 0.3048),
        ("units in metres", 1.0),
        ("The units are in millimeters.", 0.001),
        ("units: in", 0.0254),
        ("Units: in progress", None),
        ("12 units in stock", None),
        ("units of speed: mm/s, area unit: mm^2, unit=mm2", None),
        ("object foot unit", None),
        ("unit = 0.001 m", None),
        ("units: parsecs", None),
    ],
)
def test_ply_obj_unit_in_comment(tmp_path: Path, comment: str, metres: float | None) -> None:
    rows = "0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    ply = f"ply\nformat ascii 1.0\ncomment {comment}\nelement vertex 3\n"
    ply += "".join(f"property float {axis}\n" for axis in "xyz")
    ply += "element face 1\nproperty list uchar int vertex_index\nend_header\n"
    corners = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype="<f4").tobytes()
    contents = {
        "a.obj": f"# {comment}\n{TRIANGLE_OBJ}".encode(),
        "a.off": f"OFF\n# {comment}\n3 1 0\n{rows}".encode(),
        "a.ply": f"{ply}{rows}".encode(),
        "a.stl": comment.encode().ljust(80) + b"\1\0\0\0" + bytes(12) + corners + bytes(2),
    }
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content)
        file = parse_in_process(tmp_path / name)
        assert file.names_unit == bool(file.notes) == (metres is not None)
        assert file.bounds[1, 0] == pytest.approx(metres or 1.0)
        assert parse_in_process(tmp_path / name, unit="km").bounds[1, 0] == 1000.0


# --- long words of STEP -----------------------------------------------------------------------


def test_step_long_comments_and_names(test_data: Path | None, tmp_path: Path) -> None:
    content = _step(test_data)
    long = b"/* '" + b"x" * 3_000_000 + b" #1=; END-ISO-10303-21; */"
    changed = [long + content, content.replace(b"DATA;", b"DATA;" + long, 1)]
    words = [b"/* no comment */" * 5_000, (b"x" * 7_000 + b"''") * 3, b"''" * 4_500]
    changed += [content.replace("Träger".encode("latin-1"), word) for word in words]
    for n, one in enumerate(changed):
        (tmp_path / f"{n}.step").write_bytes(one)
        file = parse_in_process(tmp_path / f"{n}.step")
        assert area_and_volume(file)[0] == pytest.approx(2 * np.pi * 5e-3 * 45e-3, rel=3e-3)
        told = ["4 strings of more than 8,000 characters are cut"] if n > 1 else []
        assert [note for note in file.notes if "/" not in note] == told
    (tmp_path / "open.step").write_bytes(content.replace(b"DATA;", b"DATA; /*", 1))
    assert "it seems cut short" in cause(tmp_path / "open.step")


# --- integers of a LAS file -----------------------------------------------------------------------

ENDS = np.iinfo(np.int32)


def las(path: Path, integers: Any, scale: Any = 0.001) -> Path:  # noqa: ANN401 - what numpy takes
    """A LAS file whose points have these integers (n, 3)."""
    made = laspy.create(point_format=0, file_version="1.2")
    made.X, made.Y, made.Z = np.asarray(integers, dtype=np.int32).T
    made.write(path)
    content = bytearray(path.read_bytes())
    struct.pack_into("<3d", content, 131, *np.broadcast_to(scale, 3))
    path.write_bytes(content)
    return path


def spread(n: int = 1000) -> np.ndarray[Any, np.dtype[np.int32]]:
    """Integers (n, 3) far from both ends."""
    return np.random.default_rng(1).integers(-(10**6), 10**6, (n, 3), dtype=np.int32)


@pytest.mark.parametrize("end", [ENDS.min, ENDS.max])
def test_las_points_at_integer_limits(tmp_path: Path, end: int) -> None:
    """All of them, as where a northing of 5,000 km is written in millimetres; then a few."""
    integers = spread()
    integers[:, 1] = end
    line = cause(las(tmp_path / "a.las", integers))
    assert "1,000 points are stuck in y at the end of 32-bit integers" in line
    assert "larger scale" in line
    integers = spread()
    integers[:3, 2] = end
    (note,) = parse_in_process(las(tmp_path / "b.las", integers)).notes
    assert note == "3 points are stuck in z at the end of 32-bit integers"


def test_las_scale_chosen_by_extent(tmp_path: Path) -> None:
    """The farthest points then have the greatest integers, whichever integers begin."""
    for name, low in (("a.las", ENDS.min), ("b.las", 0)):
        integers = spread()
        integers[:200, 0], integers[200:400, 0] = low, ENDS.max
        if low == 0:
            np.abs(integers, out=integers)
        assert parse_in_process(las(tmp_path / name, integers, 1e-8)).notes == ()


def test_las_scale_zero_or_coarse(tmp_path: Path) -> None:
    line = cause(las(tmp_path / "a.las", spread(), (0.001, 0.0, 0.0)))
    assert "the scale of its y and z is 0" in line
    (note,) = parse_in_process(las(tmp_path / "b.las", spread(), (0.001, 1.0, 0.001))).notes
    assert note.startswith("its points lie on a grid of 1 m, if its numbers are metres: ")
    assert parse_in_process(las(tmp_path / "c.las", spread(), 0.1)).notes == ()
