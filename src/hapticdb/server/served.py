"""What the parts of one server share."""

from collections.abc import Mapping
from dataclasses import dataclass

from hapticdb.hosting.host import SessionHost
from hapticdb.hosting.preparing import Preparation
from hapticdb.server.access import Access, Role
from hapticdb.server.figures import Figures
from hapticdb.server.limits import Limits


@dataclass(frozen=True)
class Served:
    """An environment as one server offers it; `urls` and `tools` as of `Serving`."""

    urls: Mapping[Role, str]
    tools: tuple[str, ...]
    access: Access
    limits: Limits
    figures: Figures
    host: SessionHost
    preparation: Preparation
