"""URLs of servers, taken apart."""

import pytest

from hapticdb.client.opening import TOKEN_VARIABLE, parse_address
from hapticdb.errors import UsageError


def test_the_endpoint_stands_below_the_prefix_and_holds_no_secret() -> None:
    address = parse_address("wss://[::1]:8080/lab/?token=a%2Db")
    assert address.endpoint == "wss://[::1]:8080/lab/device/contacts"
    assert address.token == "a-b"  # noqa: S105 - of no server
    assert "a%2Db" not in address.shown


def test_the_token_may_come_from_the_environment(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(TOKEN_VARIABLE, "from-there")
    assert parse_address("ws://host:1").token == "from-there"  # noqa: S105 - of no server
    assert parse_address("ws://host:1").trust() is None


@pytest.mark.parametrize(
    ("url", "words"),
    [
        *((url, "write ws://host:port") for url in ("car.db", "http://host:1", "ws://")),
        *((url, "write ws://host:port") for url in ("ws://host:x", "ws://u@h")),
        ("ws://host:1?tokn=secret", "parameters token and ca"),
        ("ws://host:1?ca=cert.pem", "ca is for wss"),
        ("ws://host:1?token=a%20b", "no header can carry"),
    ],
)
def test_what_names_no_server_is_refused(url: str, words: str) -> None:
    with pytest.raises(UsageError, match=words) as told:
        parse_address(url)
    assert "secret" not in str(told.value)
