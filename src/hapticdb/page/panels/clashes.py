"""Tab Clashes: groups of pairs, their display, acceptances and rules."""

from typing import Any

import numpy as np
from viser import GuiApi, GuiEvent

from hapticdb.clashes.clash_results import Clash, Clashes, Shown, rule_for
from hapticdb.clashes.groups import Group, groups_of
from hapticdb.clashes.rules import rule_text
from hapticdb.clashes.search import WITHIN, find_clashes
from hapticdb.environment import open as open_environment
from hapticdb.errors import UsageError
from hapticdb.exact.separation import CONTACT
from hapticdb.page import checks, colours
from hapticdb.page.browser import LEAST_SHOWN, Browser, put
from hapticdb.page.drawing import add_marks
from hapticdb.page.panels.jobs import PanelJob, Progress
from hapticdb.page.wording import note_html, rows_html, short_name
from hapticdb.units import length_text
from hapticdb.verdicts import REPORTED

ALL, OPEN = "all", "all but accepted, meant and gone"
STATUSES = (OPEN, ALL, "new", "changed", "same", "gone", "accepted", "meant", "not looked at")
"""Filter of the list by status."""
NOTHING = "choose from the list"
SEE = ("Show", "Next", "End")
"""Actions: show the chosen pair, show the next one of its group, show everything."""
MOST_LISTED = 500
"""Greatest number of groups in the list. Larger: slower to open in a browser."""
LONGEST_TEXT = 400
"""Greatest length of a reason, a rule, and the filter's words, characters."""


