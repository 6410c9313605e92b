"""COLLADA files as programs write them: read rightly, or told what is lost."""

from pathlib import Path

import numpy as np
import pytest

from hapticdb.mesh import parse_in_process
from mesh_files import COLLADA, area_and_volume, names, text


def dae(folder: Path, *changes: tuple[str, str]) -> Path:
    """The file `COLLADA` with texts replaced."""
    content = COLLADA
    for old, new in changes:
        assert old in content
        content = content.replace(old, new)
    return text(folder / "a.dae", content)


VERTEX = '<input semantic="VERTEX" source="#v" offset="0"/>'


def test_collada_far_positions_exact(tmp_path: Path) -> None:
    far = "5e8 0 0 500000001 0 0 500000001 1 0 5e8 1 0"
    moved = "<translate>100 0 0", "<translate>400000000.25 0 0"
    file = parse_in_process(dae(tmp_path, ("0 0 0 1 0 0 1 1 0\n0 1 0", far), moved))
    np.testing.assert_allclose(file.bounds[:, 0], [14000000.0025, 14000000.0225], rtol=1e-15)
    assert not file.notes


@pytest.mark.parametrize("declared", ["undefined", "punycode", "unicode_escape"])
def test_collada_unusable_encoding_ignored(tmp_path: Path, declared: str) -> None:
    head = '"1.0"?', f'"1.0" encoding="{declared}"?'
    assert len(parse_in_process(dae(tmp_path, head, ("branch", r"\ud800"))).parts) == 1


def test_collada_unit_not_a_number(tmp_path: Path) -> None:
    assert not parse_in_process(dae(tmp_path, ('meter="0.01"', 'meter="0,01"'))).names_unit
    assert parse_in_process(dae(tmp_path, ('<unit meter="0.01"/>', '<unit name="m"/>'))).names_unit


@pytest.mark.parametrize(
    ("unit", "metres"),
    [
        ('name="millimeter" meter="1.0"', 1.0),
        ('name="inch" meter="0.01"', 0.01),
        ('name="Inch"', 1.0),
        ('name="inch" meter="0.0254"', None),
        ('name="foot" meter="0.3048006"', None),
        ('name="x" meter="0.01"', None),
    ],
)
def test_collada_contradictory_unit(tmp_path: Path, unit: str, metres: float | None) -> None:
    """A rounded one, or one of a name of its own, is believed."""
    path = text(tmp_path / "a.dae", COLLADA.replace('meter="0.01"', unit))
    file = parse_in_process(path)
    assert bool(file.notes) == (metres is not None)
    if metres is not None:
        assert f"given as {metres:g} m, which is taken; another --unit" in file.notes[0]
        assert file.names_unit
        np.testing.assert_allclose(np.ptp(file.bounds, axis=0).max(), 2.0 * metres)
        given = parse_in_process(path, unit="mm")
        np.testing.assert_allclose(np.ptp(given.bounds, axis=0).max(), 0.002)


def test_collada_unsupported_elements_counted(tmp_path: Path) -> None:
    gone = "<instance_geometry url='#gone'/><instance_light url='#sun'/></node></node>"
    path = dae(
        tmp_path,
        ("</mesh>", "<linestrips count='1'><p>0 1</p></linestrips></mesh>"),
        ("</library_geometries>", "<geometry id='s'><spline/></geometry></library_geometries>"),
        ("</node></node>", gone),
    )
    file = parse_in_process(path)
    assert len(file.parts[0].triangles()) == 4
    assert file.notes == (
        "1 piece of the kind 'linestrips' is not read",
        "1 geometry is not in its scene and is left out",
        "1 of its 2 placements refers to what is not there",
    )


def test_collada_strips_and_fans(tmp_path: Path) -> None:
    for kind in ("tristrips", "trifans"):
        corners = "0 1 3 2" if kind == "tristrips" else "0 1 2 3"
        content = COLLADA.replace("<triangles", f"<{kind}").replace("</triangles", f"</{kind}")
        content = content.replace("<p>0 1 2</p></tri", f"<p>{corners}</p></tri")
        file = parse_in_process(text(tmp_path / f"{kind}.dae", content))
        assert area_and_volume(file)[0] == pytest.approx(4 * 2.5e-4)


