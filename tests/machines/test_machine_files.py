"""Files of machines: URDF, SRDF, MJCF and joint paths, sound ones and bad ones."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from hapticdb import read_machine
from hapticdb.errors import FileError
from hapticdb.machines.joint_path import read_joints

LINKS = '<link name="a"/><link name="b"/><link name="c"/>'


def joint(name: str, parent: str, child: str, kind: str = "revolute", more: str = "") -> str:
    ends = f'<parent link="{parent}"/><child link="{child}"/>'
    return f'<joint name="{name}" type="{kind}">{ends}{more}</joint>'


def mesh(file: str, scale: str = "1 1 1") -> str:
    text = f'<geometry><mesh filename="{file}" scale="{scale}"/></geometry>'
    return f'<robot><link name="a"><visual>{text}</visual></link></robot>'


def test_read_machine_urdf_package_mesh_scaled(tmp_path: Path) -> None:
    (tmp_path / "pack/meshes").mkdir(parents=True)
    (tmp_path / "pack/urdf").mkdir()
    trimesh.creation.box((10.0, 20.0, 30.0)).export(tmp_path / "pack/meshes/a.stl")
    file = tmp_path / "pack/urdf/m.urdf"
    file.write_text(mesh("package://pack/meshes/a.stl", "0.001 0.001 -0.001"))
    machine = read_machine(file)
    assert np.ptp(machine.surfaces[0].box, axis=0).tolist() == pytest.approx([0.01, 0.02, 0.03])
    assert "visual" in machine.notes[0]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("<robot", "no XML"),
        ("<html/>", "root is <html>"),
        (f"<robot>{LINKS}</robot>", "one link must stand on no joint"),
        (f"<robot>{LINKS}{joint('j', 'a', 'x')}</robot>", "names the link 'x'"),
        (f"<robot>{LINKS}{joint('j', 'a', 'c')}{joint('k', 'b', 'c')}</robot>", "hangs on two"),
        (f"<robot>{LINKS}{joint('j', 'b', 'c')}{joint('k', 'c', 'b')}</robot>", "in a circle"),
        (f"<robot>{LINKS}{joint('j', 'a', 'b', 'floating')}{joint('k', 'b', 'c')}</robot>",
         "'j' is of the kind 'floating'"),
        (f"<robot>{LINKS}{joint('j', 'a', 'b')}{joint('j', 'b', 'c')}</robot>", "same name"),
        ('<robot><link name="a"/><link name="a"/></robot>', "same name"),
        ('<robot><link name="a"/></robot>', "none of its links has a surface"),
        (mesh("package://pack/none.stl"), "not beside the file"),
        (mesh("https://example.org/a.stl"), "absolute paths and other addresses are not read"),
        (mesh("/etc/a.stl"), "absolute paths and other addresses are not read"),
        (mesh("package://[x/a.stl"), "not beside the file"),
        (mesh("a" * 5000), "not beside the file"),
        (mesh("m.urdf"), "m.urdf"),
    ],
)  # fmt: skip
def test_read_machine_bad_urdf(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "m.urdf").write_text(text)
    with pytest.raises(FileError, match=told) as caught:
        read_machine(tmp_path / "m.urdf")
    assert "\n" not in str(caught.value)


ARM = """
<mujoco><compiler angle="radian"/><worldbody>
  <geom type="plane" size="1 1 1"/>
  <body name="mount" pos="0.1 0.2 0.3" euler="0.1 0.2 0.3">
    <geom type="box" size="0.1 0.1 0.1"/>
    <body name="arm" pos="0.5 0 0" quat="0.9 0.1 0.2 0.3">
      <joint name="swing" axis="0 1 1" pos="0.1 0 0" ref="0.4"/>
      <joint name="lift" type="slide" axis="1 0 1"/>
      <geom type="capsule" size="0.05 0.2"/>
      <body name="hand" pos="0 0 0.5">
        <joint name="grip" axis="1 0 0" range="-1 1" limited="true"/>
        <geom type="sphere" size="0.05"/>
        <geom type="ellipsoid" size="0.01 0.02 0.03" contype="0" conaffinity="0"/>
      </body>
    </body>
    <body name="other"><joint name="turn"/><geom type="cylinder" size="0.05 0.1"/></body>
  </body></worldbody>
  <equality><joint joint1="grip" joint2="swing" polycoef="0.1 0.5 0 0 0"/></equality>
  <contact><exclude body1="hand" body2="other"/></contact>