class ClashPanel:
    """Search for clashes, list of groups, and, for editors, acceptances and rules."""

    def __init__(self, browser: Browser, gui: GuiApi) -> None:
        self._browser = browser
        self._found: Clashes | None = None
        self._groups: list[Group] = []
        self._lines: dict[str, Group] = {}
        self._group: Group | None = None  # the chosen one
        self._number = 0  # of its chosen pair
        self._drawn: list[Any] = []
        guard = browser.guarded
        self._within, self._contact = (
            gui.add_number(f"{word}, mm", 1e3 * length, min=1e-6, max=1e6, step=1e-3)
            for word, length in (("Within", WITHIN), ("Contact", CONTACT))
        )
        button = gui.add_button(
            "Look for clashes", hint="Measures pairs of parts that have changed."
        )
        button.on_click(guard("viewer", self._search))
        self._work = PanelJob(browser, gui, "a search for clashes", "pairs")
        self._kind = gui.add_dropdown("Kind", (ALL, *REPORTED))
        self._status = gui.add_dropdown("Status", STATUSES)
        self._words = gui.add_text("Words", "", hint="Parts of both names, in any order.")
        for one in (self._kind, self._status, self._words):
            one.on_update(guard("viewer", self._filter))
        self._where = gui.add_html("")
        self._list = gui.add_dropdown("Groups", (NOTHING,), initial_value=NOTHING)
        self._list.on_update(guard("viewer", self._pick))
        self._what = gui.add_html("")
        self._act = gui.add_button_group("See", SEE)
        self._act.on_click(guard("viewer", self._see))
        may_edit = browser.visitor.may("editor") and browser.site.edits is not None
        with gui.add_folder("Meant to be so", visible=may_edit):
            self._because = gui.add_text("Because", "", hint="Why it is meant to be so.")
            self._accept = gui.add_button_group("Group", ("Accept", "Take back"))
            self._accept.on_click(guard("editor", self._accept_or_not))
            self._rule = gui.add_text("Rule", "", hint="Written for the chosen pair: widen it.")
            gui.add_button("Add rule").on_click(guard("editor", self._add_rule))
        self._rules = gui.add_html("")

    def _lengths(self) -> list[float]:
        """Greatest distance of a pair, and contact tolerance, metres."""
        return [
            1e-3 * checks.number_of(entry.value, 1e-6, 1e6, "a length")
            for entry in (self._within, self._contact)
        ]

    def _search(self, _: object) -> None:
        within, contact = self._lengths()
        site, may_write = self._browser.site, self._browser.visitor.may("editor")
        url = site.request.urls.get("editor", site.url) if may_write else site.url

        def search(progress: Progress) -> tuple[Clashes, list[Group]]:
            may_keep = may_write and site.edits is not None
            with open_environment(url, read_only=not may_keep) as env:
                found = find_clashes(env, within=within, contact=contact, progress=progress)
                return found, groups_of(env.store, found.pairs)

        self._work.begin(search, self._show_found)

    def _show_found(self, answer: tuple[Clashes, list[Group]]) -> None:
        found, groups = answer
        gone = [one for one in found.pairs if one.status == "gone" or one.is_unmeasured]
        self._found = found
        self._groups = [*groups, *(Group("", one.kind, None, (one,)) for one in gone)]
        self._rules.content = rows_html((rule_text(one.rule), str(one)) for one in found.reach())
        counts = ", ".join(f"{n:,} {kind}" for kind, n in found.counts().items() if n)
        kept = "" if found.is_kept else " They are not kept: that takes an editor."
        within = length_text(found.within)
        self._work.said.content = note_html(f"Within {within}: {counts or 'no pair'}.{kept}")
        self._fill()

    def objects_changed(self) -> None:
        """Report that the list may be out of date."""
        if self._found is not None:
            self._work.said.content = note_html("Parts have changed since: look again.")

    def _filter(self, event: GuiEvent[Any]) -> None:
        if event.client is not None:
            self._fill()

    def _fill(self) -> None:
        """List the groups that pass the filters."""
        kind = checks.choice_of(self._kind.value, (ALL, *REPORTED), "a kind")
        status = checks.choice_of(self._status.value, STATUSES, "a status")
        words = checks.text_of(self._words.value, LONGEST_TEXT, "words").casefold().split()
        chosen = [
            group
            for group in self._groups
            if kind in {ALL, group.kind}
            and any(
                (status in {ALL, one.status} or (status == OPEN and one.is_open))
                and all(word in f"{one.a_name}\n{one.b_name}".casefold() for word in words)
                for one in group.pairs
            )
        ]
        self._lines = {}
        for group in chosen[:MOST_LISTED]:
            (a, b), title = group.pairs[0][:2], short_name(group.title(), 44)
            said = f"{group.kind} {group.length_text()}"
            self._lines[f"{said}: {title} [{group.id or f'{a}, {b}'}]"] = group
        listed = f", {MOST_LISTED:,} listed" if len(chosen) > MOST_LISTED else ""
        self._where.content = note_html(f"{len(chosen):,} of {len(self._groups):,} groups{listed}")
        self._list.options = (NOTHING, *self._lines)
        put(self._list, NOTHING)
        self._what.content, self._group = "", None

    def _pick(self, event: GuiEvent[Any]) -> None:
        if event.client is not None and event.target.value != NOTHING:
            label = checks.choice_of(event.target.value, tuple(self._lines), "a group")
            self._choose(self._lines[label], 0)

    def _chosen(self) -> Group:
        if self._group is None:
            raise UsageError("choose a group first: look for clashes, then take one from the list")
        return self._group

    def _choose(self, group: Group, number: int) -> None:
        """Select a pair of a group, and show its properties."""
        self._group, self._number = group, number % len(group.pairs)
        one = group.pairs[self._number]
        names = [short_name(name or "(gone)", 80) for name in one[2:4]]
        rows = [("Orange", names[0]), ("Blue", names[1]), ("Are", one.kind)]
        rows += [("By", one.length_text()), ("Status", one.status)]
        if len(group.pairs) > 1:
            rows += [("Pair", f"{self._number + 1} of {len(group.pairs):,}: {group.status()}")]
        self._what.content = rows_html(rows + ([("Because", one.because)] if one.because else []))
        put(self._rule, rule_for(one))

    def _see(self, event: GuiEvent[Any]) -> None:
        step = checks.choice_of(event.target.value, SEE, "what to see")
        if step == "End":
            self._end()
            facts = self._browser.site.facts
            self._browser.scene.fly_to(facts.bounds.mean(axis=0), 0.5 * facts.diagonal)
            return
        group = self._chosen()
        if step == "Next":
            self._choose(group, self._number + 1)
        self._show(group.pairs[self._number])

    def _show(self, one: Clash) -> None:
        """Move the camera to a pair, and fade all other objects."""
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
        browser.parts.choose((one.a, one.b))  # the link of the view opens with this pair
        browser.scene.spotlight(dict(zip((one.a, one.b), colours.PAIR, strict=True)))
        words = one.status if one.is_unmeasured else f"{one.kind} {one.length_text()}"
        self._drawn = add_marks(browser.client.scene, "/clash", places, words, 0.04 * radius)
        browser.scene.fly_to(places.mean(axis=0), radius)

    def _end(self) -> None:
        """Remove the marks, and end the fading."""
        drawn, self._drawn = self._drawn, []
        for node in drawn:
            node.remove()
        self._browser.scene.spotlight({})

    def _accept_or_not(self, event: GuiEvent[Any]) -> None:
        word = checks.choice_of(event.target.value, ("Accept", "Take back"), "a step")
        because = checks.text_of(self._because.value, LONGEST_TEXT, "a reason").strip()
        if word == "Accept" and not because:
            raise UsageError("say why the pair is accepted")
        group, found = self._chosen(), self._found
        reason = because if word == "Accept" else None

        def done() -> None:
            status: Shown = "accepted" if reason else "same"
            pairs = [one._replace(status=status, because=reason) for one in group.pairs]
            now = group._replace(pairs=tuple(pairs))
            self._groups = [now if old is group else old for old in self._groups]
            self._fill()
            self._choose(now, 0)

        if found is not None:
            self._browser.edit(lambda own: own.accept(group, found.known, reason), done)

    def _add_rule(self, _: object) -> None:
        text = checks.text_of(self._rule.value, LONGEST_TEXT, "a rule")
        within = self._lengths()[0]
        self._browser.edit(lambda own: own.add_rule(text, within))
