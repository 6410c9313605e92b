"""The errors of psycopg turned into those of `hapticdb.errors`."""

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
from hapticdb.store.believed import damaged

IS_STANDBY = "server is in hot standby mode"
"""What libpq says of a standby where it was asked for a primary."""
MANY = "Multiple connection attempts failed."
"""What psycopg says before it lists the failure of each host."""


@contextlib.contextmanager
def named_errors(shown: str) -> Iterator[None]:
    """Turn psycopg's errors into hapticdb's. `shown` is the URL as messages may show it."""
    try:
        yield
    except psycopg.Error as error:
        raise named(error, shown) from error


def named(error: psycopg.Error, shown: str) -> HapticDBError:
    """Error of `hapticdb.errors` for an error of psycopg."""
    cause = _line(error)
    if isinstance(error, errors.QueryCanceled):
        return StuckError(
            f"{shown} did not answer in time ({cause}); raise the limit with "
            "?options=-cstatement_timeout=MS, or look for what holds the server up"
        )
    if isinstance(error, (errors.LockNotAvailable, errors.DeadlockDetected)):
        return BusyError(f"{shown} is being written by another: try again later ({cause})")
    if isinstance(error, errors.SerializationFailure):
        return BusyError(f"{shown} was changed by another meanwhile: try again ({cause})")
    if isinstance(error, (errors.InsufficientPrivilege, errors.ReadOnlySqlTransaction)):
        return ReadOnlyError(
            f"{shown}: this user may not do that ({cause}); its owner can allow it with "
            "'hapticdb grant URL ROLE --as editor'"
        )
    if isinstance(error, (errors.UndefinedTable, errors.UndefinedColumn, errors.UndefinedFunction)):
        return DamagedError(  # to a user without rights, a schema looks as if it did not exist
            f"{shown} is damaged ({cause}), or this user may no longer use it: ask its owner, "
            "restore a copy, or import the files again"
        )
    if isinstance(error, (errors.DataCorrupted, errors.IndexCorrupted)):
        return damaged(shown, cause)
    if isinstance(error, (errors.DiskFull, errors.OutOfMemory)):
        return DatabaseError(
            f"{shown}: the server has no room left ({cause}); nothing is half done"
        )
    if is_lost(error):
        return ConnectionLostError(
            f"{shown}: the server went away ({cause}); what was committed is safe, "
            "so run the same again when it is back"
        )
    return DatabaseError(f"{shown}: {cause}")


def is_lost(error: BaseException) -> bool:
    """Whether the error is of the connection and not of the statement."""
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
    """Error for a connection that could not be made.

    libpq gives no code here, only text. The text tells the usual causes apart.
    """
    cause = _line(error)
    if cause.startswith("connection is bad: invalid"):  # a parameter that libpq does not know
        return unusable(error, shown)
    if re.search(r'database ".*" does not exist', cause):
        return EnvironmentNotFoundError(f"{shown}: {cause}; make it first with 'createdb'")
    if re.search(
        r"authentication failed|no password|role .* does not exist|pg_hba|not permitted to log in"
        r"|permission denied for database",
        cause,
    ):
        return AccessError(f"{shown}: {cause}; check the user, ~/.pgpass and pg_hba.conf")
    if IS_STANDBY in cause:  # only where a primary was asked for
        hosts = cause.partition("All failures were:")[2].split(" - host: ") if MANY in cause else []
        others = [host for host in hosts[1:] if IS_STANDBY not in host]
        if not others:
            return ReadOnlyError(f"{shown} is a standby: it can only be read")
        return ConnectionLostError(
            f"{shown}: the primary cannot be reached: {'; '.join(others)}; the other hosts are "
            "standbys, which can only be read"
        )
    return ConnectionLostError(f"{shown} cannot be reached: {cause}")


def unusable(error: psycopg.Error, shown: str) -> UsageError:
    """Error for a URL that libpq refuses.

    libpq quotes what it does not understand, which may be a piece of a password. The quotation is
    shown only if the redacted URL contains it.
    """
    cause = _line(error).removeprefix("connection is bad: ")
    if any(words not in shown for words in re.findall(r'"([^"]*)"', cause)):
        cause = "libpq knows no such parameters"
    return UsageError(
        f"{shown}: {cause}; write NAME=VALUE for each parameter, and % & = in values as %25 %26 %3D"
    )


def denied(shown: str, name: str) -> AccessError:
    """Build the error for an environment that this user may not even read."""
    return AccessError(
        f"{shown}: this user may not read the environment {name!r}; its owner can allow it with "
        "'hapticdb grant URL ROLE --as viewer'"
    )


def no_editor(shown: str) -> ReadOnlyError:
    """Build the error for a user who may write to the environment, but not to its objects."""
    return ReadOnlyError(
        f"{shown}: this user may not change objects; its owner can allow it with "
        "'hapticdb grant URL ROLE --as editor'"
    )


def _line(error: psycopg.Error) -> str:
    """Text of an error on one line, without the position in the statement."""
    primary = error.diag.message_primary
    text = primary or str(error) or type(error).__name__
    return " ".join(text.split())
