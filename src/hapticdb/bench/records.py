"""Results as JSON: what was measured, at which commit, machine, versions and inputs."""

import json
import os
import platform
import re
import subprocess
from collections.abc import Mapping, Sequence
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from hapticdb.bench.measure import Cell
from hapticdb.bench.workload import PERCENTILES, POINTS, RADIUS_VOXELS, SEED, WINDOW
from hapticdb.errors import FileError

PACKAGES = ("numpy", "numba", "apsw", "psycopg")
"""Whose versions a result names; hapticdb itself is named by its commit."""
ROOT = Path(__file__).parents[3]
"""The clone, where hapticdb runs from one."""
GIT_S = 10.0
"""Seconds that git may take to name the commit; a larger value waits longer for a slow disk."""
INPUTS: Mapping[str, Any] = {
    "sphere": f"{POINTS} points spread evenly over a sphere, radius {RADIUS_VOXELS:g} voxels",
    "slide": "poses that slide the shell over the largest objects, from above",
    "random": f"poses turned at random, near voxels drawn evenly over the index, seed {SEED}",
    "recorded": "the recorded path, with the tool that belongs to it",
    "regions": (
        f"share of occupied voxels in windows of {WINDOW}^3 around drawn surface voxels: its "
        + ", ".join(f"{p}th percentile ({name})" for name, p in PERCENTILES.items())
    ),
}


def result(
    name: str,
    cells: Sequence[Cell],
    *,
    inputs: Mapping[str, Any] = INPUTS,
    notes: Sequence[str] = (),
) -> dict[str, Any]:
    """One experiment as its file holds it."""
    return {
        "name": name,
        "commit": commit(),
        "machine": machine(),
        "versions": versions(),
        "inputs": dict(inputs),
        "notes": list(notes),
        "cells": list(cells),
    }


def make_folder(folder: Path) -> None:
    """Make a folder for results before any measurement; FileError when it cannot be written."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
        (folder / ".tried").touch()
        (folder / ".tried").unlink()
    except OSError as error:
        raise FileError(f"{folder} cannot be written: {error.strerror}") from error


def write(folder: Path, results: Mapping[str, Mapping[str, Any]]) -> None:
    """Write each result to `NAME.json`, whole or not at all."""
    make_folder(folder)
    try:
        for name, found in results.items():
            unfinished = folder / f".{name}.json.new"
            text = json.dumps(found, indent=1, default=float)
            # a list of numbers or words on one line each: half as long, and still to be read
            text = re.sub(r"\[\s+([^\[\]{}]*?)\s+\]", _on_one_line, text)
            unfinished.write_text(f"{text}\n")
            unfinished.replace(folder / f"{name}.json")
    except OSError as error:
        raise FileError(f"{folder} cannot be written: {error.strerror}") from error


def _on_one_line(found: "re.Match[str]") -> str:
    inside = re.sub(r"\s*\n\s*", " ", found[1])
    return f"[{inside}]"


def read(folder: Path) -> dict[str, dict[str, Any]]:
    """All results in a folder, by name."""
    found = {}
    for path in sorted(folder.glob("*.json")):
        try:
            loaded = json.loads(path.read_text())
        except (OSError, ValueError) as error:
            raise FileError(f"{path} is no result of an experiment: {error}") from error
        if isinstance(loaded, dict) and isinstance(loaded.get("cells"), list):
            found[path.stem] = loaded
    return found


def machine() -> dict[str, Any]:
    """Processor, memory and system. It names neither the machine nor its owner."""
    return {
        "processor": _processor(),
        "processors": os.cpu_count(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
    }


def _processor() -> str:
    try:
        text = Path("/proc/cpuinfo").read_text()
    except OSError:
        return platform.processor()
    found = re.search(r"model name\s*:\s*(.+)", text)
    return found[1].strip() if found else platform.processor()


def commit(root: Path = ROOT) -> str:
    """Commit that runs, with ``-dirty`` where files differ from it; else hapticdb's version.

    root : folder that holds `.git` when hapticdb runs from a clone. An installed package has none.
    """
    if (root / ".git").exists() and (root / "src" / "hapticdb").is_dir():
        asked = ["git", "-C", str(root), "describe", "--always", "--dirty"]
        try:
            done = subprocess.run(  # noqa: S603 - fixed words
                asked, capture_output=True, text=True, check=True, timeout=GIT_S
            )
        except (OSError, subprocess.SubprocessError):
            pass
        else:
            return done.stdout.strip()
    return f"unknown, version {version('hapticdb')}"


def conditions() -> dict[str, Any]:
    """What every record says first: commit, machine and versions."""
    return {"commit": commit(), "machine": machine(), "versions": versions()}


def versions() -> dict[str, str]:
    """Versions of the packages that take part; those that are not installed are left out."""
    found = {}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