def collada_source(name: str, floats: str, stride: int = 3, start: int = 0) -> str:
    params = "<param name='A'/>" * 3 + "<param/>" * (stride - 3)
    return (
        f"<source id='{name}'><float_array>{floats}</float_array><technique_common><accessor "
        f"offset='{start}' stride='{stride}'>{params}</accessor></technique_common></source>"
    )


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ('stride="3"', ""),
        ('<param name="Z" type="float"/>', '<param name="Z"/><param name="W"/>'),
        ('<source id="p">', '<source id="p p">'),
        ('<source id="p">', '<source id="p%20p">'),
        ("</p></polylist>", "</p></polylist><polygons><ph><p>0 1 2</p><h/></ph></polygons>"),
    ],
)
def test_collada_equivalent_notations(tmp_path: Path, old: str, new: str) -> None:
    assert old in COLLADA
    content = COLLADA.replace(old, new).replace("<polygons>", f"<polygons>{VERTEX}")
    if "W" in new:
        content = content.replace('stride="3"', 'stride="4"')
        content = content.replace("0 0 0 1 0 0 1 1 0\n0 1 0", "0 0 0 9 1 0 0 9 1 1 0 9 0 1 0 9")
    if "p" in new.partition("source id=")[2]:
        content = content.replace('"#p"', '"#p%20p"')
    file = parse_in_process(text(tmp_path / "a.dae", content))
    n_halves = 5 if "polygons" in new else 4
    assert area_and_volume(file)[0] == pytest.approx(n_halves * 2e-4)
    assert not file.notes


@pytest.mark.parametrize(
    "step",
    [
        "<matrix>1 0 0 7 0 1 0 0 0 0 1 0 0 0 0</matrix>",
        "<translate>1,0 0 0</translate>",
        "<rotate>0 0 1</rotate>",
        "<lookat>0 0 0 0 0 0 0 0 1</lookat>",
        "",
    ],
)
def test_collada_damaged_transform(tmp_path: Path, step: str) -> None:
    """Without a step, the matrix with which a skin is bound is damaged."""
    skin = "<skin source='#g'><bind_shape_matrix>1 0</bind_shape_matrix></skin></controller>"
    library = f"<library_controllers><controller id='c'>{skin}</library_controllers><library_geom"
    placed = "geometry url='#g'" if step else "controller url='#c'"
    node = f"<node name='lost'>{step}<instance_{placed}/></node></visual_scene>"
    path = dae(tmp_path, ("</visual_scene>", node), ("<library_geom", library))
    file = parse_in_process(path)
    assert names(file) == ["tree/branch"]
    assert file.defects.non_finite == 4
    assert "1 transform is damaged: parts there are left out" in file.notes


@pytest.mark.parametrize("source", ["#gone", "#c"])
def test_collada_skin_of_missing_source(tmp_path: Path, source: str) -> None:
    skin = f"<controller id='c'><skin source='{source}'/></controller>"
    library = f"<library_controllers>{skin}</library_controllers><library_geom"
    node = "<instance_controller url='#c'/></node></node>"
    file = parse_in_process(dae(tmp_path, ("</node></node>", node), ("<library_geom", library)))
    assert file.notes[0] == "1 of its 2 placements refers to what is not there"


def test_collada_accessor_offset_and_stride(tmp_path: Path) -> None:
    head, _, tail = COLLADA.partition('<source id="p">')
    tail = tail.partition("</source>")[2]
    places = ("7 0 0 0 7 1 0 0 7 1 1 0 7 0 1 0 7", 4, 1), ("9 9 9 0 0 0 1 0 0 1 1 0 0 1 0", 3, 3)
    for place in places:
        path = text(tmp_path / "a.dae", head + collada_source("p", *place) + tail)
        assert area_and_volume(parse_in_process(path))[0] == pytest.approx(4 * 2e-4)


@pytest.mark.parametrize(
    ("steps", "low", "high"),
    [
        ("<rotate>0 0 2 90</rotate>", (5e6 - 2, 0, 0), (5e6, 2, 0)),
        # Along -z, which is the world's -y; x is then the world's -x.
        ("<lookat>0 0 0 0 -1 0 0 0 1</lookat>", (5e6 - 2, 0, 0), (5e6, 0, 2)),
        ("<rotate>0 0 0 90</rotate><skew>1</skew>", (5e6, 0, 0), (5e6 + 2, 2, 0)),
    ],
)
def test_collada_far_node_rotated_in_double_precision(
    tmp_path: Path, steps: str, low: tuple[float, ...], high: tuple[float, ...]
) -> None:
    content = COLLADA.replace("0.01", "1").replace("100 0 0", "5e6 0 0")
    file = parse_in_process(text(tmp_path / "a.dae", content.replace("<scale>", f"{steps}<scale>")))
    np.testing.assert_allclose(file.bounds, [low, high], rtol=0, atol=2e-9)
    assert bool(file.notes) == ("skew" in steps)


