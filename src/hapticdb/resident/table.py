"""CellTable: a fixed amount of memory with cells, of one writer and many readers.

The memory is anonymous and inherited by file descriptor. The system frees it at the end of its last
process, even after a crash.
"""

import mmap
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from hapticdb.closing import Closes
from hapticdb.errors import UsageError
from hapticdb.kernels.field.lattice import BEYOND, CELL_VALUES
from hapticdb.kernels.records.cells import BUFFERS, CONTROL, FIGURES, READER, REQUEST
from hapticdb.kernels.resident import cells as kernels

DEFAULT_BUDGET = 256 << 20
"""Default size of a table, bytes. Larger: more resident cells."""
LEAST_BUDGET = 1 << 20
"""Smallest size of a table, bytes."""
FIRST_VERSION = 1
"""Version number of a table before the first write."""
MOST_READERS = 80
"""Greatest number of readers of a table at the same time: the 64 sessions of a host, and others.
Larger: 2.5 KiB of the table for each, and an eviction checks more of them."""
_PAGE = 4096
_joining = threading.Lock()


class RequestQueue(NamedTuple):
    """Messages between sessions and the prefetch process; `kernels.records.cells` has the fields.

    requests (R,) of REQUEST, one row for each reader; pids (R,) int64: ids of the processes of
    the rows, 0 for none; figures () of FIGURES: counts of the prefetch process.
    """

    requests: NDArray[np.void]
    pids: NDArray[np.int64]
    figures: NDArray[np.void]


class _Field(NamedTuple):
    name: str
    dtype: DTypeLike
    shape: tuple[int, ...]


def _fields(n_slots: int, *, has_distances: bool) -> list[_Field]:
    """All arrays of a table, in their order in memory."""
    rows, capacity = MOST_READERS, _capacity(n_slots)
    distances = [
        _Field("payload", np.uint8, (n_slots, CELL_VALUES)),
        _Field("near", np.uint32, (n_slots, kernels.CELL_WORDS)),
    ]
    return [
        _Field("control", CONTROL, ()),
        _Field("readers", READER, (rows,)),
        _Field("requests", REQUEST, (rows,)),
        _Field("pids", np.int64, (rows,)),
        _Field("figures", FIGURES, ()),
        _Field("keys", np.int64, (BUFFERS, capacity)),
        _Field("slots", np.int32, (BUFFERS, capacity)),
        _Field("words", np.uint32, (n_slots, kernels.CELL_WORDS)),
        _Field("masks", np.uint64, (n_slots,)),
        _Field("used", np.uint8, (n_slots,)),
        _Field("filled", np.int64, (n_slots,)),
        *(distances if has_distances else []),
    ]


