"""Reports of clashes for other tools: JUnit for CI, and BCF 2.1 for CAD and building models."""

import re
import uuid
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import UTC, datetime
from itertools import chain
from pathlib import Path
from typing import NamedTuple
from xml.etree.ElementTree import Element, SubElement, tostring
from zipfile import ZIP_DEFLATED, ZipFile

import numpy as np

from hapticdb.clashes.clash_results import DEFAULT_KINDS, Clash, Clashes
from hapticdb.clashes.groups import Group
from hapticdb.clashes.rules import rule_text
from hapticdb.environment import Environment
from hapticdb.pictures.canvas import TOWARDS, turned
from hapticdb.pictures.clash_page import clashes_page, snapshot, view_of
from hapticdb.store.attributes import up_axis
from hapticdb.store.base import Object
from hapticdb.units import place_text
from hapticdb.verdicts import Kind

MOST_LINES = 100
"""Pairs of a group in a report, at most; the others are counted."""
MOST_SNAPSHOTS = 100
"""Topics of a BCF file with a picture, a tenth of a second each, the gravest."""
GUIDS = uuid.UUID("5e2f6d4c-1f0b-5b53-9d0e-6a2b8f1c7a90")
"""Namespace of the GUIDs of topics; with another one, all topics are new to other tools."""
GLOBAL_ID = re.compile(r"[0-9A-Za-z_$]{22}")


class _Case(NamedTuple):
    """A test case; outcome : failure, error, skipped, or empty."""

    classname: str
    name: str
    outcome: str = ""
    message: str = ""
    text: str = ""


def write_reports(
    files: Mapping[str, Path],
    env: Environment,
    found: Clashes,
    shown: Sequence[Clash],
    groups: Sequence[Group],
    kinds: Sequence[Kind],
) -> None:
    """Write the reports `html`, `junit` and `bcf`, if their files are given.

    `shown`, `groups` : pairs of the page and their groups; `kinds` : requested ones, the default if
    empty.
    """
    failing = kinds or DEFAULT_KINDS
    if "html" in files:
        page = clashes_page(env, found, shown, groups)
        files["html"].write_text(page, encoding="utf-8")
    if "junit" in files:
        files["junit"].write_bytes(junit(found, groups, failing))
    if "bcf" in files:
        write_bcf(files["bcf"], env, [group for group in groups if group.kind in failing])


def junit(found: Clashes, groups: Iterable[Group], failing: Sequence[Kind]) -> bytes:
    """JUnit's XML: a test case for each group of the requested kinds, and for each rule.

    A group fails while a pair of it is open, and so does the first rule about an open pair. A rule
    without pairs is skipped; unmeasured pairs are an error.
    """
    findings = [_finding(group) for group in groups if group.kind in failing]
    if found.left:
        message = f"{found.left:,} pairs were not looked at"
        findings.append(_Case("clashes", "search", "error", message))
    suites = {"clashes": findings, "rules": list(_rules(found, failing))}
    root = Element("testsuites", {"name": "hapticdb clashes", **_counts(chain(*suites.values()))})
    for name, cases in suites.items():
        seconds = f"{found.elapsed if name == 'clashes' else 0.0:.3f}"
        skipped = sum(case.outcome == "skipped" for case in cases)
        counts = {**_counts(cases), "skipped": str(skipped), "time": seconds}
        suite = SubElement(root, "testsuite", {"name": name, **counts})
        for case in cases:
            one = _child(suite, "testcase", classname=case.classname, name=case.name)
            if case.outcome:
                _child(one, case.outcome, case.text, message=case.message)
    return _xml(root)


def write_bcf(path: Path, env: Environment, groups: Iterable[Group]) -> None:
    """Write a BCF 2.1 file: a topic for each group, closed if all of its pairs are decided.

    The viewpoint selects the gravest pair and shows its two points. Topics have the same GUIDs as
    long as groups have the same ids.
    """
    objects = {obj.id: obj for obj in env.objects()}
    up, now = up_axis(objects.values()), datetime.now(UTC).isoformat(timespec="seconds")
    with ZipFile(path, "w", ZIP_DEFLATED) as archive:
        version = Element("Version", VersionId="2.1")
        _child(version, "DetailedVersion", "2.1")
        archive.writestr("bcf.version", _xml(version))
        for n, group in enumerate(groups):
            one = group.pairs[0]
            pair, topic = (objects[one.a], objects[one.b]), uuid.uuid5(GUIDS, group.id)
            picture = snapshot(env.store, one, pair, up) if n < MOST_SNAPSHOTS else None
            markup = _markup(group, topic, now, has_picture=picture is not None)
            archive.writestr(f"{topic}/markup.bcf", _xml(markup))
            archive.writestr(f"{topic}/viewpoint.bcfv", _xml(_viewpoint(topic, one, pair, up)))
            if picture is not None:
                archive.writestr(f"{topic}/snapshot.png", picture)


