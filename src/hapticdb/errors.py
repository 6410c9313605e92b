"""Errors of hapticdb.

::

    HapticDBError
    ├── UsageError (ValueError)               contradictory or out of range
    │   └── GridError                         an impossible grid, or a mismatch
    ├── FileError (ValueError)                an unusable input file
    │   ├── OutsideGridError                  a part outside the grid
    │   └── GeometryChangedError              a part changed since its import
    ├── MissingExtraError (ImportError)       a format or device needs an extra
    ├── ObjectNotFoundError (LookupError)     no object of that id
    ├── DeviceError (OSError)                 a missing or unplugged haptic device
    ├── ClusterError (ConnectionError)        an unusable scheduler, or its workers
    └── DatabaseError                         the database cannot fulfil the request
        ├── EnvironmentNotFoundError (FileNotFoundError)
        ├── EnvironmentExistsError (FileExistsError)
        ├── NotAnEnvironmentError             a file of another kind
        ├── NewerVersionError                 written by a newer hapticdb
        ├── DamagedError                      damaged contents
        ├── ReadOnlyError (PermissionError)   a write to a read-only database
        ├── AccessError (PermissionError)     no permission for this user
        ├── ConflictError                     a concurrent write to the object
        ├── ConnectionLostError (ConnectionError)  the server went away
        ├── BusyError (TimeoutError)          another writer had the database locked too long
        └── StuckError (TimeoutError)         the database took longer than a frame may

Every message is one line: the fault, its location, and the next step. If a builtin error fits, the
class is a subclass of it, too.
"""

import os
import sys
from pathlib import Path


def pip_line(extra: str) -> str:
    """Command line to install an extra's packages into this Python's environment."""
    from importlib.metadata import requires  # noqa: PLC0415 - 30 ms, and only for an error

    packages = [
        f"'{name.strip()}'"
        for name, _, condition in (line.partition(";") for line in requires("hapticdb") or ())
        if f"extra == '{extra}'" in condition.replace('"', "'")
    ]
    is_found = sys.prefix in {sys.base_prefix, os.environ.get("VIRTUAL_ENV")}
    pip = "pip" if is_found else os.path.relpath(Path(sys.prefix, "bin", "pip"))
    return f"{pip} install {' '.join(packages)}"


class HapticDBError(Exception):
    """Root of all errors of hapticdb."""


class UsageError(HapticDBError, ValueError):
    """Options or arguments that contradict one another or lie outside their range."""


class GridError(UsageError):
    """A grid that cannot be built, or differs from the environment's."""


class FileError(HapticDBError, ValueError):
    """An input file that is missing, empty, damaged or of an unreadable kind."""


class OutsideGridError(FileError):
    """A part whose bounding box leaves the grid of the environment."""


class GeometryChangedError(FileError):
    """A part of a file with another geometry than the object imported from it."""


class MissingExtraError(HapticDBError, ImportError):
    """A file format or a device needs an extra that is not installed."""


class ObjectNotFoundError(HapticDBError, LookupError):
    """No object of that id in the environment."""


class DeviceError(HapticDBError, OSError):
    """A haptic device that is not there, does not answer or was unplugged."""


class ClusterError(HapticDBError, ConnectionError):
    """A scheduler of tasks that is not there, or whose workers cannot run a task."""


class DatabaseError(HapticDBError):
    """A request the database cannot fulfil."""


class EnvironmentNotFoundError(DatabaseError, FileNotFoundError):
    """No environment at that address."""


class EnvironmentExistsError(DatabaseError, FileExistsError):
    """An environment is there already."""


class NotAnEnvironmentError(DatabaseError):
    """A file or database of another kind."""


class NewerVersionError(DatabaseError):
    """An environment written by a newer hapticdb."""


class DamagedError(DatabaseError):
    """An environment with damaged contents."""


class ReadOnlyError(DatabaseError, PermissionError):
    """A write to a read-only database."""


class BusyError(DatabaseError, TimeoutError):
    """Another writer had the database locked for longer than the time allowed."""


class AccessError(DatabaseError, PermissionError):
    """The server does not let this user in, or not into this environment."""


class ConflictError(DatabaseError):
    """Another write to the object since it was read."""


class ConnectionLostError(DatabaseError, ConnectionError):
    """The server went away, or was never there."""


class StuckError(DatabaseError, TimeoutError):
    """The database did not answer within the time allowed for a statement."""
