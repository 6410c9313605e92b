"""Which of several hosts of a URL a connection is made to: libpq's `target_session_attrs`."""

import os

import psycopg
from psycopg.conninfo import conninfo_to_dict, make_conninfo

from hapticdb.errors import ReadOnlyError

READ_ONLY = {"standby", "read-only"}
"""Values of `target_session_attrs` that name servers which cannot be written."""
ANSWER_MS = 1000
"""Milliseconds that the primary has for the question for its revision. A larger value lets a busy
primary answer; a smaller one connects again sooner after the network has lost a connection."""


def aimed(conninfo: str, shown: str, *, read_only: bool) -> str:
    """Conninfo for a connection that reads or writes.

    A connection that reads goes where the URL says. One that writes goes to the primary if the URL
    has several hosts or prefers a standby.

    Raises
    ------
    ReadOnlyError
        When the URL wants a standby and the connection is to write.
    """
    if read_only:
        return conninfo
    try:
        given = conninfo_to_dict(conninfo)
    except psycopg.Error:  # the connection refuses it in better words
        return conninfo
    attrs = wanted_server(conninfo)
    if attrs in READ_ONLY:
        raise ReadOnlyError(
            f"{shown} asks for a server that can only be read, by target_session_attrs={attrs}: "
            "to write, give prefer-standby, or leave it out"
        )
    hosts = [str(given.get(key) or os.environ.get(f"PG{key.upper()}") or "")
             for key in ("host", "hostaddr")]  # fmt: skip
    if attrs == "prefer-standby" or (attrs == "any" and any("," in host for host in hosts)):
        return make_conninfo(conninfo, target_session_attrs="primary")
    return conninfo


def wanted_server(conninfo: str) -> str:
    """Which of several servers a conninfo asks for, or else the process's environment."""
    given = conninfo_to_dict(conninfo).get("target_session_attrs")
    return str(given or os.environ.get("PGTARGETSESSIONATTRS") or "any")


def of_primary(conninfo: str) -> str:
    """Conninfo that leads to the primary among the same hosts."""
    return make_conninfo(conninfo, target_session_attrs="primary")


def at_primary(conninfo: str) -> str:
    """Conninfo for questions to the primary among the same hosts, which is to answer soon."""
    given = conninfo_to_dict(conninfo)
    options = str(given.get("options") or os.environ.get("PGOPTIONS") or "")
    return make_conninfo(
        conninfo,
        target_session_attrs="primary",
        options=f"{options} -cstatement_timeout={ANSWER_MS}".strip(),
    )
