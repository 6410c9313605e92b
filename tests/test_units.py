"""Lengths are read in the given unit, and a user sees that unit and the scene's size."""

import inspect
import json
import math
from collections.abc import Callable
from pathlib import Path

import laspy
import numpy as np
import pytest
import trimesh
from laspy.vlrs.known import GeoKeyDirectoryVlr, GeoKeyEntryStruct, WktCoordinateSystemVlr

import hapticdb
from command_line import Run, boxes, refused
from command_line import tool as stl
from hapticdb.cli import VERBS
from hapticdb.cli.options import command
from hapticdb.cli.values import point_of
from hapticdb.errors import UsageError
from hapticdb.mesh import parse_in_process, read_file
from hapticdb.units import angle_of, length_of, place_text, volume_of, volume_text
from mesh_files import COLLADA

FEET = 1200.0 / 3937.0
DEGREES = (
    'GEOGCS["g",DATUM["d",SPHEROID["e",6378137,298.257]],PRIMEM["Greenwich",0],'
    'UNIT["degree",0.0174532925199433]]'
)
PROJECTED = f'PROJCS["p",{DEGREES},PROJECTION["Transverse_Mercator"],UNIT["{{}}",{{}}]]'
HEIGHTS = 'VERT_CS["v",VERT_DATUM["d",2005],UNIT["foot",0.3048],AXIS["Up",UP]]'


def cloud(path: Path, wkt: str = "") -> Path:
    """A LAS file of points that lie at most 100 units apart."""
    las = laspy.create(point_format=6, file_version="1.4")
    las.header.scales, las.header.offsets = np.full(3, 0.001), np.zeros(3)
    las.x, las.y, las.z = np.random.default_rng(1).uniform(0, 100, (3, 500))
    las.x[:2] = (0.0, 100.0)
    if wkt:
        las.header.vlrs.append(WktCoordinateSystemVlr(wkt))
    las.write(path)
    return path


def test_unit_feet_in_every_verb(run: Run, tmp_path: Path) -> None:
    trimesh.creation.box(extents=(2, 2, 2)).export(tmp_path / "tool.stl")
    (tmp_path / "path.csv").write_text("x,y,z,qw,qx,qy,qz\n0,0,0,1,0,0,0\n")
    assert run("import", "a.db", "tool.stl", "--unit", "ft", "--bits", 6)[0] == 0
    tool = ["a.db", "--tool", "tool.stl", "--tool-unit", "ft"]
    assert run("touch", *tool, "--poses", "path.csv")[0] == 0
    assert run("sweep", *tool, "--path", "path.csv")[0] in {0, 1, 3}
    assert run("feel", *tool, "--device", "path.csv", "--seconds", 0.1, "--rate", 200)[0] == 0


def test_info_scene_in_metres(run: Run, tmp_path: Path) -> None:
    box = trimesh.creation.box(bounds=[(10, 20, 30), (14, 22, 31)])
    box.export(tmp_path / "a.stl")
    hapticdb.create(tmp_path / "a.db", hapticdb.Grid(0.2, (0, 0, 0), 6)).close()
    assert json.loads(run("info", "a.db", "--json")[1])["scene"] is None
    assert "nothing in it" in run("info", "a.db")[1]
    code, out, _ = run("import", "a.db", "a.stl", "--unit", "ft")
    assert code == 0
    words = "1.219 x 0.6096 x 0.3048 m, from (3.048, 6.096, 9.144) to (4.2672, 6.7056, 9.4488) m"
    assert words in out
    assert words in run("info", "a.db")[1]
    found = json.loads(run("info", "a.db", "--json")[1])["scene"]
    np.testing.assert_allclose(found["low"], [3.048, 6.096, 9.144], rtol=1e-6)
    np.testing.assert_allclose(found["extent"], [1.2192, 0.6096, 0.3048], rtol=1e-6)
    again = json.loads(run("import", "a.db", "a.stl", "--unit", "ft", "--json")[1])
    assert again["scene"] == found


@pytest.mark.parametrize("name", ["a.las", "a.stl", "a.glb"])
def test_import_assumed_metres_note(run: Run, tmp_path: Path, name: str) -> None:
    made: dict[str, Callable[[Path], Path]] = {"a.las": cloud, "a.stl": stl, "a.glb": boxes}
    file = made[name](tmp_path / name)
    told = "its unit is not known: its numbers are taken as metres; --unit gives another"
    is_told = name != "a.glb"
    assert (told in run("import", "a.db", file, "--bits", 6)[1]) == is_told
    assert told not in run("import", "b.db", file, "--bits", 6, "--unit", "m")[1]
    found = json.loads(run("import", "c.db", file, "--bits", 6, "--json")[1])
    assert found["is_unit_assumed"] == is_told


