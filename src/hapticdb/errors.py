"""The errors that hapticdb raises on purpose.

::

    HapticDBError
    ├── UsageError (ValueError)               options that contradict one another
    │   └── GridError                         a grid that is not possible, or does not match
    ├── FileError (ValueError)                an input file that cannot be used
    │   ├── OutsideGridError                  a part that does not fit the grid
    │   └── GeometryChangedError              a part has changed since it was imported
    ├── MissingExtraError (ImportError)       a format or device needs an extra
    ├── ObjectNotFoundError (LookupError)     no object of that id
    ├── DeviceError (OSError)                 a haptic device that is not there, or went away
    ├── ClusterError (ConnectionError)        a scheduler of tasks, or its workers, cannot be used
    └── DatabaseError                         the database cannot do what was asked
        ├── EnvironmentNotFoundError (FileNotFoundError)
        ├── EnvironmentExistsError (FileExistsError)
        ├── NotAnEnvironmentError             a file of another kind
        ├── NewerVersionError                 written by a newer hapticdb
        ├── DamagedError                      an environment whose contents are broken
        ├── ReadOnlyError (PermissionError)   a write where only reading is possible
        ├── AccessError (PermissionError)     the server does not let this user in
        ├── ConflictError                     another has written the object meanwhile
        ├── ConnectionLostError (ConnectionError)  the server went away
        ├── BusyError (TimeoutError)          another writer held the database too long
        └── StuckError (TimeoutError)         the database took longer than a frame may

Every message is one line: what is wrong, where, and what to do next. If a builtin error fits, the
class is a subclass of it, too.
"""

import os
import sys
from pathlib import Path


def pip_line(extra: str) -> str:
    """Give the command that installs what an extra needs, into this Python's environment."""
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
    """Root of all errors that hapticdb raises on purpose."""


class UsageError(HapticDBError, ValueError):
    """Options or arguments that contradict one another or lie outside their range."""


class GridError(UsageError):
    """A grid that cannot be built, or that differs from the environment's."""


class FileError(HapticDBError, ValueError):
    """An input file that is missing, empty, damaged or of a kind that cannot be read."""


class OutsideGridError(FileError):
    """A part whose bounding box leaves the grid of the environment."""


class GeometryChangedError(FileError):
    """A part of a file has another geometry than the object that was imported from it."""


class MissingExtraError(HapticDBError, ImportError):
    """A file format or a device needs an extra that is not installed."""


class ObjectNotFoundError(HapticDBError, LookupError):
    """No object of that id in the environment."""


class DeviceError(HapticDBError, OSError):
    """A haptic device that is not there, does not answer or was unplugged."""


class ClusterError(HapticDBError, ConnectionError):
    """A scheduler of tasks that is not there, or whose workers cannot do what is asked."""


class DatabaseError(HapticDBError):
    """The database cannot do what was asked."""


class EnvironmentNotFoundError(DatabaseError, FileNotFoundError):
    """No environment at that address."""


class EnvironmentExistsError(DatabaseError, FileExistsError):
    """An environment is there already."""


class NotAnEnvironmentError(DatabaseError):
    """A file or database of another kind."""


class NewerVersionError(DatabaseError):
    """An environment written by a newer hapticdb."""


class DamagedError(DatabaseError):
    """An environment whose contents are broken."""


class ReadOnlyError(DatabaseError, PermissionError):
    """A write to a database that can only be read."""


class BusyError(DatabaseError, TimeoutError):
    """Another writer held the database for longer than the time allowed."""


class AccessError(DatabaseError, PermissionError):
    """The server does not let this user in, or not into this environment."""


class ConflictError(DatabaseError):
    """Somebody else has written the object since it was read."""


class ConnectionLostError(DatabaseError, ConnectionError):
    """The server went away, or was never there."""


class StuckError(DatabaseError, TimeoutError):
    """The database did not answer within the time allowed for a statement."""
