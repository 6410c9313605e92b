"""Tokens, cookies and roles."""

from dataclasses import replace
from types import SimpleNamespace
from typing import cast

import pytest
from starlette.requests import Request

from hapticdb.errors import UsageError
from hapticdb.server import access
from hapticdb.server.access import Access, Role
from hapticdb.server.front_page import ClientPage, SignIn
from hapticdb.server.limits import Limits

VIEWER = "a-token-for-viewers"
EDITOR = "a-token-for-editors"


class Clock:
    """A clock that a test moves."""

    now = 100.0

    def __call__(self) -> float:
        return self.now


def of_two_roles(clock: Clock) -> Access:
    return Access({VIEWER: Role.VIEWER, EDITOR: Role.EDITOR}, port=80, clock=clock)


def cookie_header(known: Access, token: str) -> dict[str, str]:
    return {"cookie": f"other=1; {known.cookie_name}={known.sign_in(token)}"}


def test_access_role_by_header_and_cookie() -> None:
    known = of_two_roles(Clock())
    for token, role in ((VIEWER, Role.VIEWER), (EDITOR, Role.EDITOR)):
        assert known.role_of_headers({"authorization": f"Bearer {token}"}) is role
        assert known.role_of_headers(cookie_header(known, token)) is role


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"authorization": "Bearer"},
        {"authorization": f"Basic {VIEWER}"},
        {"authorization": "Bearer " + "x" * 100_000},
        {"cookie": f"hapticdb-80={VIEWER}"},
        {"cookie": "\x00;;=;\udcff"},
    ],
)
def test_access_unknown_credentials_no_role(headers: dict[str, str]) -> None:
    assert of_two_roles(Clock()).role_of_headers(headers) is None


def test_sign_in_rate_limit_per_address() -> None:
    """An IPv6 address stands for its network of 64 bits."""
    limits = replace(Limits(), sign_ins_per_second=1e-9, sign_ins_at_once=1.0)
    door = SignIn(of_two_roles(Clock()), cast("ClientPage", None), limits, "", "title")

    def status(address: str) -> int:
        request = SimpleNamespace(client=SimpleNamespace(host=address), method="POST")
        return door._sign_in(cast("Request", request), "wrong").status_code

    tries = ("10.0.0.1", "10.0.0.1", "10.0.0.2", "fe80:0:0:1::1", "fe80:0:0:1::2", "fe80:0:0:2::1")
    assert [status(address) for address in tries] == [403, 429, 403, 403, 429, 403]


def test_access_wrong_token_with_open_role() -> None:
    known = Access({EDITOR: Role.EDITOR}, open_role=Role.VIEWER)
    assert known.role_of_headers({}) is Role.VIEWER
    assert known.role_of_headers({"authorization": f"Bearer {VIEWER}"}) is None


def test_access_cookie_expires_after_disuse() -> None:
    clock = Clock()
    known = of_two_roles(clock)
    header = cookie_header(known, VIEWER)
    for _ in range(5):
        clock.now += access.SIGNED_IN_SECONDS - 1.0
        assert known.role_of_headers(header) is Role.VIEWER
    clock.now += access.SIGNED_IN_SECONDS
    assert known.role_of_headers(header) is None


def test_access_least_recently_used_cookie_evicted() -> None:
    clock = Clock()
    known = of_two_roles(clock)
    first, second = cookie_header(known, VIEWER), cookie_header(known, EDITOR)
    for _ in range(access.MOST_SIGNED_IN):
        clock.now += 1.0
        assert known.role_of_headers(second) is Role.EDITOR
        assert known.sign_in(VIEWER)
    assert known.role_of_headers(first) is None
    assert known.role_of_headers(second) is Role.EDITOR


@pytest.mark.parametrize(
    "token", ["", "short", "x" * 257, "with a blank inside it", "ümläute-sind-keine-ziffern"]
)
def test_access_weak_token_refused(token: str) -> None:
    with pytest.raises(UsageError, match="token"):
        Access({token: Role.VIEWER})


def test_role_order_and_words() -> None:
    assert [Role.of(role.word) for role in sorted(Role)] == [Role.VIEWER, Role.TOUCHER, Role.EDITOR]
    with pytest.raises(UsageError, match="viewer, toucher, editor"):
        Role.of("owner")