@pytest.mark.parametrize(
    ("wkt", "unit", "metres", "names_unit", "note"),
    [
        ("", None, 1.0, False, ""),
        ("", "ft", 0.3048, False, ""),
        (PROJECTED.format("US survey foot", 0.304800609601219), None, FEET, True, ""),
        (PROJECTED.format("US survey foot", 0.304800609601219), "m", 1.0, True, ""),
        (f'COMPD_CS["c",{PROJECTED.format("metre", 1)},{HEIGHTS}]', None, 1.0, True,
         "its heights are in units of 0.3048 m, its positions of 1 m"),
        (DEGREES, "m", 1.0, False, ""),
        (PROJECTED.format("broken", "1e999"), None, 1.0, False, "cannot be read"),
        ('PROJCS["cut",', None, 1.0, False, "the unit of its reference system cannot be read"),
    ],
)  # fmt: skip
def test_las_unit_of_reference_system(
    tmp_path: Path, wkt: str, unit: str | None, metres: float, names_unit: bool, note: str
) -> None:
    file = parse_in_process(cloud(tmp_path / "a.las", wkt), unit=unit)
    assert note in "; ".join(file.notes)
    assert bool(note) == bool(file.notes)
    assert file.bounds[:, 2].max() <= 100 * (0.3048 if "heights" in note else metres)
    assert file.bounds[1, 0] - file.bounds[0, 0] == pytest.approx(100 * metres)
    assert file.names_unit == names_unit


def test_las_geocentric_no_up_axis(tmp_path: Path) -> None:
    datum = DEGREES.partition(",UNIT")[0].partition(",")[2]
    file = parse_in_process(cloud(tmp_path / "a.las", f'GEOCCS["c",{datum},UNIT["metre",1]]'))
    assert file.names_unit
    assert file.up is None
    assert parse_in_process(cloud(tmp_path / "b.las")).up == "z"


def test_las_degrees_refused_without_unit(tmp_path: Path) -> None:
    with pytest.raises(hapticdb.errors.FileError, match=r"degrees \(g\), which are no lengths"):
        parse_in_process(cloud(tmp_path / "a.las", DEGREES))
    las = laspy.read(tmp_path / "a.las")
    las.x = las.x + 5e5  # some files name such a system and have metres
    las.write(tmp_path / "b.las")
    assert "which its numbers are not" in parse_in_process(tmp_path / "b.las").notes[0]


def test_las_withheld_points_and_truncated_file(tmp_path: Path) -> None:
    las = laspy.read(cloud(tmp_path / "a.las"))
    las.withheld[:7] = 1
    las.write(tmp_path / "b.las")
    assert "7 points are withheld (deleted)" in parse_in_process(tmp_path / "b.las").notes[0]
    content = (tmp_path / "b.las").read_bytes()
    (tmp_path / "c.las").write_bytes(content[:-10])
    with pytest.raises(hapticdb.errors.FileError, match="promises 500 points, 499 are there"):
        parse_in_process(tmp_path / "c.las")


@pytest.mark.parametrize(
    ("keys", "rise"),
    [
        ({1024: 1, 3072: 2263}, 1.0),
        ({1024: 1, 3072: 32618, 3076: 9003}, 1.0),
        ({1024: 1, 3072: 2263, 4099: 9001}, 1 / FEET),
        ({1024: 1, 3072: 2263, 4096: 5703}, 1 / FEET),
    ],
)
def test_las_geotiff_unit_keys(tmp_path: Path, keys: dict[int, int], rise: float) -> None:
    las = laspy.read(cloud(tmp_path / "a.las"))
    record = GeoKeyDirectoryVlr()
    record.geo_keys_header.number_of_keys = len(keys)
    record.geo_keys = [GeoKeyEntryStruct(key, 0, 1, value) for key, value in keys.items()]
    las.header.vlrs.append(record)
    las.write(tmp_path / "b.las")
    plain, read = (parse_in_process(tmp_path / name).bounds[1] for name in ("a.las", "b.las"))
    np.testing.assert_allclose(read, plain * FEET * np.array([1, 1, rise]), rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "said", "up"),
    [
        ("a.glb", None, "y"),
        ("b.glb", "z", "z"),
        ("a.stl", None, None),
        ("a.dae", "X_UP", "x"),
        ("b.dae", None, "y"),
    ],
)
def test_up_axis_of_file(tmp_path: Path, name: str, said: str | None, up: str | None) -> None:
    file = tmp_path / name
    mesh = trimesh.creation.box()
    if name.endswith(".dae"):
        file.write_text(COLLADA.replace("Z_UP", said or ""))
    elif said is None:
        mesh.export(file)
    else:
        mesh.scene().export(
            file, tree_postprocessor=lambda tree: tree["asset"].update(extras={"up_axis": said})
        )
    assert parse_in_process(file).up == up
    with hapticdb.create(tmp_path / "a.db", hapticdb.Grid(0.1, (-2, -2, -2), 6)) as env:
        env.add(file)
        assert env.object(1).attributes.get("up") == up


def test_unit_unknown(run: Run, tmp_path: Path) -> None:
    with pytest.raises(hapticdb.errors.UsageError, match=r"furlong.*ft"):
        read_file(stl(tmp_path / "a.stl"), unit="furlong")
    refused(run("import", "a.db", "a.stl", "--unit", "furlong"), "--unit")


