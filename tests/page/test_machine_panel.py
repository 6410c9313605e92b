"""Machine in the tab Sweep: base, joint path and sweep of a machine."""

from pathlib import Path

import numpy as np
import pytest

from children import until
from hapticdb.page.connection import MachineFiles
from page_scene import page_of, two_parts
from serving import sent

SLIDE = """
<robot name="slide"><link name="rail"/>
  <link name="hook"><collision><geometry><box size="0.02 0.02 0.02"/></geometry></collision></link>
  <joint name="x" type="prismatic"><parent link="rail"/><child link="hook"/><axis xyz="1 0 0"/>
    <limit lower="-0.4" upper="1"/></joint></robot>
"""


def test_machine_panel_sweep_at_base_pose(tmp_path: Path) -> None:
    (tmp_path / "slide.urdf").write_text(SLIDE)
    (tmp_path / "path.csv").write_text("x [mm]\n-500\n500\n")
    files = MachineFiles(str(tmp_path / "slide.urdf"), None, str(tmp_path / "path.csv"), np.eye(4))
    with page_of(two_parts(tmp_path), machine=files) as (_, person, browser):
        base, row = person.find("Base, mm"), person.find("Row of the path")
        assert person.widgets[base]["value"] == "0,0,0,1,0,0,0"

        def shows(widget: str, value: object) -> None:
            until(lambda: (person.look(0.05), person.widgets[widget]["value"] == value)[1])

        person.press("Sweep the machine")
        person.wait_for("hook hits box at 39 % of the path")
        person.wait_for("joint x is at -0.5 m in row 0, below -0.4")
        shows(row, pytest.approx(0.39, abs=1e-4))
        until(lambda: not any(getattr(work, "_is_running", False) for work in browser.works))
        person.put(base, "0, 0, 1000, 1, 0, 0, 0")
        person.press("Sweep the machine")
        person.wait_for("nearest hook and ball at")
        drag = {
            "type": "TransformControlsUpdateMessage", "name": "/machine",
            "owner": str(browser.client.client_id),
            "wxyz": [1.0, 0.0, 0.0, 0.0], "position": [0.0, 0.0, 0.25],
        }  # fmt: skip
        sent(person._connection, drag)
        shows(base, "0,0,250,1,0,0,0")
        person.put(person.find("Play the path"), value=True)
        until(lambda: (person.look(0.05), person.widgets[row]["value"] > 0.6)[1])
        person.put(base, "here")
        person.wait_for("a place: give 3 numbers")
