"""Small sound files of every format: `mutate_files` damages them."""

import json
import os
import struct
from pathlib import Path

import numpy as np

from mesh_files import COLLADA, MESH_3MF, TRIANGLE, glb_of, gltf, threemf

MOST_BYTES = 20_000
"""Size in bytes of the largest file of HAPTICDB_TEST_DATA that becomes a seed. Larger: slower."""
OTHERS = (".npz", ".csv", ".hdbrec")
"""Suffixes of saved shells, paths and recordings, which the caller's own process reads."""

STEP = """ISO-10303-21;
HEADER;
FILE_DESCRIPTION((''),'2;1');
FILE_NAME('','2020-01-01T00:00:00',(''),(''),'','','');
FILE_SCHEMA(('AUTOMOTIVE_DESIGN { 1 0 10303 214 1 1 1 1 }'));
ENDSEC;
DATA;
#1=APPLICATION_CONTEXT('automotive design');
#2=APPLICATION_PROTOCOL_DEFINITION('international standard','automotive_design',2000,#1);
#3=PRODUCT_CONTEXT('',#1,'mechanical');
#4=PRODUCT('sheet','sheet','',(#3));
#5=PRODUCT_DEFINITION_FORMATION('','',#4);
#6=PRODUCT_DEFINITION_CONTEXT('part definition',#1,'design');
#7=PRODUCT_DEFINITION('design','',#5,#6);
#8=PRODUCT_DEFINITION_SHAPE('','',#7);
#9=SHAPE_DEFINITION_REPRESENTATION(#8,#20);
#10=(LENGTH_UNIT()NAMED_UNIT(*)SI_UNIT(.MILLI.,.METRE.));
#11=(NAMED_UNIT(*)PLANE_ANGLE_UNIT()SI_UNIT($,.RADIAN.));
#12=(NAMED_UNIT(*)SI_UNIT($,.STERADIAN.)SOLID_ANGLE_UNIT());
#13=UNCERTAINTY_MEASURE_WITH_UNIT(LENGTH_MEASURE(1.E-07),#10,'distance_accuracy_value','');
#14=(GEOMETRIC_REPRESENTATION_CONTEXT(3)GLOBAL_UNCERTAINTY_ASSIGNED_CONTEXT((#13))
GLOBAL_UNIT_ASSIGNED_CONTEXT((#10,#11,#12))REPRESENTATION_CONTEXT('',''));
#20=MANIFOLD_SURFACE_SHAPE_REPRESENTATION('',(#21),#14);
#21=SHELL_BASED_SURFACE_MODEL('',(#22));
#22=OPEN_SHELL('',(#23));#23=ADVANCED_FACE('',(#24),#60,.T.);#24=FACE_BOUND('',#25,.T.);
#25=EDGE_LOOP('',(#26,#27,#28));#26=ORIENTED_EDGE('',*,*,#31,.T.);#27=ORIENTED_EDGE('',*,*,#32,.T.);
#28=ORIENTED_EDGE('',*,*,#33,.T.);#31=EDGE_CURVE('',#41,#42,#51,.T.);
#32=EDGE_CURVE('',#42,#43,#52,.T.);#33=EDGE_CURVE('',#43,#41,#53,.T.);#41=VERTEX_POINT('',#71);
#42=VERTEX_POINT('',#72);#43=VERTEX_POINT('',#73);#51=LINE('',#71,#81);#52=LINE('',#72,#82);
#53=LINE('',#73,#83);#60=PLANE('',#61);#61=AXIS2_PLACEMENT_3D('',#71,#91,#92);
#71=CARTESIAN_POINT('',(0.,0.,0.));#72=CARTESIAN_POINT('',(10.,0.,0.));
#73=CARTESIAN_POINT('',(0.,10.,0.));#81=VECTOR('',#92,1.);#82=VECTOR('',#93,1.);
#83=VECTOR('',#94,1.);#91=DIRECTION('',(0.,0.,1.));#92=DIRECTION('',(1.,0.,0.));
#93=DIRECTION('',(-0.70710678118655,0.70710678118655,0.));#94=DIRECTION('',(0.,-1.,0.));
ENDSEC;
END-ISO-10303-21;
"""


def seeds(suffix: str, folder: Path) -> list[bytes]:
    """Contents of sound files with one suffix. `folder` is for temporary files.

    Small files of the folder HAPTICDB_TEST_DATA are added, whether sound or not.
    """
    wanted = ".step" if suffix == ".stp" else suffix
    makers = {".las": _clouds, ".laz": _clouds} | dict.fromkeys(OTHERS, _ours)
    made = makers.get(wanted, _meshes)(folder)
    found = [content for kind, content in made if kind == wanted]
    if real := os.environ.get("HAPTICDB_TEST_DATA"):
        paths = [p for p in sorted(Path(real).rglob("*")) if p.suffix.lower() == suffix]
        found += [p.read_bytes() for p in paths if 0 < p.stat().st_size <= MOST_BYTES]
    return found


