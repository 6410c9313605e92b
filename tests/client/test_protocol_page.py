"""The worked example of docs/protocol.md, computed again."""

import json
import os
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from children import finished
from contact_hands import serving
from contact_server import TOKEN
from hapticdb.client.proxy_force import model_of
from hapticdb.kernels.proxy.evaluate import RESULTS, evaluate
from hapticdb.protocol.contacts import (
    HAND_BODY,
    PLANE,
    PROXY_BODY,
    ProxyState,
    ProxyTerms,
    pack_proxy,
    unpack_proxy,
)
from hapticdb.protocol.header import LAYOUT

PAGE = Path(__file__).parent.parent.parent / "docs" / "protocol.md"


def test_the_worked_example_of_contacts_is_right() -> None:
    section = PAGE.read_text().split("## Contacts")[1]
    found = re.search(r"```json\n(.*?)```", section, re.DOTALL)
    assert found is not None
    given = json.loads(found[1])
    terms = ProxyTerms(
        "", tuple(given["center"]), given["radius"], given["spring"], given["turn_spring"],
        given["cap"], given["turn_cap"], given["contact"], given["voxel_size"], given["onset"],
        0.01,
    )  # fmt: skip
    fields = ("lever", "normal", "depth", "weight", "bends", "along")
    planes = np.array([(*(plane[f] for f in fields), 0) for plane in given["planes"]], PLANE)
    proxy = ProxyState(
        1, 0, 1, 0.0, 0.0, 0.0, 0, 0.005, np.array(given["position"], float),
        np.array(given["quaternion"], float), np.array(given["tool_offset"]),
        np.array(given["tool_quaternion"], float), np.zeros(6), np.zeros((6, 6)), given["spring"],
        given["turn_spring"], planes,
    )  # fmt: skip
    model, result = model_of(unpack_proxy(pack_proxy(proxy)), terms), np.zeros(RESULTS)
    for hand, wrench in zip(given["hands"], given["wrenches"], strict=True):
        evaluate(model, np.array([*hand, 1.0, 0.0, 0.0, 0.0]), result)
        assert result[:6] == pytest.approx(wrench, abs=1e-4)


@pytest.mark.long
def test_the_client_of_the_page_feels_a_surface(tmp_path: Path) -> None:
    block = re.search(r"```python\n(.*?)```", PAGE.read_text().split("## Contacts")[1], re.DOTALL)
    assert block is not None
    with serving(tmp_path) as server:
        place = server.pose(-0.009)[:3, 3]  # 12 mm down the hand is 3 mm below the onset
        env = {
            "SERVER": f"ws://127.0.0.1:{server.port}",
            "PLACE": ",".join(map(str, place)),
            "HAPTICDB_TOKEN": TOKEN,
        }
        done = finished([sys.executable, "-c", block[1]], env=os.environ | env, check=True)
    n_planes, _, _, *force = done.stdout.split()
    assert int(n_planes) > 0
    assert [float(part) for part in force] == pytest.approx([0.0, 0.0, 3.0], abs=0.2)


@pytest.mark.parametrize(("name", "body"), [("HAND", HAND_BODY), ("PROXY", PROXY_BODY)])
def test_the_tables_have_every_field_at_its_offset(name: str, body: np.dtype[np.void]) -> None:
    section = PAGE.read_text().split(f"### {name}\n")[1].split("###")[0]
    offsets = [int(row) for row in re.findall(r"^\| (\d+) \|", section, re.MULTILINE)]
    assert body.fields is not None
    assert offsets == sorted(LAYOUT.size + at for _, at, *_ in body.fields.values())
