"""Files of the kinds that people report about programs like this one, each read rightly or told."""

from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from hapticdb.mesh import parse_in_process
from mesh_files import area_and_volume, cause, names, text


class Reads(NamedTuple):
    """Expected content: names, area (m^2), volume (m^3), least and greatest corner, notes."""

    names: list[str]
    area: float
    volume: float
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    note: str = ""


HALF = ((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
BOX_3MF = ((-0.005, -0.005, -0.005), (0.005, 0.005, 0.005))
TENTH = ((-0.1, -0.1, -0.1), (0.1, 0.1, 0.1))

EXPECTED: dict[str, Reads | str] = {
    "b01_bom_v_first.obj": Reads(["b01_bom_v_first"], 6, 1, *HALF),
    "b04_cat_no_newline.stl": Reads(["inlet", "outlet", "walls"], 18, 3, (-0.5, -0.5, -0.5),
        (10.5, 0.5, 0.5)),
    "b07_openscad_dup.stl": Reads(["OpenSCAD_Model"], 6, 1, *HALF),
    "c1_both.obj": Reads(["solid", "pin"], 6.06, 1.001, *HALF),
    "c1_tool.obj": Reads(["tool"], 0.06, 0.001, (-0.05, -0.05, -0.05), (0.05, 0.05, 0.05)),
    "c2_U_peg.obj": Reads(["U", "peg"], 14 + 16 + 0.96, 7.064, (0, 0, 0), (3, 3, 1)),
    "d02_light_incomplete.dae": Reads(["part"], 6, 1, *HALF),
    "d03_color_comma.dae": Reads(["part"], 6, 1, *HALF),
    "d07_polygon_hole.dae": Reads(["part"], 12, 0, (-2, -2, 0), (2, 2, 0)),
    "g01_gpu_instancing.glb": Reads(["plate", "bolts", "bolts #2", "bolts #3"], 34.32, 1.624,
        (-2, -0.55, -2), (2, 0.1, 2)),
    "g02_morph_weight.glb": Reads(["lid"], 0.24, 0.008, (-0.1, 0.9, -0.1), (0.1, 1.1, 0.1)),
    # A corner of the box is drawn out to (0.5, 0.5, 0.5).
    "g04_sparse.glb": Reads(["box"], 0.524674, 0.016, (-0.1, -0.1, -0.1), (0.5, 0.5, 0.5)),
    "g05_quantized_normalized.glb": Reads(["box"], 0.24, 0.008, *TENTH),
    "g07_two_scenes.glb": Reads(["in_scene_0"], 0.24, 0.008, *TENTH,
        "2 nodes with a mesh are not"),
    "g11_fan.glb": Reads(["a"], 3.24, 0.008 + 3 * 0.4 / 3, (-1, -1, -0.1), (1, 1, 0.3)),
    "g16_mm.glb": Reads(["box"], 240000, 8000000.0, (-100, -100, -100), (100, 100, 100)),
    "g24_numbers_as_names.glb": Reads(["3", "1", "2"], 0.72, 0.024, TENTH[0], (1.1, 0.1, 0.1)),
    "g25_slash.glb": Reads(["A/pin", "A/pin #2", "1/2 bolt"], 0.72, 0.024, TENTH[0],
        (2.1, 0.1, 0.1), "2 names hold '/'"),
    "g26_hidden.glb": Reads(["shown", "hidden"], 0.48, 0.016, TENTH[0],
        (1.1, 0.1, 0.1), "1 node is hidden in it"),
    "l01_epsg2263_only.las": Reads(["l01_epsg2263_only"], 0, 0,
        (609601.2192, 304800.6096, 30.480061), (609631.69926, 304831.08966, 45.720091)),
    "l02_compound_m_ftUS.las": Reads(["l02_compound_m_ftUS"], 0, 0, (2e6, 1e6, 30.480061),
        (2000100, 1000100, 45.720091), "its heights are in units of 0.304801 m"),
    "l06_lonlat.las": "its coordinates are degrees (WGS 84), which are no lengths",
    "m01_item_path.3mf": Reads(["a", "b"], 0.0012, 2e-06, BOX_3MF[0], (0.035, 0.005, 0.005)),
    "m02_root_elsewhere.3mf": Reads(["a"], 0.0006, 1e-06, *BOX_3MF),
    "m04_mesh_plus_beams.3mf": Reads(["strut"], 0.0006, 1e-06, *BOX_3MF,
        "its extension beamlattice is not read"),
    "m05_slices_lowres.3mf": Reads(["ball"], 0.0006, 1e-06, *BOX_3MF,
        "its extension slice is not read"),
    "m07_support_other.3mf": Reads(["part", "tower"], 0.0012, 2e-06, BOX_3MF[0],
        (0.035, 0.005, 0.005), "1 object is of the type support"),
    "o01_concave_U.obj": Reads(["U"], 7, 0, (0, 0, 0), (3, 3, 0)),
    "o04_utf16.obj": Reads(["box"], 6, 1, *HALF),
    "o06_latin1.obj": Reads(["Träger"], 6, 1, *HALF),
    "o12_modelnet_header.off": Reads(["o12_modelnet_header"], 0.24, 0.008, *TENTH),
    "s04_latin1.step": Reads(["Träger"], 2 * np.pi * 0.005 * 0.045, np.pi * 0.005 ** 2 * 0.04,
        (-0.005, -0.005, 0), (0.005, 0.005, 0.04)),
    "s13_far_mm.step": Reads(["PIN"], 2 * np.pi * 0.15 * 0.45, np.pi * 0.15 ** 2 * 0.3,
        (500000.1, 4649776.35, 0), (500000.4, 4649776.65, 0.3)),
    "t01_bom.stl": Reads(["box"], 6, 1, *HALF),
    "t08_count0.stl": Reads(["t08_count0"], 6, 1, *HALF, "counts 0 triangles, and 12 follow"),
}  # fmt: skip


@pytest.mark.parametrize("name", EXPECTED)
def test_parse_reported_files(real_files: Path, name: str) -> None:
    path, expected = real_files / "reports" / name, EXPECTED[name]
    if isinstance(expected, str):
        assert expected in cause(path)
        return
    file = parse_in_process(path)
    assert names(file) == expected.names
    np.testing.assert_allclose(area_and_volume(file), expected[1:3], rtol=3e-3, atol=1e-12)
    np.testing.assert_allclose(file.bounds, np.array(expected[3:5]), rtol=1e-10, atol=1e-4)
    assert bool(file.notes) == bool(expected.note)
    assert expected.note in "; ".join(file.notes)


# --- the same kinds in the other formats ------------------------------------------------------

FACET = (
    "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\nendloop\nendfacet\n"
)
FLAT_U = "0 0 0\n3 0 0\n3 3 0\n2 3 0\n2 1 0\n1 1 0\n1 3 0\n0 3 0\n"
ITEM = '<item objectid="1"/>'
PLY_U = (
    "element vertex 8\nproperty float x\nproperty float y\nproperty float z\nelement face 2\n"
    "property list uchar int vertex_indices\nend_header\n"
)


@pytest.mark.parametrize("first", range(8))
@pytest.mark.parametrize("step", [1, -1])
def test_obj_concave_polygon_any_first_corner(tmp_path: Path, first: int, step: int) -> None:
    ring = [(first + step * n) % 8 for n in range(8)]
    lines = "".join(f"v {line}\n" for line in FLAT_U.splitlines())
    path = text(tmp_path / "u.obj", lines + "f " + " ".join(str(n + 1) for n in ring) + "\n")
    corners = parse_in_process(path).parts[0].triangles()
    up = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[:, 2]
    assert up.sum() == pytest.approx(14 * step)
    assert np.abs(up).sum() == pytest.approx(14)


def test_off_ply_concave_polygons(tmp_path: Path) -> None:
    faces = "8 0 1 2 3 4 5 6 7\n3 0 1 2\n"
    corners = np.array([line.split() for line in FLAT_U.splitlines()], dtype=np.float32)
    rows = np.array([8, *range(8)], "<i4"), np.array([3, 0, 1, 2], "<i4")
    binary = b"".join(bytes([int(row[0])]) + row[1:].tobytes() for row in rows)
    head = f"ply\nformat binary_little_endian 1.0\n{PLY_U}".encode()
    (tmp_path / "binary.ply").write_bytes(head + corners.tobytes() + binary)
    text(tmp_path / "text.ply", f"ply\nformat ascii 1.0\n{PLY_U}{FLAT_U}{faces}")
    text(tmp_path / "u.off", f"OFF 8 2 0\n{FLAT_U}{faces}")
    for name in ("binary.ply", "text.ply", "u.off"):
        assert area_and_volume(parse_in_process(tmp_path / name))[0] == pytest.approx(7 + 4.5)


def test_ply_triangle_strips_and_other_elements(tmp_path: Path) -> None:
    head = PLY_U.replace(
        "element face 2", "element edge 1\nproperty int vertex1\nelement tristrips 1"
    )
    content = f"ply\nformat ascii 1.0\n{head}{FLAT_U}7\n8 0 1 7 2 -1 4 5 6\n"
    file = parse_in_process(text(tmp_path / "strip.ply", content))
    assert len(file.parts[0].triangles()) == 3
    assert "1 element of the kind 'edge'" in file.notes[0]


@pytest.mark.parametrize("encoding", ["utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "utf-32"])
def test_parse_unicode_encodings(tmp_path: Path, encoding: str) -> None:
    contents = {
        "a.obj": "o Öse\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        "a.off": "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n",
        "a.ply": f"ply\nformat ascii 1.0\n{PLY_U}{FLAT_U}3 0 1 5\n0\n",
        "a.stl": f"solid Öse\n{FACET}endsolid Öse\n",
    }
    for name, content in contents.items():
        (tmp_path / name).write_bytes(content.encode(encoding))
        file = parse_in_process(tmp_path / name)
        assert area_and_volume(file)[0] == pytest.approx(1.5 if name == "a.ply" else 0.5)
        assert names(file)[0] in {"a", "Öse"}


def test_obj_off_skipped_lines_counted(tmp_path: Path) -> None:
    path = text(tmp_path / "a.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nfo 1 2 3\ncall b.obj\ncall c.obj\n")
    assert (
        "2 lines begin with unknown words and are passed over: 'call' 2"
        in parse_in_process(path).notes
    )
    path = text(tmp_path / "a.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n3 0 2 1\n")
    assert "1 line behind the last face is passed over" in parse_in_process(path).notes


def test_stl_concatenated_files(tmp_path: Path) -> None:
    for name, joined in {
        "unnamed": f"solid\n{FACET}endsolidsolid two\n{FACET}endsolid two\n",
        "same words": f"solid a solid\n{FACET}endsolid a solidsolid two\n{FACET}endsolid two\n",
        "no second head": f"solid a\n{FACET}endsolid a\n{FACET}endsolid b\n",
    }.items():
        assert len(parse_in_process(text(tmp_path / f"{name}.stl", joined)).parts) == 2
    one = b"\0" * 80 + (1).to_bytes(4, "little") + np.arange(12, dtype="<f4").tobytes() + b"\0\0"
    (tmp_path / "binary.stl").write_bytes(one + one + b"tail")
    file = parse_in_process(tmp_path / "binary.stl")
    assert names(file) == ["binary", "binary #2"]
    assert "4 bytes behind the last triangle" in file.notes[0]
    named = b"solid " + one[6:]  # a binary header may say so
    (tmp_path / "named.stl").write_bytes(named + named)
    assert names(parse_in_process(tmp_path / "named.stl")) == ["named", "named #2"]
    path = text(tmp_path / "more.stl", f"solid a\n{FACET}endsolid a\nand more\n")
    assert parse_in_process(path).notes == ("1 line begins with unknown words and is passed over",)
    line = "vertex 1 0 0\n"
    for facets in (FACET.replace(line, line * 2) * 3,
                   FACET.replace(line, "") + FACET.replace(line, line * 2)):  # fmt: skip
        path = text(tmp_path / "corners.stl", f"solid a\n{facets}endsolid a\n")
        assert "other than three corners" in cause(path)


def test_ply_float32_far_from_origin_note(tmp_path: Path) -> None:
    corners = np.array([line.split() for line in FLAT_U.splitlines()], dtype=np.float64) + 5e6
    face = b"\x08" + np.arange(8, dtype="<i4").tobytes()
    for kind, code, n_told in (("float", "<f4", 1), ("double", "<f8", 0)):
        head = PLY_U.replace("face 2", "face 1").replace("float", kind)
        content = f"ply\nformat binary_little_endian 1.0\n{head}".encode()
        (tmp_path / "far.ply").write_bytes(content + corners.astype(code).tobytes() + face)
        file = parse_in_process(tmp_path / "far.ply")
        assert len(file.notes) == n_told
        assert area_and_volume(file)[0] == pytest.approx(7)


@pytest.mark.parametrize("word", ["1,5", "-1.#IND", "1_0"])
def test_obj_word_instead_of_number(tmp_path: Path, word: str) -> None:
    """No comment begins in the second; the third is a number to Python."""
    path = text(tmp_path / "a.obj", f"v 0 0 0\nv 1 0 0\nv 0 {word} 0\nf 1 2 3\n")
    assert f"it holds '{word}' where a number should be" in cause(path)


def test_obj_comments_and_blanks(
    tmp_path: Path,
) -> None:
    corners = "v 0 0 0 # origin\nv 1 0 0.#c\nv 0 1 0 #INFO\n\xa0\no wheel #3\n"
    file = parse_in_process(text(tmp_path / "a.obj", f"{corners}f 1 2 3 #c\nf -3 -2 -1#c\n"))
    assert names(file) == ["wheel #3"]
    np.testing.assert_array_equal(file.parts[0].faces, [[0, 1, 2]] * 2)
    assert not file.notes


def test_stl_text_on_one_line(tmp_path: Path) -> None:
    two = f"solid a\n{FACET}endsolid a\nsolid b\n{FACET}{FACET}endsolid b"
    file = parse_in_process(text(tmp_path / "a.stl", " ".join(two.split())))
    assert names(file) == ["a", "b"]
    assert [len(part.triangles()) for part in file.parts] == [1, 2]
    assert not file.notes


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_obj_line_continuation_any_line_end(tmp_path: Path, end: str) -> None:
    lines = ["v 0 0 0", "v 1 0 0", "v 0 1 0", "f 1 \\", "2 \\ ", "3", "\0\0"]
    path = tmp_path / "a.obj"
    path.write_bytes(end.join(lines).encode())
    file = parse_in_process(path)
    assert len(file.parts[0].triangles()) == 1
    assert not file.notes


@pytest.mark.parametrize("end", ["\n", "\r\n", "\r"])
def test_ply_header_line_ends_and_space(tmp_path: Path, end: str) -> None:
    head = f"ply\nformat binary_little_endian 1.0\ncomment end_header soon\n{PLY_U}"
    head = head.replace("element face 2", "element face 1").replace("\n", end)
    corners = np.array([line.split() for line in FLAT_U.splitlines()], dtype="<f4")
    corners += np.frombuffer(b"\n\r\n\r", dtype="<f4")  # the first byte may be one, too
    content = head.encode() + corners.tobytes() + b"\x08" + np.arange(8, dtype="<i4").tobytes()
    (tmp_path / "a.ply").write_bytes(content + b"\r\n")
    assert area_and_volume(parse_in_process(tmp_path / "a.ply"))[0] == pytest.approx(7)
    twice = f"ply\nformat ascii 1.0\n{PLY_U}".replace("element face 2", "element vertex 1")
    assert "two elements of the kind 'vertex'" in cause(text(tmp_path / "b.ply", twice))


def test_off_binary_refused(tmp_path: Path) -> None:
    assert "it is a binary OFF file" in cause(text(tmp_path / "a.off", "OFF BINARY\n\0\0\0\3"))


def test_reported_files_all_expected(real_files: Path) -> None:
    there = {path.name for path in (real_files / "reports").iterdir()}
    assert there == {*EXPECTED, "README", "q01_semicolon_decimal_comma.csv"}


@pytest.mark.parametrize(
    ("name", "encoding"), [("左前轮 支架", "gb18030"), ("Öse", "utf-8"), ("Größe", "latin-1")]
)
def test_step_obj_name_encoding(real_files: Path, tmp_path: Path, name: str, encoding: str) -> None:
    step = (real_files / "reports" / "s04_latin1.step").read_bytes()
    step = step.replace("Träger".encode("latin-1"), name.encode(encoding))
    obj = f"o {name}\nv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n".encode(encoding)
    for path, content in ((tmp_path / "a.step", step), (tmp_path / "a.obj", obj)):
        path.write_bytes(content)
        assert names(parse_in_process(path)) == [name]
