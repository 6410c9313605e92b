"""Names of objects as a tree of sub-assemblies, and a search over them."""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass
class Branch:
    """A sub-assembly: an element of paths, with all that lies below it.

    name, path : both '' for the whole environment; branches, ids : sub-assemblies and objects
    directly in it, by name; count : of all objects below it.
    """

    name: str
    path: str
    branches: list["Branch"] = field(default_factory=list)
    ids: list[int] = field(default_factory=list)
    count: int = 0

    def all_ids(self) -> list[int]:
        """Ids of all objects below it, at any depth."""
        return [*self.ids, *(i for branch in self.branches for i in branch.all_ids())]


def tree_of(names: Mapping[int, str]) -> Branch:
    """Sub-assemblies of the objects with these names, whose elements are joined by '/'."""
    root = Branch("", "")
    known = {"": root}
    for object_id, name in sorted(names.items(), key=lambda item: (item[1], item[0])):
        above = _branch(known, name.rpartition("/")[0])
        above.ids.append(object_id)
        while above.path:
            above.count += 1
            above = known[above.path.rpartition("/")[0]]
        root.count += 1
    return root


def _branch(known: dict[str, Branch], path: str) -> Branch:
    """The branch of a path; makes it, and those above it, where there is none yet."""
    missing = []
    while path not in known:
        missing.append(path)
        path = path.rpartition("/")[0]
    branch = known[path]
    for below in reversed(missing):
        known[below] = Branch(below.rpartition("/")[2], below)
        branch.branches.append(known[below])
        branch = known[below]
    return branch


def found_ids(names: Mapping[int, str], text: str) -> list[int]:
    """Ids of the names that hold each word of a text, in any order and whatever the case.

    First those whose last element begins with the text, then those whose last element has a word of
    it, then the rest; by name within each.
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
