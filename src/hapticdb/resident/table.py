"""CellTable: a fixed budget of memory that one process fills with cells and others read.

The memory is anonymous and inherited by file descriptor: it goes when the last process that maps it
ends, however that happens.
"""

import mmap
import os
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import DTypeLike, NDArray

from hapticdb.errors import UsageError
from hapticdb.kernels.records import FIGURES, SESSION
from hapticdb.kernels.resident import cells as kernels

DEFAULT_BUDGET = 256 << 20
LEAST_BUDGET = 1 << 20
FIRST_VERSION = 1
"""Of a table into which nothing was written."""
MOST_READERS = 16
CONTROL_WORDS = 16
HEARTBEAT, AWAY, LOADING, STOP = 8, 9, 10, 11
"""Words of the control block beside `kernels.cells`': when the database last answered (ns,
CLOCK_MONOTONIC), whether it is away, cells being fetched, and whether all shall end."""
_PAGE = 4096
_joining = threading.Lock()


class Desk(NamedTuple):
    """What sessions and the fetching process tell one another; `kernels.records` has the fields.

    sessions (16,) of SESSION, a row a session; pids (16,) int64: the processes that hold the rows,
    0 for none; figures () of FIGURES: what the fetching process counts.
    """

    sessions: NDArray[np.void]
    pids: NDArray[np.int64]
    figures: NDArray[np.void]


class _Field(NamedTuple):
    name: str
    dtype: DTypeLike
    shape: tuple[int, ...]


def _fields(n_slots: int, capacity: int) -> list[_Field]:
    """All arrays of a table, in their order in memory."""
    rows = MOST_READERS
    return [
        _Field("control", np.int64, (CONTROL_WORDS,)),
        _Field("readers", np.int64, (rows * kernels.READER_STRIDE,)),
        _Field("sessions", SESSION, (rows,)),
        _Field("pids", np.int64, (rows,)),
        _Field("figures", FIGURES, ()),
        _Field("keys", np.int64, (kernels.BUFFERS, capacity)),
        _Field("slots", np.int32, (kernels.BUFFERS, capacity)),
        _Field("words", np.uint32, (n_slots, kernels.CELL_WORDS)),
        _Field("masks", np.uint64, (n_slots,)),
        _Field("used", np.uint8, (n_slots,)),
    ]


