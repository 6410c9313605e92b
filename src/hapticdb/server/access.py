"""Roles, bearer tokens and session cookies of the server.

A viewer sees, a toucher also gets forces, an editor also moves objects. A browser sends its token
once and gets a cookie; a program that reads figures sends it in the header ``Authorization:
Bearer``. The server stores only digests of tokens and cookies.
"""

import hashlib
import hmac
import secrets
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import IntEnum
from http.cookies import CookieError, SimpleCookie

from hapticdb.errors import UsageError

SIGNED_IN_SECONDS = 3600.0
"""Lifetime of a cookie after its last use, seconds. Larger: the same for a stolen one."""
MOST_SIGNED_IN = 1024
"""Valid cookies, at most; a new one replaces the least recently used."""
LEAST_TOKEN = 16
"""Fewest characters of a person's own token. Smaller: guessable."""
LONGEST_TOKEN = 256
"""Most characters of a token. A longer one is wrong, and only its first part is hashed."""


class Role(IntEnum):
    """Role of a client; a greater role includes the rights of a smaller one."""

    VIEWER = 1
    TOUCHER = 2
    EDITOR = 3

    @property
    def word(self) -> str:
        """Name in options and messages, lower case."""
        return self.name.lower()

    @classmethod
    def of(cls, word: str) -> "Role":
        """Role of this name; UsageError for an unknown one."""
        known = {role.word: role for role in cls}
        if word not in known:
            raise UsageError(f"no role {word!r}: choose one of {', '.join(known)}")
        return known[word]


@dataclass
class _SignedIn:
    """A cookie's role, and its end on the clock."""

    role: Role
    until: float


class Access:
    """Tokens of one server with their roles, and valid cookies.

    open_role : of clients without a token; port : of the server, for the name of the cookie.
    """

    def __init__(
        self,
        tokens: Mapping[str, Role],
        *,
        open_role: Role | None = None,
        port: int = 0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        for token in tokens:
            check_token(token)
        self._roles = [(_digest(token), role) for token, role in tokens.items()]
        self._signed_in: dict[bytes, _SignedIn] = {}
        self._clock = clock
        self.open_role = open_role
        self.port = port

    @property
    def cookie_name(self) -> str:
        """Name of this server's cookie: browsers send a cookie to all ports of a machine."""
        return f"hapticdb-{self.port}"

    def role_of_token(self, token: str) -> Role | None:
        """Role of a token; None for a wrong one. Takes equally long for both."""
        shown = _digest(token[: LONGEST_TOKEN + 1])
        found = None
        for digest, role in self._roles:
            if hmac.compare_digest(digest, shown):
                found = role
        return found

    def role_of_headers(self, headers: Mapping[str, str]) -> Role | None:
        """Role of a client by its request's headers, with names in lower case.

        That of its bearer token, or of its cookie, which is renewed; else the open role. None for
        no role, and for a wrong bearer token.
        """
        scheme, _, token = headers.get("authorization", "").partition(" ")
        if scheme.lower() == "bearer":
            return self.role_of_token(token.strip())
        known = self._known(self.cookie_of(headers))
        return known.role if known is not None else self.open_role

    def cookie_of(self, headers: Mapping[str, str]) -> str:
        """Value of this server's cookie in a request's headers; empty without one."""
        try:
            morsel = SimpleCookie(headers.get("cookie", "")).get(self.cookie_name)
        except CookieError:
            return ""
        return "" if morsel is None else morsel.value

    def renew(self, cookie: str) -> bool:
        """Renew a cookie; returns whether it was still valid."""
        return self._known(cookie) is not None

    def sign_in(self, token: str) -> str | None:
        """Value of a new cookie for the browser with this token; None for a wrong token."""
        role = self.role_of_token(token)
        if role is None:
            return None
        self._forget_old()
        cookie = secrets.token_urlsafe(32)
        self._signed_in[_digest(cookie)] = _SignedIn(role, self._clock() + SIGNED_IN_SECONDS)
        return cookie

    def _known(self, cookie: str) -> _SignedIn | None:
        """Find and renew a valid cookie by its digest, from which no cookie can be computed."""
        known = self._signed_in.get(_digest(cookie[:LONGEST_TOKEN])) if cookie else None
        now = self._clock()
        if known is None or now >= known.until:
            return None
        known.until = now + SIGNED_IN_SECONDS
        return known

    def _forget_old(self) -> None:
        """Drop expired cookies, and the oldest of too many."""
        now = self._clock()
        valid = {key: known for key, known in self._signed_in.items() if now < known.until}
        oldest = sorted(valid, key=lambda key: valid[key].until)
        for key in oldest[: max(len(valid) - MOST_SIGNED_IN + 1, 0)]:
            del valid[key]
        self._signed_in = valid


def make_token() -> str:
    """Make a token of 192 random bits."""
    return secrets.token_urlsafe(24)


def check_token(token: str) -> None:
    """Refuse a token of the wrong length, or with letters to be escaped in a URL."""
    if not LEAST_TOKEN <= len(token) <= LONGEST_TOKEN:
        raise UsageError(
            f"a token of {len(token)} characters: choose one of {LEAST_TOKEN} to {LONGEST_TOKEN}, "
            "or let the server make one"
        )
    if not all(letter.isascii() and (letter.isalnum() or letter in "-._~") for letter in token):
        raise UsageError(
            "a token may hold letters, digits and -._~ only, so that a URL can carry it"
        )


def _digest(text: str) -> bytes:
    return hashlib.sha256(text.encode("utf-8", "surrogatepass")).digest()
