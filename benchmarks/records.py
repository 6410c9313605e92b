"""Results as JSON: what was measured, at which commit, on which machine, with which versions."""

import argparse
import json
import os
import platform
import re
import subprocess
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

PACKAGES = ("numpy", "numba", "apsw", "psycopg")
"""Whose versions a result names; hapticdb itself is named by its commit."""
ROOT = Path(__file__).parent.parent
GIT_S = 10.0
"""Seconds that git may take to name the commit; a larger value waits longer for a slow disk."""


def first_line(text: str | None) -> str:
    """First line of a script's docstring, for its help."""
    return (text or "").partition("\n")[0]


def asked(doc: str | None, quick: str) -> tuple[bool, Path]:
    """Whether a script runs with `--quick`, which its help explains; the folder of its results."""
    parser = argparse.ArgumentParser(description=first_line(doc))
    parser.add_argument("--quick", action="store_true", help=quick)
    is_quick = parser.parse_args().quick
    return is_quick, Path("results-quick" if is_quick else "results")


def data(name: str) -> Path | None:
    """File in the folder that HAPTICDB_TEST_DATA names, if it is there."""
    file = Path(os.environ.get("HAPTICDB_TEST_DATA", ""), name)
    return file if file.is_file() else None


def _git(*words: str) -> str:
    done = subprocess.run(
        ["git", "-C", str(ROOT), *words], capture_output=True, text=True, check=True, timeout=GIT_S
    )
    return done.stdout.strip()


def conditions() -> dict[str, Any]:
    """What every record says first: commit, machine and versions.

    Changed results and pages alone make no commit dirty.
    """
    is_dirty = bool(_git("status", "--porcelain", "--", "src", "benchmarks"))
    return {
        "commit": _git("describe", "--always") + "-dirty" * is_dirty,
        "machine": machine(),
        "versions": {name: version(name) for name in PACKAGES},
    }


def result(
    name: str, cells: Sequence[Mapping[str, Any]], inputs: Mapping[str, Any]
) -> dict[str, Any]:
    """One experiment as its file holds it."""
    about = {"inputs": dict(inputs), "cells": list(cells)}
    return {"name": name} | conditions() | about


def write(folder: Path, results: Mapping[str, Mapping[str, Any]]) -> None:
    """Write each result to `NAME.json`; lists of numbers or words stand on one line."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, found in results.items():
        text = json.dumps(found, indent=1, default=float)
        text = re.sub(
            r"\[\s+([^\[\]{}]*?)\s+\]", lambda m: "[" + re.sub(r"\s*\n\s*", " ", m[1]) + "]", text
        )
        (folder / f"{name}.json").write_text(f"{text}\n")


def read(folder: Path) -> dict[str, dict[str, Any]]:
    """All results in a folder, by name."""
    return {path.stem: json.loads(path.read_text()) for path in sorted(folder.glob("*.json"))}


def machine() -> dict[str, Any]:
    """Processor, memory and system. It names neither the machine nor its owner."""
    found = re.search(r"model name\s*:\s*(.+)", Path("/proc/cpuinfo").read_text())
    return {
        "processor": found[1].strip() if found else platform.processor(),
        "processors": os.cpu_count(),
        "memory_gib": round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "python": platform.python_version(),
    }
