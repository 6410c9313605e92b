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
    """An environment as one server offers it.

    Attributes
    ----------
    urls : mapping of Role to str
        The environment's address for each role.
    tools : tuple of str
        Files of the tools that the operator offers.
    access : Access
        What a client may do, by the headers of its request.
    limits : Limits
        What one client, and all together, may ask for.
    figures : Figures
        Counters for the operator.
    host : SessionHost
        Where sessions run.
    preparation : Preparation
        Compiles what hands call.
    """

    urls: Mapping[Role, str]
    tools: tuple[str, ...]
    access: Access
    limits: Limits
    figures: Figures
    host: SessionHost
    preparation: Preparation