def _bytes_of(n_slots: int) -> int:
    """Bytes of a table of so many slots, each array on a page of its own."""
    sizes = [
        int(np.prod(f.shape)) * np.dtype(f.dtype).itemsize
        for f in _fields(n_slots, _capacity(n_slots))
    ]
    return sum(-(-size // _PAGE) * _PAGE for size in sizes)


def _capacity(n_slots: int) -> int:
    """Entries of a directory: as many cells known to be empty as slots leave it half full."""
    return 1 << (4 * n_slots - 1).bit_length()


def slots_within(budget_bytes: int) -> int:
    """How many cells fit into a budget, the empty one counted.

    Raises
    ------
    UsageError
        When the budget is below `LEAST_BUDGET`.
    """
    if budget_bytes < LEAST_BUDGET:
        raise UsageError(
            f"a budget of {budget_bytes} bytes for resident cells: give {LEAST_BUDGET} or more"
        )
    low, high = 1, budget_bytes // (4 * kernels.CELL_WORDS)
    while low < high:
        middle = (low + high + 1) // 2
        low, high = (middle, high) if _bytes_of(middle) <= budget_bytes else (low, middle - 1)
    return low


class CellTable:
    """A table of cells in memory that processes share.

    Attributes
    ----------
    cells : Cells
        The arrays that frames read; see `hapticdb.kernels.resident.cells`.
    desk : Desk
        What sessions and the fetching process tell one another.
    descriptor : int
        File descriptor of the memory, for a process to inherit.
    size_bytes : int
        Of the memory: never more than the budget.
    """

    def __init__(self, descriptor: int, n_slots: int) -> None:
        self.descriptor = descriptor
        self.n_slots = n_slots
        self.size_bytes = _bytes_of(n_slots)
        self._memory = mmap.mmap(descriptor, self.size_bytes)
        views: dict[str, NDArray[np.generic]] = {}
        at = 0
        for name, dtype, shape in _fields(n_slots, _capacity(n_slots)):
            views[name] = np.ndarray(shape, dtype, self._memory, at)
            at += -(-views[name].nbytes // _PAGE) * _PAGE
        self.cells = kernels.Cells(**{n: views[n] for n in kernels.Cells._fields if n in views})  # type: ignore[arg-type]
        self.desk = Desk(**{n: views[n] for n in Desk._fields})  # type: ignore[arg-type]

    @classmethod
    def create(cls, budget_bytes: int = DEFAULT_BUDGET) -> "CellTable":
        """Make a table of at most so many bytes, in which every cell is unknown."""
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        if budget_bytes > memory:
            raise UsageError(
                f"a budget of {budget_bytes} bytes for resident cells: this machine has {memory}"
            )
        n_slots = slots_within(budget_bytes)
        descriptor = anonymous_memory("hapticdb-cells", _bytes_of(n_slots))
        table = cls(descriptor, n_slots)
        table.cells.keys[:] = kernels.UNKNOWN
        table.cells.control[kernels.VERSION] = FIRST_VERSION
        return table

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Give the memory back, here; other processes keep theirs."""
        if self.descriptor >= 0:
            os.close(self.descriptor)  # the mapping itself goes with the last array
            self.descriptor = -1

    @property
    def capacity(self) -> int:
        """Entries that a directory has room for; half of them are used at most."""
        return int(self.cells.keys.shape[1])

    @property
    def version(self) -> int:
        """Number of the published directory."""
        return int(self.cells.control[kernels.VERSION])

    @property
    def revision(self) -> int:
        """The database's revision that the published cells are of."""
        return int(self.cells.control[kernels.REVISION + self.version % kernels.BUFFERS])

    def join(self) -> int:
        """Become a reader; returns its row.

        Raises
        ------
        UsageError
            When the table has as many readers as it can.
        """
        with _joining:
            free = np.flatnonzero(self.desk.pids == 0)
            if len(free):
                row = int(free[0])
                self._clear(row)
                sequence = self.desk.sessions["sequence"]
                sequence[row] += sequence[row] % 2  # odd where the last session died as it wrote
                self.desk.pids[row] = os.getpid()
                return row
        raise UsageError(f"a table of cells has {MOST_READERS} readers at most: end one first")

    def leave(self, row: int) -> None:
        """Be a reader no more."""
        self._clear(row)
        self.desk.pids[row] = 0

    def release_dead(self) -> None:
        """Let go of what readers hold whose processes have ended; their rows stay taken."""
        for row in np.flatnonzero(self.desk.pids).tolist():
            if not is_alive(int(self.desk.pids[row])):
                self.cells.readers[row * kernels.READER_STRIDE] = 0
                self.desk.sessions["told"]["is_active"][row] = False

    def _clear(self, row: int) -> None:
        self.cells.readers[row * kernels.READER_STRIDE] = 0
        for name in SESSION.names or ():
            if name != "sequence":
                self.desk.sessions[name][row] = 0

    @contextmanager
    def reading(self) -> Iterator[int]:
        """Be a reader inside; yields its row."""
        row = self.join()
        try:
            yield row
        finally:
            self.leave(row)


def is_alive(pid: int) -> bool:
    """Whether a process runs; one that has ended and waits to be asked for its status does not."""
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    try:
        status = Path(f"/proc/{pid}/stat").read_text()
    except OSError:  # no such folder on this system, or it ended just now
        return True
    return status.rpartition(")")[2].split()[0] not in {"Z", "X"}


def anonymous_memory(name: str, size: int) -> int:
    """File descriptor of memory without a name, zero."""
    if sys.platform == "linux":
        descriptor = os.memfd_create(name)
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.truncate(descriptor, size)
    return descriptor
