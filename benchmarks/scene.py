"""Scene and settings that the benchmarks of frames and imports share."""

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from hapticdb import Environment, PointShell
from hapticdb.sample import SampleFiles
from hapticdb.store.base import Layout


@dataclass(frozen=True)
class BenchScene:
    """The sample car in both layouts, a tool's shell, and its poses."""

    files: SampleFiles
    environments: dict[Layout, Environment]
    shell: PointShell
    poses: list[NDArray[np.float64]]


def is_measuring(config: pytest.Config) -> bool:
    """Whether times are measured; otherwise the benchmarks run once, as tests."""
    enabled = config.getoption("benchmark_enable") or not config.getoption("benchmark_disable")
    return bool(enabled)