def _bytes_of(n_slots: int, *, has_distances: bool) -> int:
    """Bytes of a table with `n_slots` slots, each array on a page of its own."""
    sizes = [
        int(np.prod(f.shape)) * np.dtype(f.dtype).itemsize
        for f in _fields(n_slots, has_distances=has_distances)
    ]
    return sum(-(-size // _PAGE) * _PAGE for size in sizes)


def _capacity(n_slots: int) -> int:
    """Entries of a directory; half full with a cell in each slot and as many empty cells."""
    return 1 << (4 * n_slots - 1).bit_length()


def slots_within(budget_bytes: int, *, has_distances: bool = False) -> int:
    """Number of slots within a budget, with the slot for empty cells: at least `LEAST_BUDGET`.

    A slot with distances takes 47 KiB, one without them 4 KiB.
    """
    if budget_bytes < LEAST_BUDGET:
        raise UsageError(
            f"a budget of {budget_bytes} bytes for resident cells: give {LEAST_BUDGET} or more"
        )
    # bisection: the capacity is a power of two, so the size has no inverse
    low, high = 1, budget_bytes // (4 * kernels.CELL_WORDS)
    while low < high:
        middle = (low + high + 1) // 2
        needed = _bytes_of(middle, has_distances=has_distances)
        low, high = (middle, high) if needed <= budget_bytes else (low, middle - 1)
    return low


class CellTable(Closes):
    """A table of cells in shared memory.

    descriptor : of the memory from `create`, in any process, owned from now on. cells : the arrays
    that frames read; queue : messages between sessions and the prefetch process; filled (slots,) :
    version of the directory in which each slot's cell appeared, for copies of the table; size_bytes
    : never more than the budget.
    """

    def __init__(self, descriptor: int, n_slots: int) -> None:
        self.descriptor = descriptor
        self.n_slots = n_slots
        self.size_bytes = os.fstat(descriptor).st_size
        # the size tells the two kinds apart, so no process can take one for the other
        self.has_distances = self.size_bytes == _bytes_of(n_slots, has_distances=True)
        try:
            self._memory = mmap.mmap(descriptor, self.size_bytes)
        except OSError:
            self.close()
            raise
        views: dict[str, NDArray[np.generic]] = {}
        at = 0
        for name, dtype, shape in _fields(n_slots, has_distances=self.has_distances):
            views[name] = np.ndarray(shape, dtype, self._memory, at)
            at += -(-views[name].nbytes // _PAGE) * _PAGE
        self.cells = kernels.Cells(**{n: views[n] for n in kernels.Cells._fields if n in views})  # type: ignore[arg-type]
        self.queue = RequestQueue(**{n: views[n] for n in RequestQueue._fields})  # type: ignore[arg-type]
        self.filled: NDArray[np.int64] = views["filled"]  # type: ignore[assignment]

    @classmethod
    def create(cls, budget_bytes: int = DEFAULT_BUDGET, *, distances: bool = False) -> "CellTable":
        """Make a table of at most `budget_bytes`, every cell unknown.

        With `distances` its cells have the distances to surfaces of the law distance; then
        a tenth as many cells fit.
        """
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
        if budget_bytes > memory:
            raise UsageError(
                f"a budget of {budget_bytes} bytes for resident cells: this machine has {memory}"
            )
        n_slots = slots_within(budget_bytes, has_distances=distances)
        size = _bytes_of(n_slots, has_distances=distances)
        descriptor = anonymous_memory("hapticdb-cells", size)
        table = cls(descriptor, n_slots)
        table.cells.keys[:] = kernels.UNKNOWN
        table.cells.control["version"] = FIRST_VERSION
        if table.cells.payload is not None:
            # frames read the empty slot like any other: no branch in the kernel
            table.cells.payload[kernels.EMPTY_SLOT] = BEYOND
        return table

    def __reduce__(self) -> tuple[object, ...]:
        """Pickle it for a process with the same descriptor."""
        return CellTable, (self.descriptor, self.n_slots)

    def close(self) -> None:
        """Free the memory in this process; other processes keep their mappings."""
        if self.descriptor >= 0:
            os.close(self.descriptor)  # the mapping is freed with the last array
            self.descriptor = -1

    @property
    def capacity(self) -> int:
        """Entries of a directory; half of them are used at most."""
        return int(self.cells.keys.shape[1])

    @property
    def version(self) -> int:
        """Number of the published directory."""
        return int(self.cells.control["version"])

    @property
    def revision(self) -> int:
        """Revision of the database for the published cells."""
        return int(self.cells.control["revisions"][self.version % BUFFERS])

    def join(self) -> int:
        """Become a reader; returns its row, or UsageError if none is free."""
        with _joining:
            free = np.flatnonzero(self.queue.pids == 0)
            if len(free):
                row = int(free[0])
                # before the pid: a row in use never shows the fields of its last session
                self._clear(row)
                sequence = self.queue.requests["sequence"]
                sequence[row] += sequence[row] % 2  # odd if the last session died while it wrote
                self.queue.pids[row] = os.getpid()
                return row
        raise UsageError(f"a table of cells has {MOST_READERS} readers at most: end one first")

    def leave(self, row: int) -> None:
        """Stop being a reader."""
        self._clear(row)
        self.queue.pids[row] = 0

    def release_dead(self) -> None:
        """Release the versions and sessions of dead readers; their rows stay in use."""
        pids = self.queue.pids
        # the rows stay in use: their owner frees them, and may be another process than the reader
        dead = [pid for pid in set(pids.tolist()) - {0} if not is_alive(pid)]  # one may own many
        if dead:
            for row in np.flatnonzero(np.isin(pids, dead)).tolist():
                # version 0: reads nothing, so the writer waits for no frame of this row
                self.cells.readers["version"][row] = 0
                self.queue.requests["prefetch"]["is_active"][row] = False

    def _clear(self, row: int) -> None:
        self.cells.readers["version"][row] = 0
        for name in REQUEST.names or ():
            if name != "sequence":
                self.queue.requests[name][row] = 0

    @contextmanager
    def reading(self) -> Iterator[int]:
        """Be a reader inside the block; yields its row."""
        row = self.join()
        try:
            yield row
        finally:
            self.leave(row)


def is_alive(pid: int) -> bool:
    """Whether a process runs; a zombie (ended, but not yet waited for) does not."""
    try:
        status = Path(f"/proc/{pid}/stat").read_text()
    except OSError:
        return False
    # the name before it is the process's own and may contain a parenthesis
    return status.rpartition(")")[2].split()[0] not in {"Z", "X"}


def anonymous_memory(name: str, size: int) -> int:
    """File descriptor of new anonymous memory, filled with zeros."""
    descriptor = os.memfd_create(name)
    try:
        os.truncate(descriptor, size)
    except OSError as error:
        os.close(descriptor)
        raise UsageError(
            f"this process may not have {size:,} bytes of shared memory ({error.strerror}): allow "
            "larger files (ulimit -f unlimited), or give a smaller budget of cells"
        ) from None
    return descriptor
