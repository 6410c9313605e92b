"""Errors of psycopg as errors of `hapticdb.errors`."""

import contextlib
import re
from collections.abc import Iterator

import psycopg
from psycopg import errors

from hapticdb.errors import (
    AccessError,
    BusyError,
    ConnectionLostError,
    DamagedError,
    DatabaseError,
    EnvironmentNotFoundError,
    HapticDBError,
    ReadOnlyError,
    StuckError,
    UsageError,
)
from hapticdb.store.parsing import damaged

IS_STANDBY = "server is in hot standby mode"
"""libpq's message for a standby in place of a primary."""
EACH_HOST = "All failures were:"
"""psycopg's line before the failures of each host."""
ATTEMPT = re.compile(
    r"(?:- host: '?(?P<host>.*?)'?, port: '?(?P<port>.*?)'?, hostaddr: (?:None|'.*?'): )?"
    r"(?:connection (?:failed|is bad): )?"
    r'(?:connection to server (?:on socket "(?P<socket>[^"]*)"'
    r'|at "(?P<address>[^"]*)"(?: \([^)]*\))?, port (?P<at>\d+)) failed: )?'
    r"(?:FATAL: +)?(?P<why>.*)"
)
"""Message of psycopg and libpq for one attempt to connect."""


@contextlib.contextmanager
def named_errors(shown: str) -> Iterator[None]:
    """Raise psycopg's errors as hapticdb's. shown : the redacted URL."""
    try:
        yield
    except psycopg.Error as error:
        raise named(error, shown) from error


MEANINGS: dict[type[HapticDBError], str] = {
    StuckError: "{} did not answer in time ({}); raise the limit with "
    "?options=-cstatement_timeout=MS, or look for what holds the server up",
    BusyError: "{} was changed or is being written by another: try again later ({})",
    ReadOnlyError: "{}: this user may not do that ({}); its owner can allow it with "
    "'hapticdb grant URL ROLE --as editor'",
    # without rights, a schema seems not to exist
    DamagedError: "{} is damaged ({}), or this user may no longer use it: ask its owner, "
    "restore a copy, or import the files again",
    DatabaseError: "{}: the server has no room left ({}); nothing is half done",
    ConnectionLostError: "{}: one of its partitions cannot be reached ({}); what was committed is "
    "safe, so run the same again when it is back",
}
"""Messages for errors of a reachable server: the URL, and the cause."""
NAMED: dict[type[psycopg.Error], type[HapticDBError]] = {
    errors.QueryCanceled: StuckError,
    errors.LockNotAvailable: BusyError,
    errors.DeadlockDetected: BusyError,
    errors.SerializationFailure: BusyError,
    errors.InsufficientPrivilege: ReadOnlyError,
    errors.ReadOnlySqlTransaction: ReadOnlyError,
    errors.UndefinedTable: DamagedError,
    errors.UndefinedColumn: DamagedError,
    errors.UndefinedFunction: DamagedError,
    errors.DiskFull: DatabaseError,
    errors.OutOfMemory: DatabaseError,
    errors.SqlclientUnableToEstablishSqlconnection: ConnectionLostError,
    errors.ConnectionFailure: ConnectionLostError,
}


def named(error: psycopg.Error, shown: str) -> HapticDBError:
    """Error of `hapticdb.errors` for an error of psycopg."""
    cause = _line(error)
    if isinstance(error, (errors.DataCorrupted, errors.IndexCorrupted)):
        return damaged(shown, cause)
    if (ours := NAMED.get(type(error))) is not None:
        if ours is ConnectionLostError:  # of a partition
            cause = " ".join((error.diag.message_detail or cause).split())
        return ours(MEANINGS[ours].format(shown, cause))
    if is_lost(error):
        return ConnectionLostError(
            f"{shown}: the server went away ({cause}); what was committed is safe, "
            "so run the same again when it is back"
        )
    return DatabaseError(f"{shown}: {cause}")


def is_lost(error: BaseException) -> bool:
    """Whether the error concerns the connection and not the statement."""
    return isinstance(
        error,
        (
            errors.AdminShutdown,
            errors.CrashShutdown,
            errors.CannotConnectNow,
            errors.ConnectionException,
            errors.IdleSessionTimeout,
            errors.IdleInTransactionSessionTimeout,
        ),
    ) or (isinstance(error, psycopg.OperationalError) and error.sqlstate is None)


def refused(error: psycopg.OperationalError, shown: str) -> HapticDBError:
    """Error for a failed connection, by its text: libpq gives no code here."""
    if _line(error).startswith("connection is bad: invalid"):  # unknown to libpq
        return unusable(_line(error), shown)
    hosts = _reasons(str(error))
    cause = "; ".join(hosts)
    if re.search(r'database ".*" does not exist', cause):
        return EnvironmentNotFoundError(f"{shown}: {cause}; make it first with 'createdb'")
    if re.search(
        r"authentication failed|no password|role .* does not exist|pg_hba|not permitted to log in"
        r"|permission denied for database",
        cause,
    ):
        return AccessError(f"{shown}: {cause}; check the user, ~/.pgpass and pg_hba.conf")
    full = "too many clients|too many connections|slots are reserved|no more connections allowed"
    if re.search(full, cause):
        return ConnectionLostError(
            f"{shown} has no free connection ({cause}): end programs that use this server, or "
            "raise max_connections there"
        )
    if IS_STANDBY in cause:  # only with a primary in the URL
        others = [host for host in hosts if IS_STANDBY not in host]
        if not others:
            return standby(shown)
        return ConnectionLostError(
            f"{shown}: the primary cannot be reached: {'; '.join(others)}; the other hosts are "
            "standbys, which can only be read"
        )
    return ConnectionLostError(f"{shown} cannot be reached: {cause}")


def _reasons(text: str) -> list[str]:
    """Reasons of a failed connection, each one of each host of the URL once."""
    found: dict[str, None] = {}
    for line in text.rpartition(EACH_HOST)[2].splitlines():
        one = ATTEMPT.fullmatch(line)
        if one and one["why"] and not line.startswith("\t"):  # libpq's advice
            host, port = (one["host"], one["port"]) if one["host"] else (one["address"], one["at"])
            where = one["socket"] if not host else host if port == "None" else f"{host}:{port}"
            found[f"{where}: {one['why']}" if where else one["why"]] = None
    return list(found)


def unusable(cause: str, shown: str) -> UsageError:
    """Error for a URL refused by libpq.

    libpq quotes unparsable text, perhaps a piece of a password: the quotation is shown only if the
    redacted URL contains it.
    """
    cause = " ".join(cause.removeprefix("connection is bad: ").split())
    if not cause or any(words not in shown for words in re.findall(r'"([^"]*)"', cause)):
        cause = "libpq cannot read it"
    return UsageError(
        f"{shown}: {cause}; write NAME=VALUE for each parameter, and @ : / ? # % & = in names, "
        "passwords and values as %40 %3A %2F %3F %23 %25 %26 %3D"
    )


def standby(shown: str) -> ReadOnlyError:
    """Build the error for a server without writes."""
    return ReadOnlyError(
        f"{shown} is a standby: it can only be read; to write, name its primary, or all servers "
        "with target_session_attrs=primary"
    )


def remade(shown: str) -> ConnectionLostError:
    """Build the error for an environment dropped and created anew."""
    return ConnectionLostError(f"{shown} is another environment than before: open it again")


def _line(error: psycopg.Error) -> str:
    """Text of an error on one line, without the position in the statement."""
    primary = error.diag.message_primary
    text = primary or str(error) or type(error).__name__
    return " ".join(text.split())
