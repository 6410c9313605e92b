"""WebSockets to servers: how they are opened, and what is said when they cannot be."""

import contextlib
import ssl
from collections.abc import Iterator
from http import HTTPStatus
from typing import Any

from websockets.exceptions import InvalidStatus, WebSocketException
from websockets.sync.client import ClientConnection, connect

from hapticdb.errors import (
    AccessError,
    BusyError,
    ConnectionLostError,
    EnvironmentNotFoundError,
    HapticDBError,
)

BUSY = {HTTPStatus.SERVICE_UNAVAILABLE, HTTPStatus.TOO_MANY_REQUESTS}
BEHIND_A_PROXY = {HTTPStatus.BAD_GATEWAY, HTTPStatus.GATEWAY_TIMEOUT}


def open_websocket(
    endpoint: str,
    *,
    token: str,
    trust: ssl.SSLContext | None,
    shown: str,
    **options: Any,  # noqa: ANN401 - those of another package
) -> ClientConnection:
    """Connect to an endpoint straight, without a proxy and without compression.

    Parameters
    ----------
    endpoint : str
        URL of the WebSocket.
    token : str
        Secret that lets the client in, or empty.
    trust : ssl.SSLContext or None
        Certificates to trust; None for a connection without TLS.
    shown : str
        The URL as messages may show it.
    **options
        Further ones of `websockets.sync.client.connect`: sizes, patience, pings.

    Raises
    ------
    AccessError
        If the server refuses the token, or its certificate is not trusted.
    BusyError
        If the server has too many clients.
    ConnectionLostError
        If the server cannot be reached or does not answer in time.
    EnvironmentNotFoundError
        If another server answers there.
    """
    with _named_errors(shown):
        return connect(
            endpoint,
            ssl=trust,
            compression=None,
            additional_headers={"Authorization": f"Bearer {token}"} if token else {},
            user_agent_header="hapticdb",
            proxy=None,  # a proxy between would add its delays: TLS passes, or nothing
            **options,
        )


@contextlib.contextmanager
def _named_errors(shown: str) -> Iterator[None]:
    """Turn errors of a connection that cannot be made into those of hapticdb."""
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
