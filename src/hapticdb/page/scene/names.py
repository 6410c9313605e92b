"""Object names: sub-assemblies and search."""

from collections.abc import Mapping
from typing import TypeVar


def assemblies_of(names: Mapping[int, str]) -> dict[str, list[int]]:
    """Ids of the objects below each sub-assembly, by its path; outer ones first."""
    found: dict[str, list[int]] = {}
    for object_id, name in sorted(names.items(), key=lambda item: (item[1], item[0])):
        end = name.find("/", 1)
        while end > 0:
            found.setdefault(name[:end], []).append(object_id)
            end = name.find("/", end + 1)
    return found


Key = TypeVar("Key", int, str)


def found_ids(names: Mapping[Key, str], text: str) -> list[Key]:
    """Keys of the names with each word of a text, in any order and case.

    First those with the text at the start of their last element, then those with a word of it in
    their last element, then the rest; by name within each.
    """
    words = text.casefold().split()
    whole = " ".join(words)
    found = []
    for object_id, given in names.items():
        name = given.casefold()
        if words and all(word in name for word in words):
            last = name.rpartition("/")[2]
            rank = 0 if last.startswith(whole) else 1 if any(w in last for w in words) else 2
            found.append((rank, name, object_id))
    return [object_id for _, _, object_id in sorted(found)]
