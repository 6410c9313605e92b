"""docs/serving.md gives the limits that the code has, and deploy/ what it promises."""

import re

from hapticdb.server.limits import Limits
from sources import ROOT

PAGE = (ROOT / "docs" / "serving.md").read_text()


def test_the_unit_waits_longer_than_the_server_needs_to_stop() -> None:
    unit = (ROOT / "deploy" / "hapticdb.service").read_text()
    waits = re.search(r"^TimeoutStopSec=(\d+)", unit, re.MULTILINE)
    assert waits is not None
    assert float(waits[1]) > 3.0 * Limits().stop_seconds
    # all processes of the group would end at once, and recordings with them
    for line in (
        "KillMode=mixed",
        "DynamicUser=yes",
        "ProtectSystem=strict",
        "NoNewPrivileges=yes",
    ):
        assert line in unit


def test_the_container_runs_without_root() -> None:
    words = (ROOT / "deploy" / "Containerfile").read_text()
    assert re.search(r"^USER (?!0\b|root\b)", words, re.MULTILINE)


def test_the_container_gets_what_the_package_is_made_of_and_no_more() -> None:
    words = (ROOT / "deploy" / "Containerfile").read_text()
    copied = re.findall(r"^COPY (?!--)(.+) \S+$", words, re.MULTILINE)
    assert sorted(" ".join(copied).split()) == ["LICENSE", "README.md", "pyproject.toml", "src"]
