"""Tree of sub-assemblies with a button for each part, or the hits of a search."""

import threading
from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from viser import GuiApi, GuiEvent

from hapticdb.errors import UsageError
from hapticdb.page import checks
from hapticdb.page.browser import Browser
from hapticdb.page.wording import note_html, plain_name, short_name

MOST_FOLDERS, MOST_BUTTONS = 60, 400
"""Greatest numbers of sub-assemblies and of parts in the tree, the outer ones first."""
LONGEST_SEARCH = 200
"""Greatest length of a search, characters."""
CHOSEN, HIDDEN = "✓ ", "○ "
"""Marks before the names of chosen and of hidden parts."""

Ids = tuple[int, ...]
Key = TypeVar("Key", int, str)


class PartTree:
    """Folders of sub-assemblies; `toggle` receives the ids of a pressed button.

    Its buttons are options of one group for each folder: one message of viser instead of one for
    each part.
    """

    def __init__(
        self, browser: Browser, gui: GuiApi, toggle: Callable[[Sequence[int]], None]
    ) -> None:
        self._browser, self._gui, self._toggle = browser, gui, toggle
        self._lock = threading.RLock()
        self._listed: object = None
        self._search = gui.add_text("Search", "", hint="Words of a name, in any order.")
        self._search.on_update(browser.guarded("viewer", self._searched))
        self._where = gui.add_html("")
        self._place = gui.add_folder("Parts")
        self._inside: Any = None
        self._groups: list[tuple[Any, dict[str, Ids]]] = []
        self.show()

    def show(self) -> None:
        """List the parts anew if names or search have changed, and mark the chosen and hidden."""
        search = self._search.value.strip()[:LONGEST_SEARCH]
        names = {i: obj.name for i, obj in self._browser.site.objects.items()}
        with self._lock:
            if self._listed != (names, search):
                self._listed, before, self._groups = (names, search), self._inside, []
                with self._place:
                    self._inside = self._gui.add_folder(None)
                n_listed = self._add_hits(names, search) if search else self._add_tree(names)
                if before is not None:
                    # after the new list is there
                    before.remove()
                more = "" if n_listed == len(names) else f"{n_listed:,} of "
                self._where.content = note_html(f"{more}{len(names):,} parts. ✓ chosen, ○ hidden")
            chosen, hidden = set(self._browser.chosen), self._browser.scene.hidden
            for group, rows in self._groups:
                labels = tuple(_marked(name, ids, chosen, hidden) for name, ids in rows.items())
                if group.options != labels:
                    group.options = labels

    def _add_hits(self, names: dict[int, str], search: str) -> int:
        paths = assemblies_of(names)
        found = found_ids(names, search)
        rows = [
            (f"{short_name(path)} ({len(paths[path]):,})", tuple(paths[path]))
            for path in found_ids({path: path for path in paths}, search)
        ]
        rows += [(short_name(names[i], 44), (i,)) for i in found]
        self._add_group(self._inside, rows[:60])
        return len(found)

    def _add_tree(self, names: dict[int, str]) -> int:
        assemblies = assemblies_of(names)
        paths = sorted(assemblies, key=lambda path: path.count("/"))[:MOST_FOLDERS]
        rows: dict[str, list[tuple[str, Ids]]] = {"": []}
        rows |= {path: [("all", tuple(assemblies[path]))] for path in paths}
        leaves = [(name.rpartition("/"), i) for i, name in names.items()]
        leaves.sort(key=lambda one: (one[0][0].count("/"), one[0][2]))
        leaves = [leaf for leaf in leaves if leaf[0][0] in rows][:MOST_BUTTONS]
        for (path, _, last), object_id in leaves:
            rows[path].append((short_name(last), (object_id,)))
        folders = {"": self._inside}
        for path in paths:
            above, _, last = path.rpartition("/")
            with folders[above]:
                label = f"{short_name(last)} ({len(assemblies[path]):,})"
                folders[path] = self._gui.add_folder(label, expand_by_default=False)
        for path, some in rows.items():
            self._add_group(folders[path], some)
        return len(leaves)

    def _add_group(self, folder: Any, rows: Sequence[tuple[str, Ids]]) -> None:  # noqa: ANN401 - viser's
        """Add the buttons of a folder; equal names get their ids."""
        labels: dict[str, Ids] = {}
        for name, ids in rows:
            labels[f"{name} [{ids[0]}]" if name in labels else name] = ids
        if not labels:
            return
        with folder:
            group = self._gui.add_button_group("", tuple(labels))
        group.on_click(self._browser.guarded("viewer", lambda event: self._press(event, labels)))
        self._groups.append((group, labels))

    def _press(self, event: GuiEvent[Any], labels: dict[str, Ids]) -> None:
        label = checks.text_of(event.target.value, 2048, "a part")
        if label not in labels:
            # with its marks; without them first, since a name may begin with one
            label = label.removeprefix(CHOSEN).removeprefix(HIDDEN)
        if label not in labels:
            raise UsageError("this part is there no longer: press another")
        self._toggle(labels[label])

    def _searched(self, event: GuiEvent[Any]) -> None:
        checks.text_of(event.target.value, LONGEST_SEARCH, "a search")
        self.show()


def _marked(name: str, ids: Ids, chosen: set[int], hidden: set[int]) -> str:
    marks = CHOSEN if chosen.issuperset(ids) else ""
    return plain_name(marks + (HIDDEN if hidden.issuperset(ids) else "") + name)


def assemblies_of(names: Mapping[int, str]) -> dict[str, list[int]]:
    """Ids of the objects below each sub-assembly, by its path; outer ones first."""
    found: dict[str, list[int]] = {}
    for object_id, name in sorted(names.items(), key=lambda item: (item[1], item[0])):
        end = name.find("/", 1)
        while end > 0:
            found.setdefault(name[:end], []).append(object_id)
            end = name.find("/", end + 1)
    return found


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
