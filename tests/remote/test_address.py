"""URLs of servers, taken apart."""

import pytest

from hapticdb.errors import UsageError
from hapticdb.store.urls import CONTACTS, TOKEN_VARIABLE, parse_address


def test_the_endpoint_stands_below_the_prefix_and_holds_no_secret() -> None:
    url = "wss://[::1]:8080/lab/?token=a%2Db"
    assert parse_address(url).endpoint == "wss://[::1]:8080/lab/device/cells"
    address = parse_address(url, CONTACTS)
    assert address.endpoint == "wss://[::1]:8080/lab/device/contacts"
    assert address.token == "a-b"  # noqa: S105 - of no server
    assert "a%2Db" not in address.shown


def test_the_token_may_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(TOKEN_VARIABLE, "from-there")
    assert parse_address("ws://host:1").token == "from-there"  # noqa: S105 - of no server
    assert parse_address("ws://host:1").trust() is None


@pytest.mark.parametrize("url", ["car.db", "http://host:1", "ws://", "ws://host:x", "ws://u@h"])
def test_what_names_no_server_is_refused(url: str) -> None:
    with pytest.raises(UsageError, match="write ws://host:port"):
        parse_address(url)