@pytest.mark.parametrize(
    ("controllers", "low"),
    [
        (["<skin source='#g'>{}</skin>"], 0.07),
        (["<morph source='#g' method='NORMALIZED'/>"], 1.0),
        (["<skin source='#c1'>{}</skin>", "<morph source='#g' method='NORMALIZED'/>"], 0.07),
    ],
)
def test_collada_skin_and_morph_position(
    tmp_path: Path, controllers: list[str], low: float
) -> None:
    bound = "<bind_shape_matrix>1 0 0 7 0 1 0 0 0 0 1 0 0 0 0 1</bind_shape_matrix>"
    made = "".join(
        f"<controller id='c{n}'>{one.format(bound)}</controller>"
        for n, one in enumerate(controllers)
    )
    file = parse_in_process(
        dae(
            tmp_path,
            ('instance_geometry url="#g"', 'instance_controller url="#c0"'),
            ("<library_geom", f"<library_controllers>{made}</library_controllers><library_geom"),
        )
    )
    assert file.bounds[0, 0] == pytest.approx(low)
    assert "1 geometry with a" in file.notes[0]


def test_collada_damage_limited_to_geometry(tmp_path: Path) -> None:
    beside = {
        "an index out of range": ("<p>0 1 2</p>", "<p>0 1 9 0 1 2</p>"),
        "an empty piece": ("<triangles ", "<triangles count='0'/><triangles "),
        "a material that is not there": (
            '<instance_geometry url="#g"/>',
            '<instance_geometry url="#g"><instance_material target="#no"/></instance_geometry>',
        ),
        "an accessory of another shape": (
            "<vcount>",
            '<input semantic="TEXCOORD" source="#p" offset="0" set="0"/><vcount>',
        ),
    }
    for old, new in beside.values():
        content = COLLADA.replace(old, new).replace('id="g"', 'id="g g"').replace("#g", "#g%20g")
        file = parse_in_process(text(tmp_path / "a.dae", content))
        assert area_and_volume(file)[0] == pytest.approx(4 * 2e-4)
    broken = COLLADA[COLLADA.index("<geometry") : COLLADA.index("</library_geometries")]
    for old, new, why in (
        ("<vcount>4 3", "<vcount>4 4", "are not as many as it says"),
        ("0 0 0 1 0 0", "0 0 0 1,0 0 0", "where a number should be"),
        ("<p>0 1 2</p>", "<p>0 1 x</p>", "where a number should be"),
        ("0 0 0 1 0 0", "0 0 0 1_0 0 0", "it holds '1_0' where a number should be"),
        ("0 0 0 1 0 0", "0 0 0 1\xa00 0", "where a number should be"),
        ('stride="3"', 'stride="x"', "it is damaged"),
        ('stride="3"', 'stride="0"', "it is damaged"),
    ):
        second = broken.replace('id="g"', 'id="b"').replace(old, new)
        content = COLLADA.replace("</library_geometries>", second + "</library_geometries>")
        content = content.replace("</node></node>", '<instance_geometry url="#b"/></node></node>')
        file = parse_in_process(text(tmp_path / "b.dae", content))
        assert len(file.parts) == 1
        assert "1 of its geometries cannot be read: " in file.notes[0]
        assert why in file.notes[0]


@pytest.mark.parametrize("encoding", ["utf-16", "utf-16-be", "utf-32", "latin-1", "gb18030"])
@pytest.mark.parametrize("declared", ["", "utf-8", "its own"])
def test_collada_name_encoding(tmp_path: Path, encoding: str, declared: str) -> None:
    """Whatever it declares, such as gb2312 for gb18030."""
    name = "左前轮" if encoding == "gb18030" else "Größe"
    content = COLLADA.replace("branch", name)
    if declared == "its own":
        declared = "gb2312" if encoding == "gb18030" else encoding.removesuffix("-be")
    if declared:
        content = content.replace('"1.0"?', f'"1.0" encoding="{declared}"?', 1)
    (tmp_path / "a.dae").write_bytes(content.encode(encoding))
    assert names(parse_in_process(tmp_path / "a.dae")) == [f"tree/{name}"]
