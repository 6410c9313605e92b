"""Rules: which pairs are meant, kept apart or ignored, by the words of their objects.

Rules change what is reported, not what is measured; only ignored pairs are left out of the narrow
phase. The first rule that reaches a pair decides.
"""

import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import FileError, ObjectNotFoundError, UsageError
from hapticdb.store.base import Object
from hapticdb.store.finding import Listing, checked_words
from hapticdb.store.pairs import Rule, Says
from hapticdb.units import length_of, length_text
from hapticdb.verdicts import REPORTED, Kind

MEANT = (Kind.OVERLAPPING, Kind.TOUCHING)
"""Kinds that a rule means unless it names others."""
MEASURED = tuple(kind for kind in REPORTED if kind != Kind.TOO_NEAR)
"""Kinds that a rule may name."""
FORM = (
    "give 'ONE in OTHER: overlap up to 0.3 mm is meant', 'ONE and OTHER: keep 2 mm apart' or "
    "'ONE and OTHER: ignore', and if wanted 'because REASON' after it"
)
GRAMMAR = re.compile(
    r"(?P<of>.+?) (?:in|and) (?P<against>.+?): *(?:"
    r"(?P<kinds>[^:]+?)(?: up to (?P<meant>[^:]+?))? is meant|"
    r"keep (?P<apart>[^:]+?) apart|(?P<ignore>ignore))(?: because (?P<because>.+))?"
)
KEYS = ("of", "against", "meant", "apart", "ignore", "kinds", "because")
"""Keys of a rule in a file."""


def parse_rule(text: str) -> Rule:
    """Rule of a text in one of the forms of `FORM`; UsageError."""
    found = GRAMMAR.fullmatch(text.strip())
    if found is None:
        raise UsageError(f"rule {text[:200]!r}: {FORM}")
    said: dict[str, object] = {key: value for key, value in found.groupdict().items() if value}
    said["ignore"] = "ignore" in said
    if "kinds" in said:
        said.setdefault("meant", True)
        kinds = [kind.strip() for kind in found["kinds"].split(",")]
        said["kinds"] = list(MEANT) if kinds == ["overlap"] else kinds
    return _rule(f"rule {text[:200]!r}", said)


def read_rules(path: str | Path) -> list[Rule]:
    """Rules of a TOML file, in its order; none of an empty one. docs/clashes.md has the form."""
    try:
        content = tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except OSError as error:
        raise FileError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise FileError(f"{path} is no TOML: {error}") from error
    tables = content.pop("rule", [])
    if content or not isinstance(tables, list):
        key = next(iter(content), "rule")
        raise UsageError(f"{path}: {key!r} is no list of rules: begin each rule with [[rule]]")
    return [_rule(f"{path}, rule {n}", table) for n, table in enumerate(tables, start=1)]


def _rule(place: str, said: object) -> Rule:
    """Rule of what a text or a table says; errors name the place."""

    def refuse(why: str) -> UsageError:
        return UsageError(f"{place}: {why}")

    if not isinstance(said, Mapping):
        raise refuse("it is no table: begin each rule with [[rule]]")
    if unknown := [key for key in said if key not in KEYS]:
        raise refuse(f"unknown key {unknown[0]!r}: give {', '.join(KEYS)}")
    texts = {"against": "*", "because": "", **said}
    for key in ("of", "against", "because"):
        text = texts.get(key)
        if not isinstance(text, str) or not text.isprintable() or not (text or key == "because"):
            raise refuse(f"{key} = {text!r}: give a text, such as {key} = 'bolts/*'")
    decisions = [key for key in ("meant", "apart", "ignore") if said.get(key, False) is not False]
    if len(decisions) != 1:
        raise refuse("give one of meant = '0.3 mm', apart = '2 mm' and ignore = true")
    says: Says = decisions[0]  # type: ignore[assignment]
    value, kinds = said[says], said.get("kinds", list(MEANT) if says == "meant" else [])
    if not isinstance(kinds, list) or not set(map(str, kinds)) <= set(MEASURED):
        raise refuse(f"kinds = {kinds!r}: give some of {', '.join(sorted(MEASURED))}")
    if (says == "meant") != bool(kinds):
        raise refuse("kinds are of rules with meant, and at least one")
    length = None
    if isinstance(value, str) and says != "ignore":
        try:
            length = length_of(value, "mm")
        except UsageError as error:
            raise refuse(f"{says} = {value!r}: {error}") from None
    elif value is not True or says == "apart":
        raise refuse(f"{says} = {value!r}: give " + ("true" if says == "ignore" else "'0.3 mm'"))
    if length is not None and not 0.0 < length < np.inf:
        raise refuse(f"{says} = {value!r}: give a length above 0")
    named = tuple(Kind(kind) for kind in kinds)
    return Rule(texts["of"], texts["against"], says, named, length, texts["because"])


def rule_text(rule: Rule) -> str:
    """Rule as `parse_rule` reads it, without its reason."""
    if rule.says == "ignore":
        return f"{rule.one} and {rule.other}: ignore"
    length = "" if rule.length is None else length_text(rule.length)
    if rule.says == "apart":
        return f"{rule.one} and {rule.other}: keep {length} apart"
    kinds = "overlap" if rule.kinds == MEANT else ", ".join(rule.kinds)
    return f"{rule.one} in {rule.other}: {kinds}{length and f' up to {length}'} is meant"


def check_clearances(rules: Iterable[Rule], within: float) -> None:
    """Refuse a clearance beyond the greatest distance of a search, metres; UsageError."""
    for n, rule in enumerate(rules, start=1):
        if rule.says == "apart" and rule.length is not None and rule.length > within:
            raise UsageError(
                f"rule {n} keeps objects {length_text(rule.length)} apart, and only pairs within "
                f"{length_text(within)} are looked for: give --within {1e3 * rule.length:.6g}mm"
            )


class Rules:
    """Rules, and the objects that their words choose.

    missing : for each rule, why its words choose nothing, or empty.
    """

    def __init__(self, rules: Sequence[Rule], objects: Sequence[Object], url: str) -> None:
        self.rules = tuple(rules)
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

    @property
    def ignores(self) -> bool:
        """Whether a rule ignores pairs."""
        return any(rule.says == "ignore" for rule in self.rules)

    def first(self, pairs: Iterable[tuple[int, int]]) -> NDArray[np.int64]:
        """Index (P,) of the rule that decides each pair of ids; -1 without one."""
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
        """Pairs of ids, those that a rule ignores."""
        keys = [*pairs] if self.ignores else []
        return {
            key
            for key, n in zip(keys, self.first(keys).tolist(), strict=True)
            if n >= 0 and self.rules[n].says == "ignore"
        }
