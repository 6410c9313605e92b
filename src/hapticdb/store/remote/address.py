"""URLs of environments behind a hapticdb server: ``wss://host:port/prefix?token=...&ca=FILE``."""

import os
import ssl
from typing import NamedTuple
from urllib.parse import unquote, urlsplit

from hapticdb.errors import FileError, UsageError
from hapticdb.store.urls import redact

ENDPOINT = "/device/cells"
"""Path of the endpoint below the server's prefix."""
TOKEN_VARIABLE = "HAPTICDB_TOKEN"  # noqa: S105 - the name of the variable, not its value
"""Environment variable that holds the token where the URL has none."""


class RemoteAddress(NamedTuple):
    """A URL taken apart.

    endpoint : URL of the WebSocket, without secrets; token : secret, or empty; ca : file of
    certificates that are trusted instead of the system's, or empty; name : host, port and prefix;
    shown : the whole URL as messages may show it.
    """

    endpoint: str
    token: str
    ca: str
    name: str
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


def parse_address(url: str) -> RemoteAddress:
    """Take a URL apart.

    Raises
    ------
    UsageError
        When it has no host, a user, an unknown parameter, or a token that no header can carry.
    """
    shown = redact(url)
    try:
        parts = urlsplit(url)
        port = parts.port
    except ValueError:
        raise UsageError(f"{shown}: no such address; write ws://host:port") from None
    if not parts.hostname or parts.username is not None or parts.fragment:
        raise UsageError(f"{shown}: write ws://host:port, and the token as ?token=TOKEN")
    given = {"token": "", "ca": ""}
    for pair in parts.query.split("&") if parts.query else []:
        key, equals, value = pair.partition("=")
        if key not in given or not equals:
            place = shown.partition("?")[0]  # a misspelt token is not shown either
            raise UsageError(f"{place}: a server's URL has the parameters token and ca, no others")
        given[key] = unquote(value)
    token = given["token"] or os.environ.get(TOKEN_VARIABLE, "")
    if not (token.isascii() and token.isprintable()) or " " in token:
        raise UsageError(f"{shown}: the token has characters that no header can carry")
    scheme = parts.scheme.lower()
    if given["ca"] and scheme == "ws":
        raise UsageError(f"{shown}: ca is for wss://, whose server shows a certificate")
    host = f"[{parts.hostname}]" if ":" in parts.hostname else parts.hostname
    place = (host if port is None else f"{host}:{port}") + parts.path.rstrip("/")
    return RemoteAddress(f"{scheme}://{place}{ENDPOINT}", token, given["ca"], place, shown)