def test_place_text_precision_of_scene() -> None:
    assert place_text((5e5, 4649776.123456, 1.7e-17), 3e-6) == "(500000, 4649776.123456, 0)"
    assert place_text((-0.25, 1000.0, 0.0), 10.0) == "(0, 1000, 0)"
    assert place_text((-0.25, 1.0, 0.0), 0.0) == "(-0.25, 1, 0)"


@pytest.mark.parametrize(
    ("text", "unit", "metres"),
    [
        *((text, "mm", 1e-4) for text in ("0.1", ".1mm", "100 um", "100µm", "1e-4m", " +0.1 mm ")),
        *(("0.2in", unit, 0.00508) for unit in ("mm", "m")),
        *(("-3", unit, -3 * size) for unit, size in (("mm", 1e-3), ("m", 1.0))),
        ("0.07", "mm", 7e-5),
        ("4649776.123456", "m", 4649776.123456),
        ("1us-ft", "mm", FEET),
        ("2 ft", "mm", 0.6096),
        ("0", "mm", 0.0),
    ],
)  # fmt: skip
def test_length_of_units(text: str, unit: str, metres: float) -> None:
    assert length_of(text, unit) == metres


@pytest.mark.parametrize(
    "text", ["", "mm", "1 furlong", "1,5", "nan", "inf", "1e999", "9" * 400, "1mm2", "5MM"]
)
def test_length_of_bad_text(text: str) -> None:
    with pytest.raises(hapticdb.errors.UsageError, match=r"give millimetres, or such as 0\.2in \("):
        length_of(text, "mm")


def test_angle_of_units() -> None:
    for text in ("60", "60deg", "60 deg", "6e1"):
        assert angle_of(text) == 60.0
    assert angle_of("-1rad") == -math.degrees(1.0)
    for text in ("", "60mm", "deg", "nan", "1,5", "60degrees"):
        with pytest.raises(hapticdb.errors.UsageError, match=r"give degrees, or such as 1\.05rad"):
            angle_of(text)


def test_point_of_units() -> None:
    inch = 0.0254
    assert point_of("1,-2 0.5", "m") == (1, -2, 0.5)
    assert point_of("1e-3,2e1,3", "m") == (1e-3, 20, 3)
    assert point_of("0, 5 in, 1 ft", "mm") == (0, 0.127, 0.3048)
    assert point_of("1 2 3 µm", "m") == pytest.approx((1e-6, 2e-6, 3e-6), rel=1e-15)
    assert point_of("1in,2,3", "mm") == (inch, 2e-3, 3e-3)
    for text in ("", "1,2", "1,2,3,4", "1,2,nan", "1,2,3 furlongs", "a,b,c", "1 mm"):
        with pytest.raises(hapticdb.errors.UsageError, match=r"give X,Y,Z in metres, or such as"):
            point_of(text, "m")


NO_LENGTHS = {"VOLUME", "SIZE", "ANGLE"}


def test_length_options_defaults_and_units() -> None:
    """Defaults of verbs are metres, those in the help are in the option's unit."""
    found = set()
    for verb in VERBS:
        for name, one in inspect.signature(command(verb)).parameters.items():
            option = getattr(one.annotation, "__metadata__", [None])[0]
            if not getattr(option, "parser", None) or option.metavar in NO_LENGTHS:
                continue
            found.add(name)
            text = "1,2,25.4" if option.metavar == "X,Y,Z" else "25.4"
            assert option.parser(f"{text}mm") == option.parser(f"{text} mm")
            assert one.default is None or option.parser(option.show_default) == one.default
    assert found >= {
        *("within", "contact", "overlap", "out", "screw", "chord", "voxel_size"),
        *("about", "origin", "translate", "at"),
    }


def test_length_options_bad_text(run: Run) -> None:
    for given in (
        ("clashes", "a.db", "--within", "wide"),
        ("sweep", "a.db", "--overlap", "1 parsec"),
        ("import", "a.db", "a.stl", "--voxel-size", "1e"),
        ("move", "a.db", "1", "--translate", "1,2"),
        ("extract", "a.db", "1", "--to", "1 2 wide 1 0 0 0"),
    ):
        refused(run(*given), given[-2], repr(given[-1]), ": give ")


@pytest.mark.parametrize(
    ("text", "volume"), [("1", 1e-6), ("5mm3", 5e-9), (".2 m³", 0.2), ("2in^3", 2 * 0.0254**3)]
)
def test_volume_of_units(text: str, volume: float) -> None:
    assert volume_of(text) == pytest.approx(volume, rel=1e-15)


@pytest.mark.parametrize("text", ["1mm", "mm3", "1 l", "", "3 3"])
def test_volume_of_bad_text(text: str) -> None:
    with pytest.raises(UsageError, match="is no volume"):
        volume_of(text)


def test_volume_text_units() -> None:
    told = {7.2e-2: "0.072 m³", 7.2e-4: "720 cm³", 1.2e-9: "1.2 mm³", 0.0: "0 mm³"}
    assert {volume: volume_text(volume) for volume in told} == told
