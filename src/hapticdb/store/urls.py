"""URLs of environments: their scheme, and secrets that are never shown."""

import re
from urllib.parse import unquote

SECRET = re.compile(r"password|secret|passphrase|token|scram", re.IGNORECASE)
"""Names of parameters whose values are not shown."""
PASSWORD = re.compile(r"(?P<user>\w+://[^:/?@\[]*):(?P<password>.*)@", re.DOTALL)
PORTS = re.compile(r"\d*(?:,[^@/?]*)?(?:/[^@?]*)?\?(?:.*&)?[a-z_]+=")
"""Text that begins with a port and not with a password: host:5432/database?user=me@there."""


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
