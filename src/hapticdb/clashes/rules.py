"""Rules: meant, separate and ignored pairs, by the words of their objects.

Rules change the report, not the measurement; only ignored pairs skip the narrow phase. The first
rule to reach a pair decides.
"""

import re
import tomllib
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import FileError, ObjectNotFoundError, UsageError
from hapticdb.store.base import Object, Store
from hapticdb.store.finding import Listing, checked_words
from hapticdb.store.pairs import Rule, Says
from hapticdb.units import length_of, length_text
from hapticdb.verdicts import REPORTED, Kind

MEANT = (Kind.OVERLAPPING, Kind.TOUCHING)
"""Default kinds of a rule."""
MEASURED = tuple(kind for kind in REPORTED if kind != Kind.TOO_NEAR)
"""Kinds for rules."""
FORM = (
    "give 'ONE in OTHER: overlap up to 0.3 mm is meant', 'ONE and OTHER: keep 2 mm apart' or "
    "'ONE and OTHER: ignore', and if wanted 'because REASON' after it"
)
LONGEST = 2000
"""Characters of a rule: the time of `GRAMMAR` grows with their square, to 30 ms."""
GRAMMAR = re.compile(
    r"('[^']+'|.+?) (?:in|and) ('[^']+'|.+?): *(?:(?P<kinds>[^:]+?)(?: up to (?P<depth>[^:]+?))?"
    r" is meant|keep (?P<apart>[^:]+?) apart|ignore)(?: because (?P<because>.+))?"
)


def parse_rule(text: str, place: str = "") -> Rule:
    """Rule of a text in one of the forms of `FORM`; UsageError with the place."""
    place = place or f"rule {text[:200]!r}"
    if len(text) > LONGEST:
        raise UsageError(f"{place}: {len(text):,} characters: give {LONGEST:,} at most")
    found = GRAMMAR.fullmatch(text.strip())
    if found is None or not text.isprintable():
        raise UsageError(f"{place}: {FORM}")
    one, other = (re.sub("^'([^']+)'$", r"\1", found[n]) for n in (1, 2))
    named = [kind.strip() for kind in found["kinds"].split(",")] if found["kinds"] else []
    kinds = [one for kind in named for one in (MEANT if kind == "overlap" else (kind,))]
    if unknown := [kind for kind in kinds if kind not in MEASURED]:
        known = ", ".join(sorted(MEASURED))
        raise UsageError(f"{place}: {unknown[0]!r}: give 'overlap', or kinds: {known}")
    says: Says = "meant" if kinds else "apart" if found["apart"] else "ignore"
    length = None
    if said := found["depth"] or found["apart"]:
        try:
            length = length_of(said, "mm")
        except UsageError as error:
            raise UsageError(f"{place}: {error}") from None
        if not length > 0.0:
            raise UsageError(f"{place}: {said!r}: give a length above 0")
    return Rule(one, other, says, tuple(map(Kind, kinds)), length, found["because"] or "")


def read_rules(path: str | Path) -> list[Rule]:
    """Rules of a TOML file, ``rules = ['...', '...']``, in their order."""
    try:
        content = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise FileError(f"{path} is no TOML: {error}") from error
    texts = content.pop("rules", [])
    if content or not isinstance(texts, list) or not all(isinstance(one, str) for one in texts):
        wrong = f"unknown key {next(iter(content))!r}" if content else "rules is no list of texts"
        raise UsageError(f"{path}: {wrong}: give rules = ['...', '...']")
    return [parse_rule(text, f"{path}, rule {n}") for n, text in enumerate(texts, start=1)]


def add_rules(
    store: Store, texts: Iterable[str], within: float, path: str | Path | None = None
) -> None:
    """Add rules to those of a store, or replace these by those of a file before, each rule once.

    within : greatest distance of a search, metres; UsageError for a greater clearance.
    """
    given = None if path is None else read_rules(path)
    new = [parse_rule(text) for text in texts]
    if given is None and not new:
        return

    def changed(old: tuple[Rule, ...]) -> list[Rule]:
        rules = [*dict.fromkeys([*(old if given is None else given), *new])]
        check_clearances(rules, within)
        return rules

    store.change_rules(changed)


def rule_text(rule: Rule) -> str:
    """Rule as `parse_rule` reads it, without its reason."""
    one, other = (
        f"'{words}'" if re.search("^in |^and | in | and | in$| and$|:$|: ", words) else words
        for words in rule[:2]
    )
    if rule.says == "ignore":
        return f"{one} and {other}: ignore"
    length = "" if rule.length is None else length_text(rule.length)
    if rule.says == "apart":
        return f"{one} and {other}: keep {length} apart"
    kinds = "overlap" if rule.kinds == MEANT else ", ".join(rule.kinds)
    return f"{one} in {other}: {kinds}{length and f' up to {length}'} is meant"


def check_clearances(rules: Iterable[Rule], within: float) -> None:
    """Refuse a clearance beyond the greatest distance of a search, metres; UsageError."""
    for n, rule in enumerate(rules, start=1):
        if rule.says == "apart" and rule.length is not None and rule.length > within:
            raise UsageError(
                f"rule {n} keeps objects {length_text(rule.length)} apart, and only pairs within "
                f"{length_text(within)} are looked for: give --within {1e3 * rule.length:.6g}mm"
            )


class Rules:
    """Rules, and the objects of their words.

    missing : for each rule, the error of words without an object, or empty; ignores : whether one
    ignores pairs.
    """

    def __init__(self, rules: Sequence[Rule], objects: Sequence[Object], url: str) -> None:
        self.rules = tuple(rules)
        self.ignores = any(rule.says == "ignore" for rule in rules)
        self._ids = np.array([obj.id for obj in objects], dtype=np.int64)
        self.missing: list[str] = []
        self._sides: list[list[NDArray[np.bool_]]] = []
        listing = Listing(objects, url)
        for rule in rules:
            errors: list[ObjectNotFoundError] = []
            sides = [
                [obj.id for obj in listing.chosen(checked_words([word]), errors)]
                for word in (rule.one, rule.other)
            ]
            self._sides.append([np.isin(self._ids, side) for side in sides])
            self.missing.append(str(errors[0]) if errors else "")

    def first(self, pairs: Iterable[tuple[int, int]]) -> NDArray[np.int64]:
        """Index (P,) of the deciding rule of each pair of ids; -1 without one."""
        keys = np.array([*pairs], dtype=np.int64).reshape(-1, 2)
        found = np.full(len(keys), -1, dtype=np.int64)
        if not len(self._ids):
            return found
        at = np.minimum(np.searchsorted(self._ids, keys), len(self._ids) - 1)
        is_there = (self._ids[at] == keys).all(axis=1)
        a, b = at.T
        for n in range(len(self.rules))[::-1]:
            one, other = self._sides[n]
            found[is_there & ((one[a] & other[b]) | (one[b] & other[a]))] = n
        return found

    def ignored(self, pairs: Iterable[tuple[int, int]]) -> set[tuple[int, int]]:
        """Ignored ones of pairs of ids."""
        keys = [*pairs] if self.ignores else []
        return {
            key
            for key, n in zip(keys, self.first(keys).tolist(), strict=True)
            if n >= 0 and self.rules[n].says == "ignore"
        }
