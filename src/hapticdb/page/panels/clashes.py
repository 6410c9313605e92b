"""The tab Clashes: pairs that meet or are near, shown one at a time, and accepted by editors."""

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from hapticdb.clashes.result import Clash, Clashes
from hapticdb.clashes.run import WITHIN, find_clashes
from hapticdb.environment import open as open_environment
from hapticdb.errors import UsageError
from hapticdb.exact.separation import CONTACT
from hapticdb.page import checks, colours
from hapticdb.page.browser import LEAST_SHOWN, Browser
from hapticdb.page.drawing import add_marks
from hapticdb.page.panels.working import Progress, Work
from hapticdb.page.widgets import put
from hapticdb.page.wording import note_html, rows_html, short_name
from hapticdb.units import length_text
from hapticdb.verdicts import REPORTED

if TYPE_CHECKING:
    from viser import GuiApi, GuiEvent

ALL, OPEN = "all", "all but accepted and gone"
STATUSES = (OPEN, ALL, "new", "changed", "same", "gone", "accepted", "not looked at")
"""Statuses by which the list is filtered."""
NOTHING = "choose from the list"
MOST_LISTED = 500
"""Lines of the list; the filters find the others. Larger: a browser opens it more slowly."""
LONGEST_TEXT = 200
"""Letters of a reason, and of words that are looked for."""


