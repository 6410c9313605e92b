"""deploy/ agrees with the server's limits."""

import re

from hapticdb.server.limits import Limits
from sources import ROOT


def test_deploy_unit_stop_timeout_and_user() -> None:
    unit = (ROOT / "deploy" / "hapticdb.service").read_text()
    waits = re.search(r"^TimeoutStopSec=(\d+)", unit, re.MULTILINE)
    assert waits is not None
    assert float(waits[1]) > 3.0 * Limits().stop_seconds
    assert "KillMode=mixed" in unit  # else all processes end at once, and recordings with them
    assert "DynamicUser=yes" in unit
    container = (ROOT / "deploy" / "Containerfile").read_text()
    assert re.search(r"^USER (?!0\b|root\b)", container, re.MULTILINE)