</mujoco>
"""


def test_read_machine_mjcf_equals_mujoco(tmp_path: Path) -> None:
    file = tmp_path / "m.xml"
    file.write_text(ARM)
    machine = read_machine(file)
    assert machine.driven == ("swing", "lift", "turn")
    values = machine.values(np.array([[0.7, 0.2, -2.0]]))
    grip = [one.name for one in machine.joints].index("grip")
    assert values[0, grip] == pytest.approx(0.1 + 0.5 * (0.7 - 0.4))
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    for one, value in zip(machine.joints, values[0], strict=True):
        data.joint(one.name).qpos[0] = value
    mujoco.mj_kinematics(model, data)
    for name in ("arm", "hand", "other"):
        pose = machine.placed(values, machine.names.index(name))[0]
        assert pose[:3, 3] == pytest.approx(data.body(name).xpos, abs=1e-12)
        assert pose[:3, :3].ravel() == pytest.approx(data.body(name).xmat, abs=1e-12)
    assert machine.excluded == frozenset(map(frozenset, [("arm", "hand"), ("hand", "other")]))
    assert "plane" in machine.notes[0]
    ball = machine.surfaces[machine.names.index("hand")]
    middles = ball.tree.corners.mean(axis=1)
    inner, outer = np.linalg.norm(middles, axis=1).min(), np.abs(ball.box).max()
    assert 0.05 - 1e-9 <= inner < outer < 0.05 + 5e-5


@pytest.mark.parametrize(
    ("was", "becomes", "told"),
    [
        ('type="slide"', 'type="ball"', "'lift' is free or a ball"),
        ("0.1 0.5 0 0 0", "0.1 0.5 1 0 0", "closed kinematics"),
        ("</equality>", '<joint joint1="grip" joint2="turn"/></equality>', "follows both"),
        ("<worldbody>", "<worldbody", "XML"),
        ("<worldbody>", '<worldbody><replicate count="100000"><geom size="1"/></replicate>',
         "<replicate> adds over 5,000"),
    ],
)  # fmt: skip
def test_read_machine_bad_mjcf(tmp_path: Path, was: str, becomes: str, told: str) -> None:
    text = ARM.replace(was, becomes, 1)
    (tmp_path / "m.xml").write_text(text)
    with pytest.raises(FileError, match=told) as caught:
        read_machine(tmp_path / "m.xml")
    assert "\n" not in str(caught.value)


def test_read_machine_mjcf_unnamed_bodies_and_joints(tmp_path: Path) -> None:
    arm = '<body pos="{} 0 0"><joint{}/><geom size="0.1"/></body>'
    arms = arm.format(1, "") + arm.format(2, ' name="joint 1"')
    text = f'<body><joint type="slide"/><geom size="0.1"/>{arms}</body>'
    (tmp_path / "m.xml").write_text(f"<mujoco><worldbody>{text}</worldbody></mujoco>")
    machine = read_machine(tmp_path / "m.xml")
    assert len(set(machine.driven)) == 3
    assert len(set(machine.names)) == 4
    assert machine.excluded is not None
    assert frozenset(machine.names[2:]) not in machine.excluded


def test_read_machine_mjcf_mocap_body(tmp_path: Path) -> None:
    text = '<body name="m" mocap="true" pos="0 0 9"><geom size="0.1"/></body>'
    (tmp_path / "m.xml").write_text(f"<mujoco><worldbody>{text}</worldbody></mujoco>")
    machine = read_machine(tmp_path / "m.xml")
    (link,) = machine.surfaces
    assert machine.placed(np.zeros((1, 1)), link)[0, :3, 3].tolist() == [0.0, 0.0, 9.0]


@pytest.mark.filterwarnings("ignore:.*NaN", "error::RuntimeWarning")
@pytest.mark.parametrize("number", ["inf", "nan"])
def test_read_machine_mjcf_non_finite_position(tmp_path: Path, number: str) -> None:
    text = f'<body name="m" pos="{number} 0 0"><joint/><geom size="0.1"/></body>'
    (tmp_path / "m.xml").write_text(f"<mujoco><worldbody>{text}</worldbody></mujoco>")
    with pytest.raises(FileError, match="finite"):
        read_machine(tmp_path / "m.xml")


def test_read_machine_srdf_excluded_pairs(tmp_path: Path) -> None:
    (tmp_path / "m.xml").write_text(ARM)
    (tmp_path / "m.srdf").write_text(
        '<robot><disable_collisions link1="arm" link2="other"/>'
        '<disable_collisions link1="arm" link2="unknown"/></robot>'
    )
    machine = read_machine(tmp_path / "m.xml", tmp_path / "m.srdf")
    assert machine.excluded == frozenset([frozenset(("arm", "other"))])
    (tmp_path / "m.srdf").write_text("<robot/>")
    with pytest.raises(FileError, match="no disable_collisions"):
        read_machine(tmp_path / "m.xml", tmp_path / "m.srdf")


def test_read_joints_units_of_header(tmp_path: Path) -> None:
    (tmp_path / "m.xml").write_text(ARM)
    machine = read_machine(tmp_path / "m.xml")
    (tmp_path / "q.csv").write_text("lift [mm],swing [deg]\n100,180\n0,90\n\n")
    q = read_joints(str(tmp_path / "q.csv"), machine)
    assert q.tolist() == [[np.pi, 0.1, 0.0], [np.pi / 2, 0.0, 0.0]]


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("swing\n", "row for each sample"),
        ("swig\n1\n", "joint 'swig' is none of its: swing, lift, turn"),
        ("grip\n1\n", "joint 'grip' follows 'swing'"),
        ("swing [mm]\n1\n", "rad, deg"),
        ("swing,swing [deg]\n1,1\n", "twice"),
        ("swing,lift\n1\n", "row 0: 1 values for 2 joints"),
        ("swing\n1\nx\n", "row 1: 'x' is no number"),
    ],
)
def test_read_joints_bad_file(tmp_path: Path, text: str, told: str) -> None:
    (tmp_path / "m.xml").write_text(ARM)
    (tmp_path / "q.csv").write_text(text)
    with pytest.raises(FileError, match=told):
        read_joints(str(tmp_path / "q.csv"), read_machine(tmp_path / "m.xml"))