class ClashPanel:
    """Looks for clashes, lists and shows them; editors accept them."""

    def __init__(self, browser: Browser, gui: "GuiApi") -> None:
        self._browser = browser
        self._found: Clashes | None = None
        self._lines: dict[str, Clash] = {}
        self._one: Clash | None = None  # the chosen pair
        self._drawn: list[Any] = []
        guard = browser.guarded
        self._within, self._contact = (
            gui.add_number(f"{word}, mm", 1e3 * length, min=1e-6, max=1e6, step=1e-3)
            for word, length in (("Within", WITHIN), ("Contact", CONTACT))
        )
        look = gui.add_button("Look for clashes", hint="Measures pairs of parts that have changed.")
        look.on_click(guard("viewer", self._look))
        self._work = Work(browser, gui, "a search for clashes")
        self._kind = gui.add_dropdown("Kind", (ALL, *REPORTED))
        self._status = gui.add_dropdown("Status", STATUSES)
        self._words = gui.add_text("Words", "", hint="Parts of both names, in any order.")
        for one in (self._kind, self._status, self._words):
            one.on_update(guard("viewer", self._filter))
        self._where = gui.add_html("")
        self._list = gui.add_dropdown("Pairs", (NOTHING,), initial_value=NOTHING)
        self._list.on_update(guard("viewer", self._pick))
        self._what = gui.add_html("")
        self._act = gui.add_button_group("See", ("Show", "End"))
        self._act.on_click(guard("viewer", self._show_or_end))
        may_edit = browser.visitor.may("editor") and browser.site.edits is not None
        with gui.add_folder("Meant to be so", visible=may_edit):
            self._because = gui.add_text("Because", "", hint="Why it is meant to be so.")
            self._accept = gui.add_button_group("Pair", ("Accept", "Take back"))
            self._accept.on_click(guard("editor", self._accept_or_not))

    def _look(self, _: object) -> None:
        within, contact = (
            1e-3 * checks.number_of(entry.value, 1e-6, 1e6, "a length")
            for entry in (self._within, self._contact)
        )
        site, may_write = self._browser.site, self._browser.visitor.may("editor")
        url = site.request.urls.get("editor", site.url) if may_write else site.url

        def search(progress: Progress) -> Clashes:
            may_keep = may_write and site.edits is not None
            with open_environment(url, read_only=not may_keep) as env:
                return find_clashes(env, within=within, contact=contact, progress=progress)

        self._work.begin(search, self._show_found)

    def _show_found(self, found: Clashes) -> None:
        self._found = found
        counts = ", ".join(f"{n:,} {kind}" for kind, n in found.counts().items() if n)
        kept = "" if found.is_kept else " They are not kept: that takes an editor."
        within = length_text(found.within)
        self._work.said.content = note_html(f"Within {within}: {counts or 'no pair'}.{kept}")
        self._fill()

    def objects_changed(self) -> None:
        """Say that the list may be out of date."""
        if self._found is not None:
            self._work.said.content = note_html("Parts have changed since: look again.")

    def _filter(self, event: "GuiEvent[Any]") -> None:
        if event.client is not None:
            self._fill()

    def _fill(self) -> None:
        """List the pairs that the filters let pass, the gravest first."""
        kind = checks.choice_of(self._kind.value, (ALL, *REPORTED), "a kind")
        status = checks.choice_of(self._status.value, STATUSES, "a status")
        words = checks.text_of(self._words.value, LONGEST_TEXT, "words").casefold().split()
        pairs = self._found.pairs if self._found else ()
        chosen = [
            one
            for one in pairs
            if kind in {ALL, one.kind}
            and (status in {ALL, one.status} or (status == OPEN and one.is_open))
            and all(word in f"{one.a_name}\n{one.b_name}".casefold() for word in words)
        ]
        self._lines = {}
        for one in chosen[:MOST_LISTED]:
            names = " · ".join(short_name(name or "(gone)", 22) for name in one[2:4])
            said = one.status if one.is_left else f"{one.kind} {one.length_text()}"
            self._lines[f"{said}: {names} [{one.a}, {one.b}]"] = one
        listed = f", {MOST_LISTED:,} listed" if len(chosen) > MOST_LISTED else ""
        self._where.content = note_html(f"{len(chosen):,} of {len(pairs):,} pairs{listed}")
        self._list.options = (NOTHING, *self._lines)
        put(self._list, NOTHING)
        self._what.content, self._one = "", None

    def _pick(self, event: "GuiEvent[Any]") -> None:
        if event.client is not None and event.target.value != NOTHING:
            label = checks.choice_of(event.target.value, tuple(self._lines), "a pair")
            self._choose(self._lines[label])

    def _chosen(self) -> Clash:
        if self._one is None:
            raise UsageError("choose a pair first: look for clashes, then take one from the list")
        return self._one

    def _choose(self, one: Clash) -> None:
        self._one = one
        names = [short_name(name or "(gone)", 80) for name in one[2:4]]
        rows = [("Orange", names[0]), ("Blue", names[1]), ("Are", one.kind)]
        rows += [("By", one.length_text()), ("Status", one.status)]
        self._what.content = rows_html(rows + ([("Because", one.because)] if one.because else []))

    def _show_or_end(self, event: "GuiEvent[Any]") -> None:
        if checks.choice_of(event.target.value, ("Show", "End"), "what to see") == "End":
            self._end()
            facts = self._browser.site.facts
            self._browser.scene.fly_to(facts.bounds.mean(axis=0), 0.5 * facts.diagonal)
        else:
            self._show(self._chosen())

    def _show(self, one: Clash) -> None:
        """Bring the eye to a pair, and see through everything else."""
        browser = self._browser
        there = [browser.site.objects.get(i) for i in (one.a, one.b)]
        boxes = [obj.bounds for obj in there if obj is not None]
        if len(boxes) < 2:
            raise UsageError("one of the two is there no longer: look for clashes again")
        if one.place is None:
            places = np.stack([box.mean(axis=0) for box in boxes])
        else:
            places = np.array(one.place).reshape(2, 3)
        least = LEAST_SHOWN * browser.site.facts.diagonal
        radius = max(min(0.75 * float(np.linalg.norm(box[1] - box[0])) for box in boxes), least)
        self._end()
        browser.scene.spotlight(dict(zip((one.a, one.b), colours.PAIR, strict=True)))
        words = one.status if one.is_left else f"{one.kind} {one.length_text()}"
        self._drawn = add_marks(browser.client.scene, "/clash", places, words, 0.04 * radius)
        browser.scene.fly_to(places.mean(axis=0), radius)

    def _end(self) -> None:
        """See everything as before."""
        drawn, self._drawn = self._drawn, []
        for node in drawn:
            node.remove()
        self._browser.scene.spotlight({})

    def _accept_or_not(self, event: "GuiEvent[Any]") -> None:
        word = checks.choice_of(event.target.value, ("Accept", "Take back"), "a step")
        because = checks.text_of(self._because.value, LONGEST_TEXT, "a reason").strip()
        if word == "Accept" and not because:
            raise UsageError("say why the pair is accepted")
        one, edits = self._chosen(), self._browser.site.edits
        reason = because if word == "Accept" else None

        def done(said: str) -> None:
            self._browser.tell("Done", said, is_good=True)
            if self._found is not None:
                now = one._replace(status="accepted" if reason else "same", because=reason)
                told = tuple(now if old is one else old for old in self._found.pairs)
                self._found = replace(self._found, told=told, rest=self._found.rest.none())
                self._fill()
                self._choose(now)

        if edits is not None:
            edits.ask(
                self._browser.client.client_id,
                lambda own: own.accept(one.a, one.b, reason), done, self._browser.failed,
            )  # fmt: skip
