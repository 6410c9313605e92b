"""Rules: what they say, which pairs they reach, and what is told of these."""

from pathlib import Path

import numpy as np
import pytest

import hapticdb
from assemblies import row_of_boxes
from hapticdb import Environment, accept_clash, find_clashes
from hapticdb.clashes.clash_results import Clash, Clashes, rule_for
from hapticdb.clashes.rules import Rules, add_rules, parse_rule, read_rules, rule_text
from hapticdb.errors import FileError, UsageError
from hapticdb.store.base import Object
from hapticdb.store.pairs import Rule
from hapticdb.transfer import copy_environment
from hapticdb.verdicts import Kind
from servers import Place

MM = 1e-3
MEANT = (Kind.OVERLAPPING, Kind.TOUCHING)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Three cubes in a row, 2 mm deep in one another, and one 0.5 mm beside the last."""
    path = row_of_boxes(
        tmp_path / "row.db", 4, 0.098, ("bolts/a", "plates/b", "bolts/c", "cables/d")
    )
    with hapticdb.open(path) as env:
        env.shift([4], (2.5 * MM, 0.0, 0.0))
    return path


def decided(env: Environment, *texts: str, within: float = MM) -> Clashes:
    env.store.change_rules(lambda _: [parse_rule(text) for text in texts])
    return find_clashes(env, within=within)


def told(found: Clashes) -> dict[tuple[int, int], tuple[str, str, int | None]]:
    return {(one.a, one.b): (one.kind, one.status, one.rule) for one in found.pairs}


def reach(found: Clashes) -> list[tuple[int, int]]:
    return [(one.n_pairs, one.n_changed) for one in found.reach()]


@pytest.mark.parametrize(
    ("text", "rule"),
    [
        (
            "bolts/* in *: overlap up to 0.3 mm is meant because threads are cylinders",
            Rule("bolts/*", "*", "meant", MEANT, 0.3 * MM, "threads are cylinders"),
        ),
        ("a in b: inside, touching is meant",
         Rule("a", "b", "meant", (Kind.INSIDE, Kind.TOUCHING))),
        ("a in b: overlap, duplicate is meant",
         Rule("a", "b", "meant", (*MEANT, Kind.DUPLICATE))),
        ("a:0:x and b c,d: keep 2mm apart", Rule("a:0:x", "b c,d", "apart", (), 2 * MM)),
        ("a and material=steel: ignore", Rule("a", "material=steel", "ignore")),
        ("'a and b: c' in d: overlap is meant", Rule("a and b: c", "d", "meant", MEANT)),
    ],
)  # fmt: skip
def test_parse_rule_inverts_rule_text(text: str, rule: Rule) -> None:
    assert parse_rule(text) == rule
    assert parse_rule(rule_text(rule)) == rule._replace(because="")


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ("a is meant", "ONE in OTHER: overlap up to 0.3 mm is meant"),
        ("a in b: overlap up to 3 parsec is meant", "parsec"),
        ("a in b: overlap up to -1 mm is meant", "above 0"),
        ("a in b: overlap up to " + "9" * 400 + " mm is meant", "no length"),
        ("a in b: overlaps is meant", "overlapping"),
        ("a in b: , is meant", "''"),
        ("a in b: too near is meant", "touching"),
        ("a and b: keep away apart", "'away'"),
        ("a and \x1b: ignore", "ONE in OTHER"),
        ("a in " + "b: c in " * 300 + "d", "2,406 characters"),
    ],
)
def test_parse_rule_bad_text(text: str, word: str) -> None:
    with pytest.raises(UsageError, match=word) as refusal:
        parse_rule(text)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize(
    "name", ["12", "3,4", "a in b", "in b", "b and", "x:", "x: y", "it's", "[a]*", "a=b"]
)
def test_rule_for_matches_its_pair(name: str) -> None:
    objects = [
        Object(other, "f", "d", np.eye(4), 1, np.zeros((2, 3)), {}, id=n)
        for n, other in enumerate((name, "other", "else"), start=10)
    ]
    one = Clash(10, 11, name, "other", Kind.OVERLAPPING, MM, 2 * MM, (0.0,) * 6, "new")
    rules = Rules([parse_rule(rule_for(one))], objects, "url")
    assert rules.first([(10, 11), (10, 12), (11, 12)]).tolist() == [0, -1, -1]


@pytest.mark.parametrize("name", ["'a'", "a\nb", "it's in b", "and b in c: ignore because it"])
def test_rule_for_empty_for_unquotable_names(name: str) -> None:
    one = Clash(1, 2, name, "'b' in c", Kind.TOUCHING, 0.0, 0.0, (0.0,) * 6, "new")
    assert rule_for(one) == ""


def test_read_rules_order_of_file(tmp_path: Path) -> None:
    file = tmp_path / "rules.toml"
    file.write_text("""
        rules = [
            "bolts/* in *: overlap up to 0.3 mm is meant because threads",
            "'a in b' in b: inside is meant",  # quotes where words are in the names
            'a and *: keep 2 mm apart',
            "c and *: ignore",
        ]
    """)
    assert read_rules(file) == [
        Rule("bolts/*", "*", "meant", MEANT, 0.3 * MM, "threads"),
        Rule("a in b", "b", "meant", (Kind.INSIDE,)),
        Rule("a", "*", "apart", (), 2 * MM),
        Rule("c", "*", "ignore"),
    ]
    file.write_text("")
    assert read_rules(file) == []


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ("rules = [", "no TOML"),
        ("[[rule]]\nof = 'a'", "unknown key 'rule'"),
        ("rules = 'a and b: ignore'", "no list"),
        ("rules = [3]", "no list"),
        ("rules = ['a and b: ignore', 'a is fine']", "rule 2: give 'ONE in OTHER"),
        ("rules = ['a and b: keep 2 parsec apart']", "rule 1: '2 parsec'"),
        ("rules = ['a in b: fits is meant']", "rule 1: 'fits'"),
    ],
)
def test_read_rules_error_names_file_and_rule(tmp_path: Path, content: str, words: str) -> None:
    file = tmp_path / "rules.toml"
    file.write_text(content)
    with pytest.raises((UsageError, FileError)) as refusal:
        read_rules(file)
    assert str(file) in str(refusal.value)
    assert words in str(refusal.value)
    assert "\n" not in str(refusal.value)


def test_read_rules_missing_file(tmp_path: Path) -> None:
    with pytest.raises(FileError, match=r"none\.toml"):
        read_rules(tmp_path / "none.toml")


def test_rules_meant_overlap_up_to_depth(place: Place, path: Path) -> None:
    url = place()
    copy_environment(path, url)
    for where in (str(path), url):
        with hapticdb.open(where) as env:
            assert [one[:2] for one in decided(env).of()] == [(1, 2), (2, 3)]
            found = decided(env, "bolts/a in *: overlap up to 1 mm is meant")
            assert found.measured == 0  # nothing is measured again
            assert [one[:2] for one in found.of()] == [(1, 2), (2, 3)]
            assert reach(found) == [(1, 0)]
            assert [round(1e6 * one.at_least) for one in found.of()] == [2000, 2000]
            found = decided(env, "* in *: overlap up to 2.01 mm is meant")  # at most is more
            assert len(found.of()) == 2
            found = decided(env, "* in bolts/*: overlap up to 2.2 mm is meant because a thread")
            assert told(found) == {
                (1, 2): ("overlapping", "meant", 1), (2, 3): ("overlapping", "meant", 1),
                (3, 4): ("apart", "same", 1),
            }  # fmt: skip
            assert (found.of(), reach(found), found.counts()["overlapping"]) == ((), [(3, 2)], 2)
            assert {one.because for one in found.pairs} == {"a thread", None}
            assert len(decided(env).of()) == 2


def test_rules_first_match_decides(path: Path) -> None:
    with hapticdb.open(path) as env:
        deep, shallow = (f"* in *: overlap up to {depth} mm is meant" for depth in (3, 1))
        assert decided(env, deep, shallow).of() == ()
        found = decided(env, shallow, deep, "none in *: overlap is meant")
        assert (len(found.of()), reach(found)) == (2, [(3, 0), (0, 0), (0, 0)])
        assert [bool(one.missing) for one in found.reach()] == [False, False, True]


def test_rules_pairs_below_clearance_are_findings(path: Path) -> None:
    with hapticdb.open(path) as env:
        with pytest.raises(UsageError, match=r"rule 1 .* within 1 mm .* --within 2mm"):
            decided(env, "cables/* and *: keep 2 mm apart")
        assert len(decided(env, "cables/* and *: keep 0.4 mm apart").of()) == 2
        found = decided(env, "cables/* and *: keep 0.6 mm apart")
        assert told(found)[3, 4] == ("too near", "same", 1)
        assert [one[:2] for one in found.of()] == [(1, 2), (2, 3), (3, 4)]
        assert (reach(found), found.counts()["too near"]) == ([(1, 1)], 1)
        accept_clash(env, [3], [4], "shielded")
        assert told(find_clashes(env))[3, 4] == ("too near", "accepted", 1)
        assert [row.kind for row in env.store.pairs()][-1] == "apart"


def test_rules_ignored_pair_is_not_measured(path: Path) -> None:
    with hapticdb.open(path) as env:
        found = decided(env, "plates/* and *: ignore")
        assert (found.measured, found.ignored, set(told(found))) == (1, ((1, 2), (2, 3)), {(3, 4)})
        assert reach(found) == [(2, 2)]
        env.shift([4], (MM, 0.0, 0.0))
        assert told(find_clashes(env)) == {(3, 4): ("apart", "gone", None)}
        found = decided(env)
        assert (found.measured, {one.status for one in found.pairs}) == (2, {"new"})
        accept_clash(env, [1], [2], "a press fit")
        env.shift([2], (0.5 * MM, 0.0, 0.0))
        assert decided(env, "plates/* and *: ignore").pairs == ()
        found = decided(env)
        assert told(found) == {
            (1, 2): ("overlapping", "accepted", None), (2, 3): ("overlapping", "changed", None)
        }  # fmt: skip
        assert find_clashes(env).measured == 0


def test_add_rules_no_duplicates_and_clearance_limit(path: Path) -> None:
    ignore, apart = "bolts/* and *: ignore", "plates/* and *: keep 2 mm apart"
    with hapticdb.open(path) as env:
        for texts in ([ignore], [ignore, apart], [apart]):
            add_rules(env.store, texts, 2 * MM)
        assert env.store.rules() == (parse_rule(ignore), parse_rule(apart))
        with pytest.raises(UsageError, match="rule 2 keeps"):
            add_rules(env.store, ["a and b: ignore"], MM)
        assert len(env.store.rules()) == 2


def test_copy_environment_copies_rules(tmp_path: Path, path: Path) -> None:
    rule = parse_rule("plates/* and *: ignore")
    with hapticdb.open(path) as env:
        env.store.change_rules(lambda _: [rule])
    copy_environment(path, tmp_path / "copy.db")
    with hapticdb.open(tmp_path / "copy.db") as env:
        assert env.store.rules() == (rule,)
        env.store.change_rules(lambda _: [])
