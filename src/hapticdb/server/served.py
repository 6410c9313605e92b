"""Settings of a server, and the objects shared by its parts; a light import."""

import ipaddress
import re
import ssl
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from hapticdb.errors import UsageError
from hapticdb.server.access import Access, Role
from hapticdb.server.limits import Limits

if TYPE_CHECKING:
    from hapticdb.page.connection import MachineFiles
    from hapticdb.server.metrics import Metrics
    from hapticdb.session.coupling import Rendering
    from hapticdb.session.host import SessionHost

PAGE = "hapticdb.page.page_process:work"
"""Function of the page's process."""
PREFIX = re.compile(r"(/[A-Za-z0-9_-]+)*")
"""Form of a prefix."""


@dataclass(frozen=True)
class Serving:
    """Settings of a server.

    urls : the environment's URL for each role; tools : files; tool_unit : as of `read_file`; tokens
    : with their roles; open_role : of clients without a token; port : 0 for a free one; prefix :
    path of the server behind a proxy, such as ``/hapticdb``; certificate, key : files of TLS;
    recordings : folder of recorded sessions, None without recording; rendering : as of
    `SessionHost`; page : function of the page's process.
    """

    urls: Mapping[Role, str]
    tools: tuple[str, ...] = ()
    tool_unit: str | None = None
    tokens: Mapping[str, Role] = field(default_factory=dict)
    open_role: Role | None = None
    host: str = "127.0.0.1"
    port: int = 0
    prefix: str = ""
    host_names: tuple[str, ...] = ()
    certificate: str | None = None
    key: str | None = None
    title: str = "hapticdb"
    recordings: str | None = None
    rendering: "Rendering | None" = None
    machine: "MachineFiles | None" = None
    limits: Limits = field(default_factory=Limits)
    page: str = PAGE

    def address(self, port: int, token: str = "") -> str:
        """URL for a browser on this machine."""
        scheme = "http" if self.certificate is None else "https"
        host = {"0.0.0.0": "127.0.0.1", "::": "[::1]"}.get(self.host, self.host)  # noqa: S104 - compared
        if ":" in host and not host.startswith("["):
            host = f"[{host}]"
        query = f"?token={token}" if token else ""
        return f"{scheme}://{host}:{port}{self.prefix}/{query}"


def check(serving: Serving) -> None:
    """Refuse, by UsageError, a reachable server without a token; a wrong prefix or TLS file."""
    if not is_near(serving.host) and serving.open_role is not None:
        raise UsageError(
            f"--host {serving.host}: other machines can reach that address, so clients need a "
            "token; add --token"
        )
    if not PREFIX.fullmatch(serving.prefix):
        raise UsageError(f"--prefix {serving.prefix}: write it as /name")
    if (serving.certificate is None) != (serving.key is None):
        raise UsageError("--tls-cert and --tls-key belong together: give both")
    if serving.certificate is not None:
        try:
            ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(
                serving.certificate, serving.key
            )
        except (OSError, ssl.SSLError) as error:
            raise UsageError(f"--tls-cert {serving.certificate}: cannot be used: {error}") from None


def is_near(host: str) -> bool:
    """Whether an address is a loopback address."""
    if is_address(host):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def is_address(name: str) -> bool:
    """Whether a host is a numeric address."""
    try:
        ipaddress.ip_address(name)
    except ValueError:
        return False
    return True


@dataclass(frozen=True)
class Served:
    """Objects shared by the parts of a server."""

    access: Access
    limits: Limits
    figures: "Metrics"
    host: "SessionHost"