def _finding(group: Group) -> _Case:
    name = f"{group.title()} [{group.id}]"
    if not group.is_open:
        return _Case(f"clashes.{group.kind}", name)
    message = f"{group.kind} {group.length_text()}"
    return _Case(f"clashes.{group.kind}", name, "failure", message, _lines(group.pairs))


def _rules(found: Clashes, failing: Sequence[Kind]) -> Iterator[_Case]:
    for n, reach in enumerate(found.reach(), start=1):
        name = f"{n}: {rule_text(reach.rule)}"
        broken = [
            one for one in found.pairs if one.rule == n and one.is_open and one.kind in failing
        ]
        if broken:
            message = f"{len(broken):,} of {reach.n_pairs:,} pairs do not keep it"
            yield _Case("clashes.rules", name, "failure", message, _lines(broken))
        elif not reach.n_pairs:
            yield _Case("clashes.rules", name, "skipped", f"it reaches {reach}")
        else:
            yield _Case("clashes.rules", name)


def _lines(pairs: Sequence[Clash]) -> str:
    """A line for each pair: names, ids, kind, length, position."""
    lines = [
        f"{one.a_name} ({one.a}), {one.b_name} ({one.b}): {one.kind} {one.length_text()}, "
        f"{one.because or one.status}"
        + (f", at {place_text((1e3 * x for x in one.place[:3]), 0.1)} mm" if one.place else "")
        for one in pairs[:MOST_LINES]
    ]
    more = len(pairs) - MOST_LINES
    return "\n".join([*lines, f"and {more:,} more"] if more > 0 else lines)


def _counts(cases: Iterable[_Case]) -> dict[str, str]:
    found = Counter(case.outcome for case in cases)
    numbers = found.total(), found["failure"], found["error"]
    return dict(zip(("tests", "failures", "errors"), map(str, numbers), strict=True))


def _markup(group: Group, topic: uuid.UUID, now: str, *, has_picture: bool) -> Element:
    """Topic with its text and view; the schema fixes the order of elements."""
    root, status = Element("Markup"), "Open" if group.is_open else "Closed"
    about = _child(root, "Topic", Guid=str(topic), TopicType="Clash", TopicStatus=status)
    _child(about, "Title", group.title())
    _child(about, "Labels", group.kind)
    _child(about, "CreationDate", now)
    _child(about, "CreationAuthor", "hapticdb")
    length = f"{group.kind} {group.length_text()}; group {group.id}"
    _child(about, "Description", f"{length}\n{_lines(group.pairs)}")
    view = _child(root, "Viewpoints", Guid=str(uuid.uuid5(topic, "viewpoint")))
    _child(view, "Viewpoint", "viewpoint.bcfv")
    if has_picture:
        _child(view, "Snapshot", "snapshot.png")
    return root


def _viewpoint(topic: uuid.UUID, one: Clash, pair: tuple[Object, Object], up: int) -> Element:
    """Orthographic view of a pair's points, both objects selected."""
    root = Element("VisualizationInfo", Guid=str(uuid.uuid5(topic, "viewpoint")))
    components = _child(root, "Components")
    selection = _child(components, "Selection")
    for obj in pair:
        number = str(obj.attributes.get("GlobalId"))
        known = {"IfcGuid": number} if GLOBAL_ID.fullmatch(number) else {}
        component = _child(selection, "Component", **known)
        _child(component, "OriginatingSystem", "hapticdb")
        _child(component, "AuthoringToolId", obj.name)
    _child(components, "Visibility", DefaultVisibility="true")
    middle, radius = view_of(one, pair)
    towards, upright = turned(TOWARDS, up), np.eye(3)[up]
    upright = upright - (upright @ towards) * towards
    camera = _child(root, "OrthogonalCamera")
    for name, vector in (
        ("CameraViewPoint", middle + 4.0 * radius * towards),
        ("CameraDirection", -towards),
        ("CameraUpVector", upright / np.linalg.norm(upright)),
    ):
        axes = _child(camera, name)
        for axis, value in zip("XYZ", vector.tolist(), strict=True):
            _child(axes, axis, repr(value))
    _child(camera, "ViewToWorldScale", repr(2.0 * radius))
    return root


def _child(parent: Element, tag: str, text: str = "", **attributes: str) -> Element:
    """Append an element; unprintable characters become question marks."""
    said = {name: _printable(value) for name, value in attributes.items()}
    child = SubElement(parent, tag, said)
    child.text = _printable(text) or None
    return child


def _printable(text: str) -> str:
    return "".join(letter if letter.isprintable() or letter == "\n" else "?" for letter in text)


def _xml(root: Element) -> bytes:
    return bytes(tostring(root, encoding="utf-8", xml_declaration=True))
