"""Feel a virtual environment too large for memory: haptic queries on an SQL database.

>>> import hapticdb
>>> env = hapticdb.open("car.db")                             # doctest: +SKIP
>>> shell = hapticdb.PointShell.from_file("wrench.stl")       # doctest: +SKIP
>>> env.touch(shell, pose).force                              # doctest: +SKIP
"""

from importlib import import_module
from typing import TYPE_CHECKING

from hapticdb import errors as errors

if TYPE_CHECKING:
    from hapticdb.batches.feeler import Feeler
    from hapticdb.batches.result import ClearanceBatch, TouchBatch
    from hapticdb.check import CheckReport, check_environment
    from hapticdb.difference import Difference, diff_environments
    from hapticdb.environment import Environment, create, open  # noqa: A004 - as in tarfile.open
    from hapticdb.errors import HapticDBError
    from hapticdb.extraction.disassembly.result import Disassembly
    from hapticdb.extraction.disassembly.run import disassemble
    from hapticdb.extraction.result import Extraction
    from hapticdb.extraction.run import extract
    from hapticdb.grid import Grid, GridOptions
    from hapticdb.ingest.files import FileReport, ImportOptions, import_files
    from hapticdb.ingest.upgrading import UpgradeReport, upgrade_environment
    from hapticdb.pointshell.shell import PointShell
    from hapticdb.pool import Pool
    from hapticdb.poses import read_poses, write_poses
    from hapticdb.proportions import Proportions, compare_proportions
    from hapticdb.query.cost_model import CostModel
    from hapticdb.query.frame import Query
    from hapticdb.query.law import DistanceField, TangentPlane
    from hapticdb.query.quantiles import QuantileVector
    from hapticdb.query.touches import Touch
    from hapticdb.realtime.coupling import Coupling
    from hapticdb.realtime.handle import Handle
    from hapticdb.realtime.report import Report
    from hapticdb.realtime.resident_cells import ResidentCells
    from hapticdb.realtime.session import Session
    from hapticdb.recording.file import Recording
    from hapticdb.recording.replay import Replayed, replay
    from hapticdb.store.base import Object
    from hapticdb.store.connect import (
        backup_environment,
        restore_environment,
    )
    from hapticdb.sweeps.result import Swept
    from hapticdb.sweeps.run import sweep
    from hapticdb.transfer import CopyReport, copy_environment
    from hapticdb.warm import warm_up

__all__ = [
    "CheckReport",
    "ClearanceBatch",
    "CopyReport",
    "CostModel",
    "Coupling",
    "Difference",
    "Disassembly",
    "DistanceField",
    "Environment",
    "Extraction",
    "Feeler",
    "FileReport",
    "Grid",
    "GridOptions",
    "Handle",
    "HapticDBError",
    "ImportOptions",
    "Object",
    "PointShell",
    "Pool",
    "Proportions",
    "QuantileVector",
    "Query",
    "Recording",
    "Replayed",
    "Report",
    "ResidentCells",
    "Session",
    "Swept",
    "TangentPlane",
    "Touch",
    "TouchBatch",
    "UpgradeReport",
    "backup_environment",
    "check_environment",
    "compare_proportions",
    "copy_environment",
    "create",
    "diff_environments",
    "disassemble",
    "extract",
    "import_files",
    "open",
    "read_poses",
    "replay",
    "restore_environment",
    "sweep",
    "upgrade_environment",
    "warm_up",
    "write_poses",
]
__version__ = "0.1.0"

_HOMES = {
    "batches.feeler": "Feeler",
    "batches.result": "ClearanceBatch TouchBatch",
    "check": "CheckReport check_environment",
    "difference": "Difference diff_environments",
    "environment": "Environment create open",
    "errors": "HapticDBError",
    "extraction.disassembly.result": "Disassembly",
    "extraction.disassembly.run": "disassemble",
    "extraction.result": "Extraction",
    "extraction.run": "extract",
    "query.law": "DistanceField TangentPlane",
    "grid": "Grid GridOptions",
    "ingest.files": "FileReport ImportOptions import_files",
    "ingest.upgrading": "UpgradeReport upgrade_environment",
    "pointshell.shell": "PointShell",
    "pool": "Pool",
    "poses": "read_poses write_poses",
    "proportions": "Proportions compare_proportions",
    "query.frame": "Query",
    "realtime.coupling": "Coupling",
    "realtime.handle": "Handle",
    "recording.file": "Recording",
    "recording.replay": "Replayed replay",
    "realtime.report": "Report",
    "realtime.resident_cells": "ResidentCells",
    "realtime.session": "Session",
    "sweeps.run": "sweep",
    "sweeps.result": "Swept",
    "query.cost_model": "CostModel",
    "query.quantiles": "QuantileVector",
    "store.base": "Object",
    "store.connect": "backup_environment restore_environment",
    "query.touches": "Touch",
    "transfer": "CopyReport copy_environment",
    "warm": "warm_up",
}
"""Modules of the public names, which are imported when the name is first used: a program pays for
what it uses, and ``hapticdb --help`` for nothing."""
_HOME_OF = {name: module for module, names in _HOMES.items() for name in names.split()}


def __getattr__(name: str) -> object:
    """Import a public name from its module."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value: object = getattr(import_module(f"hapticdb.{_HOME_OF[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
