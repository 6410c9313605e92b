"""URLs of environments: their scheme, secrets that are never shown, and addresses of servers.

A server's URL is ``wss://host:port/prefix?token=...&ca=FILE``.
"""

import os
import re
import ssl
from typing import NamedTuple
from urllib.parse import unquote, urlsplit

from hapticdb.errors import FileError, UsageError

SECRET = re.compile(r"password|secret|passphrase|token|scram", re.IGNORECASE)
"""Names of parameters whose values are not shown."""
PASSWORD = re.compile(r"(?P<user>\w+://[^:/?@\[]*):(?P<password>.*)@", re.DOTALL)
PORTS = re.compile(r"\d*(?:,[^@/?]*)?(?:/[^@?]*)?\?(?:.*&)?[a-z_]+=")
"""Text that begins with a port and not with a password: host:5432/database?user=me@there."""
CELLS, CONTACTS = "/device/cells", "/device/contacts"
"""Paths of the endpoints below the server's prefix."""
TOKEN_VARIABLE = "HAPTICDB_TOKEN"  # noqa: S105 - the name of the variable, not its value
"""Environment variable that holds the token where the URL has none."""


def scheme_of(url: str) -> str:
    """Scheme of a URL in lower case; empty for a path."""
    scheme, mark, _ = url.partition("://")
    return scheme.lower() if mark else ""


def redact(url: str) -> str:
    """Hide the passwords of a URL, wherever they stand.

    If a password contains an unescaped @, everything up to the last @ is hidden.
    """
    if "://" not in url:
        return url
    secret = PASSWORD.match(url)
    if secret and not PORTS.match(secret["password"]):
        url = secret["user"] + url[secret.end() - 1 :]
    head, mark, query = url.partition("?")
    pairs = [
        f"{key}=***" if SECRET.search(unquote(key)) else f"{key}={value}" if equals else "***"
        for key, equals, value in (pair.partition("=") for pair in query.split("&") if pair)
    ]
    return head + mark + "&".join(pairs)


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


def parse_address(url: str, path: str = CELLS) -> RemoteAddress:
    """Take a URL apart; path is that of the endpoint which is wanted.

    Raises
    ------
    UsageError
        When it is none of a server, has no host, a user, an unknown parameter, or a token that no
        header can carry.
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
            place = shown.partition("?")[0]  # a misspelt token is not shown either
            raise UsageError(f"{place}: a server's URL has the parameters token and ca, no others")
        given[key] = unquote(value)
    token = given["token"] or os.environ.get(TOKEN_VARIABLE, "")
    if not (token.isascii() and token.isprintable()) or " " in token:
        raise UsageError(f"{shown}: the token has characters that no header can carry")
    if given["ca"] and scheme == "ws":
        raise UsageError(f"{shown}: ca is for wss://, whose server shows a certificate")
    host = f"[{parts.hostname}]" if ":" in parts.hostname else parts.hostname
    place = (host if port is None else f"{host}:{port}") + parts.path.rstrip("/")
    return RemoteAddress(f"{scheme}://{place}{path}", token, given["ca"], place, shown)
