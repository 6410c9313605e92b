"""The set of machine code that fits here: it comes with the package, or is built on this machine.

A wheel has one for processors of `_machine_code.LEVELS`. Where it does not fit, all entries are
compiled once into the user's cache, and a line says why. A set is as trusted as the sources beside
it, or as the cache's folder.
"""

import sys
from functools import cache
from pathlib import Path

from hapticdb.kernels._cache import cache_folder
from hapticdb.kernels._machine_code import build, built_for, digest_of, manifest_of

SHIPPED = Path(__file__).with_name("_machine")
"""Folder of the set that comes with the package."""


def code_of(entry: str) -> bytes | None:
    """Machine code of an entry, by its name in `_jit.SIGNATURES`; None if no set has it."""
    found = fitting_set()
    if found is None:
        return None
    folder, entries = found
    try:
        code = (folder / entry).read_bytes()
    except OSError:
        return None
    return code if digest_of(code) == entries.get(entry) else None


@cache
def fitting_set() -> tuple[Path, dict[str, str]] | None:
    """Folder of the set that fits here, and digests of its files; it is built if there is none.

    None if that fails: then each entry is compiled when it is first called.
    """
    return _read(SHIPPED) or _read(own_set()) or _built()


def _read(folder: Path) -> tuple[Path, dict[str, str]] | None:
    """A set and digests of its files; None if it does not fit here."""
    manifest = manifest_of(folder)
    return (folder, manifest["entries"]) if manifest.get("for") == built_for() else None


def _built() -> tuple[Path, dict[str, str]] | None:
    """The set of this machine, built now, with a line that says so."""
    from hapticdb.kernels import _building  # noqa: PLC0415 - where it is not needed, nobody waits

    sys.stderr.write(
        "hapticdb: compiling kernels, once on this machine: about half a minute on two processors "
        f"({_reason(manifest_of(SHIPPED).get('for'), built_for())})\n"
    )
    sys.stderr.flush()
    try:
        _building.build_set(own_set())
    except OSError as error:
        sys.stderr.write(f"hapticdb: each kernel is compiled when it is first called: {error}\n")
        return None
    return _read(own_set())


def own_set() -> Path:
    """Folder of the set that this machine builds."""
    return cache_folder() / f"kernels-{build()}"


def _reason(found: dict[str, str] | None, wanted: dict[str, str]) -> str:
    """Why the set that came with the package does not do."""
    if found is None:
        return "none came with this copy"
    for key, here in wanted.items():
        if found.get(key) != here:
            if key in {"sources", "features"}:
                return f"those that came are for other {key}"
            return f"those that came are for {key} {found.get(key)}, here is {here}"
    return "those that came are damaged"
