"""Target of a set of machine code: sources, versions and processor level.

A set is a folder with a file for each entry of one group and a manifest: its target (digest of the
sources, numba, Python, level of processors), and a digest of each file.
"""

import hashlib
import json
import platform
import sys
from functools import cache
from pathlib import Path
from typing import NamedTuple

import llvmlite.binding
import numba
import numpy as np

from hapticdb.kernels._cache import sources_digest

BUILDING = "HAPTICDB_BUILDING"
"""Environment variable of a compiling process: folder of the set under construction."""

V3 = (
    "avx avx2 bmi bmi2 cx16 cx8 f16c fma fxsr lzcnt mmx movbe popcnt sahf sse sse2 sse3 sse4.1 "
    "sse4.2 ssse3 xsave"
)
LEVELS = {"x86_64": ("x86-64-v3", V3), "aarch64": ("generic", "fp-armv8 neon")}
"""Processor level of shipped sets: LLVM's name and features, by architecture.

More than x86-64-v3 gains nothing: a frame by the plane law takes 110.5 us with it and 110.3 with
AVX-512, by the distance law 474 and 487.
"""


GROUPS = "frames", "session", "triangles"
"""Groups of entries built together. Imports and queries need the first group only."""


def group_of(entry: str) -> str:
    """Group of an entry or a module, by its package: ``period.loop`` is in ``session``."""
    room = entry.partition(".")[0]
    if room == "triangles":
        return room
    return "session" if room in {"hand", "motion", "period", "resident"} else "frames"


class Level(NamedTuple):
    """A level of processors: LLVM's name of it, and its features, ``+avx,+avx2``."""

    cpu: str
    features: str


def level() -> Level:
    """Level of this processor: its architecture's of `LEVELS`, or else its own."""
    has = llvmlite.binding.get_host_cpu_features()
    cpu, words = LEVELS.get(platform.machine(), ("", ""))
    if cpu and all(has.get(word) for word in words.split()):
        return Level(cpu, ",".join(f"+{word}" for word in words.split()))
    return Level(llvmlite.binding.get_host_cpu_name(), has.flatten())


@cache
def built_for() -> dict[str, str]:
    """Target of this process: a set with an equal one fits."""
    cpu, features = level()
    return {
        "numba": numba.__version__,
        "numpy": np.__version__.rpartition(".")[0],
        "Python": sys.implementation.cache_tag or platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "processor": cpu,
        "features": features,
        "sources": sources_digest(Path(__file__).parent),
    }


@cache
def build() -> str:
    """Digest of the target, 16 hex digits; equal digests imply equal bits of results."""
    return hashlib.sha256(json.dumps(built_for()).encode()).hexdigest()[:16]


def manifest_of(folder: Path) -> dict[str, dict[str, str]]:
    """Manifest of a set: its target ``for`` and the digests of its ``entries``; empty for none."""
    try:
        read: dict[str, dict[str, str]] = json.loads((folder / "manifest.json").read_text())
        return read if {"for", "entries"} <= read.keys() else {}
    except (OSError, ValueError, AttributeError):
        return {}


def digest_of(code: bytes) -> str:
    """Digest of an entry's file in a manifest."""
    return hashlib.sha256(code).hexdigest()
