"""WebSockets to servers: their URLs, how they are opened, and what is said when they cannot be.

A server's URL is ``wss://host:port/prefix?token=...&ca=FILE``.
"""

import contextlib
import logging
import os
import ssl
from collections.abc import Iterator
from http import HTTPStatus
from typing import TYPE_CHECKING, NamedTuple
from urllib.parse import unquote, urlsplit

from hapticdb.errors import (
    AccessError,
    BusyError,
    ConnectionLostError,
    EnvironmentNotFoundError,
    FileError,
    HapticDBError,
    MissingExtraError,
    UsageError,
    pip_line,
)
from hapticdb.store.urls import redact

if TYPE_CHECKING:
    from websockets.sync.client import ClientConnection

ENDPOINT = "/device/contacts"
"""Path of the endpoint below the server's prefix."""
TOKEN_VARIABLE = "HAPTICDB_TOKEN"  # noqa: S105 - the name of the variable, not its value
"""Environment variable that holds the token where the URL has none."""
LARGEST = 4096
"""Bytes of the largest message that is accepted. Larger: a wrong server may cost more memory."""
PING_EVERY, PING_PATIENCE = 2.0, 10.0
"""Seconds between two pings, and until an answer must come; then the connection counts as lost.
Larger: a server that is frozen is noticed later, and a busy one is kept. The force waits for
neither."""
BUSY = {HTTPStatus.SERVICE_UNAVAILABLE, HTTPStatus.TOO_MANY_REQUESTS}
BEHIND_A_PROXY = {HTTPStatus.BAD_GATEWAY, HTTPStatus.GATEWAY_TIMEOUT}


class _ServerAddress(NamedTuple):
    """A URL taken apart.

    endpoint : URL of the WebSocket, without secrets; token : secret, or empty; ca : file of
    certificates that are trusted instead of the system's, or empty; shown : the whole URL as
    messages may show it.
    """

    endpoint: str
    token: str
    ca: str
    shown: str

    def trust(self) -> ssl.SSLContext | None:
        """Certificates to trust; None for a connection without TLS."""
        if self.endpoint.startswith("ws:"):
            return None
        try:
            return ssl.create_default_context(cafile=self.ca or None)
        except OSError as error:
            raise FileError(
                f"{self.ca}: no file of certificates ({error}); give one in the form PEM"
            ) from error


def parse_address(url: str) -> _ServerAddress:
    """Take a URL apart.

    UsageError if it is none of a server, has no host, a user, an unknown parameter, or a token that
    no header can carry.
    """
    shown = redact(url)
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        raise UsageError(f"{shown}: no such address; write ws://host:port") from None
    scheme = parts.scheme.lower()
    if scheme not in {"ws", "wss"} or not parts.hostname:
        raise UsageError(f"{shown}: no server; write ws://host:port or wss://host:port")
    if parts.username is not None or parts.fragment:
        raise UsageError(f"{shown}: write ws://host:port, and the token as ?token=TOKEN")
    given = {"token": "", "ca": ""}
    for pair in parts.query.split("&") if parts.query else []:
        key, equals, value = pair.partition("=")
        if key not in given or not equals:
            without_query = shown.partition("?")[0]  # a misspelt token is not shown either
            raise UsageError(
                f"{without_query}: a server's URL has the parameters token and ca, no others"
            )
        given[key] = unquote(value)
    token = given["token"] or os.environ.get(TOKEN_VARIABLE, "")
    if not (token.isascii() and token.isprintable()) or " " in token:
        raise UsageError(f"{shown}: the token has characters that no header can carry")
    if given["ca"] and scheme == "ws":
        raise UsageError(f"{shown}: ca is for wss://, whose server shows a certificate")
    host = f"[{parts.hostname}]" if ":" in parts.hostname else parts.hostname
    authority = (host if port is None else f"{host}:{port}") + parts.path.rstrip("/")
    return _ServerAddress(f"{scheme}://{authority}{ENDPOINT}", token, given["ca"], shown)


def open_websocket(address: _ServerAddress, patience: float) -> "ClientConnection":
    """Connect to a server straight, without a proxy and without compression.

    patience : seconds in which it must answer; `ContactProxy` names the errors.
    """
    try:
        from websockets.sync.client import connect  # noqa: PLC0415 - an extra
    except ImportError:
        raise MissingExtraError(
            f"the package websockets is missing: {pip_line('client')}"
        ) from None
    quiet = logging.getLogger("hapticdb.client.websockets")
    quiet.setLevel(logging.CRITICAL)  # every failure is raised, or is `ContactProxy.error`
    shown = {"Authorization": f"Bearer {address.token}"} if address.token else {}
    trust = address.trust()
    with _named_errors(address.shown):
        return connect(
            address.endpoint, ssl=trust, compression=None, additional_headers=shown,
            user_agent_header="hapticdb",
            proxy=None,  # a proxy between would add its delays: TLS passes, or nothing
            max_size=LARGEST, max_queue=None, open_timeout=patience, close_timeout=1.0,
            ping_interval=PING_EVERY, ping_timeout=PING_PATIENCE, logger=quiet,
        )  # fmt: skip


@contextlib.contextmanager
def _named_errors(shown: str) -> Iterator[None]:
    """Turn errors of a connection that cannot be made into those of hapticdb."""
    from websockets.exceptions import (  # noqa: PLC0415 - an extra
        InvalidStatus,
        WebSocketException,
    )

    try:
        yield
    except InvalidStatus as error:
        raise _denied(shown, error.response.status_code) from error
    except ssl.SSLCertVerificationError as error:
        raise AccessError(
            f"{shown}: the server's certificate is not trusted ({error.verify_message}); "
            "?ca=FILE names the file of a private authority"
        ) from error
    except (OSError, TimeoutError, WebSocketException) as error:
        cause = " ".join(str(error).split()) or type(error).__name__
        raise ConnectionLostError(f"{shown} cannot be reached: {cause}") from error


def _denied(shown: str, status: int) -> HapticDBError:
    if status in {HTTPStatus.UNAUTHORIZED, HTTPStatus.FORBIDDEN}:
        return AccessError(
            f"{shown}: the server does not let this client in; give a token of a toucher "
            "as ?token=TOKEN or in HAPTICDB_TOKEN"
        )
    if status in BUSY:
        return BusyError(f"{shown} has too many clients now: try again later")
    if status in BEHIND_A_PROXY:
        return ConnectionLostError(f"{shown}: only a proxy answers (status {status})")
    return EnvironmentNotFoundError(
        f"no hapticdb server at {shown} (status {status}): 'hapticdb serve' starts one"
    )
