"""Contacts of many poses as one table, in a Parquet or .npz file, written atomically."""

import importlib.util
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from hapticdb.cli.emit import new_file
from hapticdb.cli.schema import WRENCH
from hapticdb.errors import MissingExtraError, UsageError, pip_line

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hapticdb.batches.result import TouchBatch

    Columns = dict[str, NDArray[np.generic]]

OPTION = "--out"


def columns_of(first: int, felt: "TouchBatch") -> "Columns":
    """Columns of a batch from pose `first` on; `revision` is the environment's in the batch."""
    import numpy as np

    wrenches = [*felt.forces.T, *felt.torques.T]
    return {
        "pose": np.arange(first, first + len(felt)),
        **{name: np.ascontiguousarray(one) for name, one in zip(WRENCH, wrenches, strict=True)},
        "hits": felt.hits,
        "contacts": felt.n_contacts,
        "deepest_m": felt.deepest,
        "revision": np.full(len(felt), felt.revision),
    }


@contextmanager
def open_felt(target: Path) -> "Iterator[Callable[[Columns], None]]":
    """Open a new file, Parquet or .npz by its suffix; yields the function for adding rows."""
    if target.suffix not in {".parquet", ".npz"}:
        raise UsageError(f"{OPTION} '{target}': give a name that ends with .parquet or .npz")
    if target.suffix == ".parquet" and importlib.util.find_spec("pyarrow") is None:
        raise MissingExtraError(
            f"{OPTION} '{target}' needs pyarrow: install it with {pip_line('parquet')}, or give a "
            "name that ends with .npz"
        )
    with new_file(target, OPTION) as part:
        yield from _row_groups(part) if target.suffix == ".parquet" else _arrays(part)


def _row_groups(path: Path) -> "Iterator[Callable[[Columns], None]]":
    """Function for adding rows to a Parquet file: each piece is written at once."""
    import pyarrow as pa
    from pyarrow import parquet

    with ExitStack() as opened:
        writers: list[parquet.ParquetWriter] = []

        def write(columns: "Columns") -> None:
            table = pa.table(columns)
            if not writers:
                writers.append(opened.enter_context(parquet.ParquetWriter(path, table.schema)))
            writers[0].write_table(table)

        yield write


def _arrays(path: Path) -> "Iterator[Callable[[Columns], None]]":
    """Function for adding rows to a .npz file: pieces stay in memory until the end."""
    import numpy as np

    pieces: list[Columns] = []
    yield pieces.append
    whole = {name: np.concatenate([one[name] for one in pieces]) for name in pieces[0]}
    with path.open("wb") as file:
        np.savez(file, **whole)  # type: ignore[arg-type]
