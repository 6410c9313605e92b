"""Lookup of sets of machine code: shipped with the package, or built on this machine.

A wheel has sets for the processors of `_machine_code.LEVELS`. On other targets all entries of a
group are compiled once into the user's cache, with one line on stderr giving the reason. A set is
as trusted as the package's sources, or as the cache folder.
"""

import sys
from functools import cache
from pathlib import Path

from hapticdb.kernels._cache import cache_folder
from hapticdb.kernels._machine_code import build, built_for, digest_of, group_of, manifest_of

SHIPPED = Path(__file__).with_name("_machine")
"""Folder of the shipped sets, each under its group's name."""
building: set[str] = set()
"""Groups that this process is compiling now."""


def code_of(entry: str) -> bytes | None:
    """Machine code of an entry, by its name in `_jit.ENTRIES`; None if no set has it."""
    found = fitting_set(group_of(entry))
    if found is None:
        return None
    folder, entries = found
    try:
        code = (folder / entry).read_bytes()
    except OSError:
        return None
    return code if digest_of(code) == entries.get(entry) else None


@cache
def fitting_set(group: str) -> tuple[Path, dict[str, str]] | None:
    """Folder of a group's set for this target, and digests of its files; built if there is none.

    None if the build fails: then each entry is compiled at its first call.
    """
    return _read(SHIPPED / group) or _read(own_set(group)) or _built(group)


def _read(folder: Path) -> tuple[Path, dict[str, str]] | None:
    """A set and digests of its files; None if it does not fit here."""
    manifest = manifest_of(folder)
    return (folder, manifest["entries"]) if manifest.get("for") == built_for() else None


def _built(group: str) -> tuple[Path, dict[str, str]] | None:
    """The set of this machine, built now and announced on stderr."""
    from hapticdb.kernels import _building  # noqa: PLC0415 - where it is not needed, nobody waits

    sys.stderr.write(
        f"hapticdb: compiling kernels ({group}), once on this machine: about 10 s on two "
        f"processors ({_reason(manifest_of(SHIPPED / group).get('for'), built_for())})\n"
    )
    sys.stderr.flush()
    building.add(group)
    try:
        _building.build_set(own_set(group), group)
    except OSError as error:
        sys.stderr.write(f"hapticdb: each kernel is compiled when it is first called: {error}\n")
        return None
    finally:
        building.discard(group)
    return _read(own_set(group))


def own_set(group: str) -> Path:
    """Folder of a group's set built on this machine."""
    return cache_folder() / f"kernels-{build()}-{group}"


def _reason(found: dict[str, str] | None, wanted: dict[str, str]) -> str:
    """Reason for rejecting a shipped set."""
    if found is None:
        return "none came with this copy"
    for key, here in wanted.items():
        if found.get(key) != here:
            if key in {"sources", "features"}:
                return f"those that came are for other {key}"
            return f"those that came are for {key} {found.get(key)}, here is {here}"
    return "those that came are damaged"