def _meshes(folder: Path) -> list[tuple[str, bytes]]:
    corners = [(0, 0, 0), (1, 0, 0), (1, 1, 0.5), (0, 1, 0.25), (0.5, 0.5, 2)]
    rows = "".join(f"{x} {y} {z}\n" for x, y, z in corners)
    faces = "f 1 2 3 4\nf 1/1/1 2//2 5\ng two\nf -1 -2 -3"
    facet = "facet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1e0 -0.5\n"
    solid = f"solid a\n{facet}endloop\nendfacet\n{facet}endloop\nendfacet\nendsolid a\n"
    head = "ply\nformat {} 1.0\ncomment of a test\nelement vertex 5\nproperty float x\n"
    head += "property float y\nproperty float z\nproperty uchar red\nelement face 1\n"
    head += "property list uchar int vertex_indices\nend_header\n"
    coloured = "".join(f"{x} {y} {z} 200\n" for x, y, z in corners)
    points = b"".join(struct.pack("<3fB", *corner, 200) for corner in corners)
    facets = np.zeros(3, dtype=[("f", "<f4", 12), ("a", "<u2")])
    facets["f"] = np.random.default_rng(1).random((3, 12))
    nodes = [
        {"name": "car", "children": [1, 2]},
        {"name": "wheel", "mesh": 0, "translation": [1, 0, 0], "rotation": [0, 0, 0.6, 0.8]},
        {"mesh": 0, "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 2, 0, 0, 1]},
    ]
    tree = gltf({"nodes": nodes}, folder / "seed.gltf")
    whole = json.loads(tree.read_text())
    beside = whole | {"buffers": [{"byteLength": 48, "uri": "beside.bin"}] * 2}
    chunked = json.dumps(whole | {"buffers": [{"byteLength": 48}]}).encode()
    chunked += b" " * (-len(chunked) % 4)
    triangle = TRIANGLE.tobytes() + np.arange(3, dtype="<u4").tobytes()
    size = 12 + 8 + len(chunked) + 8 + len(triangle)
    glb = struct.pack("<4s2I2I", b"glTF", 2, size, len(chunked), 0x4E4F534A) + chunked
    nested = (
        f'<object id="1" name="leaf">{MESH_3MF}</object><object id="2"><components>'
        '<component objectid="1" transform="1 0 0 0 1 0 0 0 1 5 0 0"/><component objectid="1"/>'
        "</components></object>"
    )
    packed = threemf(folder / "seed.3mf", nested, '<item objectid="2"/><item objectid="1"/>')
    return [
        (".obj", b"# test\no box\nv " + rows.replace("\n", "\nv ")[:-2].encode() + faces.encode()),
        (".off", f"OFF\n5 2 0\n{rows}4 0 1 2 3\n3 0 1 4 255 0 0\n".encode()),
        (".off", f"COFF 5 1 0\n{rows}3 0 1 4\n".encode()),
        (".stl", (solid + solid.replace(" a\n", " b\n")).encode()),
        (".stl", b"\0" * 80 + struct.pack("<I", 3) + facets.tobytes()),
        (".ply", f"{head.format('ascii')}{coloured}4 0 1 2 3\n".encode()),
        (
            ".ply",
            head.format("binary_little_endian").encode() + points + struct.pack("<B3i", 3, 0, 1, 2),
        ),
        (".dae", COLLADA.encode()),
        (".step", STEP.encode()),
        (".ifc", _building(folder / "seed.ifc")),
        (".gltf", tree.read_bytes()),
        (".gltf", json.dumps(beside).encode()),
        (".glb", glb_of(tree, folder / "seed.glb").read_bytes()),
        (".glb", glb + struct.pack("<I4s", len(triangle), b"BIN\0") + triangle),
        (".3mf", packed.read_bytes()),
    ]


def _building(path: Path) -> bytes:
    from ifc_files import Building  # noqa: PLC0415

    one = Building()
    wall = one.add("IfcWall", "wall", one.shape(one.box(4000, 200, 2500)), (0.0, 0.0, 3.0))
    one.opening(wall, one.shape(one.cylinder(500, 1000)))
    one.add("IfcSpace", "room", one.shape(one.box(3000, 3000, 2500)))
    return one.written(path).read_bytes()


def _clouds(folder: Path) -> list[tuple[str, bytes]]:
    import laspy  # noqa: PLC0415

    found = []
    for version, point_format in (("1.2", 1), ("1.4", 6)):
        cloud = laspy.LasData(laspy.LasHeader(version=version, point_format=point_format))
        cloud.x, cloud.y, cloud.z = np.random.default_rng(2).random((3, 40)) * 9
        for suffix in (".las", ".laz"):
            path = folder / f"seed{version}{suffix}"
            cloud.write(str(path))
            found.append((suffix, path.read_bytes()))
    return found


def _ours(folder: Path) -> list[tuple[str, bytes]]:
    from hapticdb import PointShell  # noqa: PLC0415
    from hapticdb.poses import write_poses  # noqa: PLC0415
    from recordings import motion, write  # noqa: PLC0415

    shell, poses, recording = (folder / f"seed{suffix}" for suffix in OTHERS)
    PointShell.sphere(0.1, 20).save(shell)
    np.savez_compressed(folder / "packed.npz", **np.load(shell))
    write_poses(poses, np.tile(np.eye(4), (5, 1, 1)))
    write(recording, motion(50))
    return [
        (".npz", shell.read_bytes()),
        (".npz", (folder / "packed.npz").read_bytes()),
        (".csv", poses.read_bytes()),
        (".csv", b"t,x,y,z,qw,qx,qy,qz\n0,0,0,0,1,0,0,0\n0.5,1,0,0,0.6,0.8,0,0\n"),
        (".hdbrec", recording.read_bytes()),
    ]
