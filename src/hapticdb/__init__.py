"""Haptic queries on an SQL database: contact forces in environments too large for memory.

The nine names to begin with; `dir(hapticdb)` lists the others:

- import_files(url, files): files into an environment, made if it does not exist
- open(url): an environment; create(url, grid): an empty one
- Environment: objects(), find(), tool(), shell(), touch(), move(), remove(), clearance()
- PointShell: a tool; env.tool(file) makes it as the verbs and the page do
- read_poses(path): a path of a tool, (n, 4, 4), world_from_tool, metres
- sweep(env, shell, poses): first collisions on a path; extract(env, words): a removal path
- Session(url, shell, device): a haptic session in real time

Errors are in `hapticdb.errors`.

>>> import hapticdb
>>> env = hapticdb.open("car.db")                             # doctest: +SKIP
>>> env.touch(env.tool("spanner.stl"), pose).force             # doctest: +SKIP
"""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from hapticdb import errors as errors

if TYPE_CHECKING:
    from hapticdb.batches.batch_results import ClearanceBatch as ClearanceBatch
    from hapticdb.batches.batch_results import TouchBatch as TouchBatch
    from hapticdb.batches.batch_tool import BatchTool as BatchTool
    from hapticdb.check import CheckReport as CheckReport
    from hapticdb.check import check_environment as check_environment
    from hapticdb.clashes.clash_results import Clashes as Clashes
    from hapticdb.clashes.search import accept_clash as accept_clash
    from hapticdb.clashes.search import find_clashes as find_clashes
    from hapticdb.devices.handle import Handle as Handle
    from hapticdb.difference import Difference as Difference
    from hapticdb.difference import diff_environments as diff_environments
    from hapticdb.environment import Environment as Environment
    from hapticdb.environment import create as create
    from hapticdb.environment import open as open  # noqa: A004 - as in tarfile.open
    from hapticdb.exact.reach import Reached as Reached
    from hapticdb.exact.reach import reach as reach
    from hapticdb.exact.sweep import sweep as sweep
    from hapticdb.exact.swept import Swept as Swept
    from hapticdb.extraction.disassembly import Disassembly as Disassembly
    from hapticdb.extraction.disassembly import disassemble as disassemble
    from hapticdb.extraction.extraction_results import Extraction as Extraction
    from hapticdb.extraction.removal_search import extract as extract
    from hapticdb.grid import Grid as Grid
    from hapticdb.grid import GridOptions as GridOptions
    from hapticdb.ingest.files import FileReport as FileReport
    from hapticdb.ingest.files import ImportOptions as ImportOptions
    from hapticdb.ingest.files import import_files as import_files
    from hapticdb.machines.envelope import sweep_envelope as sweep_envelope
    from hapticdb.machines.machine import Machine as Machine
    from hapticdb.machines.machine_sweep import sweep_machine as sweep_machine
    from hapticdb.machines.reader import read_machine as read_machine
    from hapticdb.paper.cost_model import CostModel as CostModel
    from hapticdb.paper.quantiles import QuantileVector as QuantileVector
    from hapticdb.pointshell.shell import PointShell as PointShell
    from hapticdb.poses import read_poses as read_poses
    from hapticdb.poses import write_poses as write_poses
    from hapticdb.query.law import DistanceField as DistanceField
    from hapticdb.query.law import TangentPlane as TangentPlane
    from hapticdb.query.touches import Query as Query
    from hapticdb.query.touches import Touch as Touch
    from hapticdb.recording.file import Recording as Recording
    from hapticdb.session.coupling import Coupling as Coupling
    from hapticdb.session.prefetch.resident_cells import ResidentCells as ResidentCells
    from hapticdb.session.replay import Replayed as Replayed
    from hapticdb.session.replay import replay as replay
    from hapticdb.session.report import Report as Report
    from hapticdb.session.session import Session as Session
    from hapticdb.store.base import Object as Object
    from hapticdb.store.connect import backup_environment as backup_environment
    from hapticdb.transfer import CopyReport as CopyReport
    from hapticdb.transfer import copy_environment as copy_environment

__version__ = "0.1.0rc1"

_LINES = Path(__file__).read_text("utf-8").splitlines()
_WORDS = [line.split() for line in _LINES if line.startswith("    from hapticdb.")]
_HOME_OF = {words[3]: words[1] for words in _WORDS}
"""Modules of the public names, parsed from the imports above, the ones for type checkers. A module
is imported at the first use of its name."""
__all__ = [*sorted(_HOME_OF)]  # noqa: PLE0604 - they are strings


def __getattr__(name: str) -> object:
    """Import a public name from its module."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value: object = getattr(import_module(_HOME_OF[name]), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
