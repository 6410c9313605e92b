"""URLs of environments: schemes, redaction of secrets."""

import re
from urllib.parse import quote, unquote

from hapticdb.errors import UsageError

SECRET = re.compile(r"password|secret|passphrase|token|scram", re.IGNORECASE)
"""Parameters with secret values."""
PARTITIONS = "partitions"
"""Parameter with the servers for the rows of a new environment."""
PASSWORD = re.compile(r"(?P<user>\w+://[^:/?@\[]*):(?P<password>.*)@", re.DOTALL)
PORTS = re.compile(r"\d*(?:,[^@/?]*)?(?:/[^@?]*)?\?(?:.*&)?[a-z_]+=")
"""A port and not a password after the colon: host:5432/database?user=me@there."""


def scheme_of(url: str) -> str:
    """Scheme of a URL in lower case; empty for a path."""
    scheme, mark, _ = url.partition("://")
    return scheme.lower() if mark else ""


def redact(url: str) -> str:
    """URL without its passwords, up to the last @, and its partitions, which have some, too."""
    if "://" not in url:
        return url
    secret = PASSWORD.match(url)
    if secret and not PORTS.match(secret["password"]):
        url = secret["user"] + url[secret.end() - 1 :]
    head, mark, query = url.partition("?")
    # text without = may be a piece of a password: hidden, too
    pairs = [
        f"{key}=***" if SECRET.search(unquote(key)) else f"{key}={value}" if equals else "***"
        for key, equals, value in (pair.partition("=") for pair in query.split("&") if pair)
        if key != PARTITIONS
    ]
    return head + (mark if pairs or not query else "") + "&".join(pairs)


def with_partitions(url: str, servers: str) -> str:
    """URL of a new environment with its rows on servers: hosts or URLs with commas between."""
    if scheme_of(url) not in {"postgresql", "postgres"}:
        raise UsageError(f"{redact(url)}: only environments on PostgreSQL have partitions")
    named = ",".join(quote(one.strip(), safe="") for one in servers.split(","))
    return f"{url}{'&' if '?' in url else '?'}{PARTITIONS}={named}"
