"""HTML page of a search for clashes, in one file: counts, pictures, a matrix, and the table."""

import base64
import html
import io
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray
from PIL import ImageDraw

from hapticdb.clashes.clash_results import Clash, Clashes
from hapticdb.clashes.groups import Group
from hapticdb.environment import Environment
from hapticdb.ingest.geometry import parts_of
from hapticdb.pictures.canvas import Canvas
from hapticdb.store.attributes import up_axis
from hapticdb.store.base import Object, Store
from hapticdb.units import length_text
from hapticdb.verdicts import Kind

Floats = NDArray[np.float64]

PICTURES = 10
"""Groups with a picture of a pair, open ones first, then the gravest."""
MOST_ROWS = 5_000
"""Rows of the table, at most. More: a browser opens the page more slowly."""
MOST_UNITS = 24
"""Sub-assemblies in the matrix, those of most overlaps, then of most pairs; the rest is one row."""
NAME = 40
"""Letters of a name in the matrix, at most."""
REST = "all others"
SIZE = (400, 300)
"""Pixels of a picture."""
TINTS = ((0.92, 0.41, 0.08), (0.14, 0.39, 0.63))
"""Colours of the first part and of the second one, 0 to 1."""
MARK = "#ffed33"
"""Colour of the circles at a pair's two points."""
PAPER = (0.94, 0.95, 0.96)
STYLE = """
body{font:14px/1.45 system-ui,sans-serif;color:#1c2530;margin:2em auto;max-width:80em;padding:0 1em}
table{border-collapse:collapse}td,th{padding:.2em .6em;text-align:left;border-bottom:1px solid #dde}
figure{display:inline-block;width:350px;margin:0 1em 1em 0;vertical-align:top}
figcaption{overflow-wrap:anywhere}img{width:100%;border-radius:6px}
.matrix th,.n{white-space:nowrap}.n{text-align:right}
.matrix td{text-align:center;padding:.2em .4em}
.o{color:#eb6814}.b{color:#2463a0}
"""


def clashes_page(
    env: Environment, found: Clashes, shown: Sequence[Clash], groups: Sequence[Group]
) -> str:
    """Self-contained HTML page of pairs, the gravest first.

    env : with the surfaces of its objects, at the search's revision; `shown`, `groups` : pairs of
    the search, and their groups.
    """
    objects = env.objects()
    counts = ", ".join(f"{n:,} {kind}" for kind, n in found.counts().items() if n) or "no pair"
    rest = len(shown) - MOST_ROWS
    facts = (
        f"within {length_text(found.within)}, contact {length_text(found.contact)}, "
        f"revision {found.revision}, {len(objects):,} objects"
    )
    parts = [
        f"<h1>{html.escape(counts)}</h1><p>{html.escape(facts)}</p>",
        f"<p>{found.left:,} pairs were not looked at.</p>" if found.left else "",
        "<h2>The gravest</h2>",
        *_figures(env, groups, {obj.id: obj for obj in objects}),
        "<h2>Sub-assemblies</h2><p>Pairs that overlap, of all that are near.</p>",
        _matrix(shown),
        "<h2>Pairs</h2>",
        _table(shown[:MOST_ROWS]),
        f"<p>and {rest:,} more: --csv writes all</p>" if rest > 0 else "",
    ]
    return (
        '<!doctype html><html lang="en"><meta charset="utf-8"><title>Which parts meet</title>'
        f"<style>{STYLE}</style>{''.join(parts)}</html>\n"
    )


def _text(words: str | None) -> str:
    """Words in HTML, with question marks for unprintable letters."""
    words = "(gone)" if words is None else words
    shown = "".join(letter if letter.isprintable() else "?" for letter in words)
    return html.escape(shown)


def _table(shown: Sequence[Clash]) -> str:
    rows = "".join(
        f"<tr><td class=n>{one.a}<td>{_text(one.a_name)}<td class=n>{one.b}<td>{_text(one.b_name)}"
        f"<td>{one.kind}<td class=n>{one.length_text()}<td>{one.status}<td>"
        f"{_text(one.because or '')}"
        for one in shown
    )
    head = "<tr><th>id<th>object<th>id<th>and<th>are<th>by<th>status<th>because"
    return f"<table>{head}{rows}</table>"


def _matrix(shown: Sequence[Clash]) -> str:
    """Numbers of pairs between sub-assemblies: overlapping ones, of all."""
    there = [one for one in shown if one.status != "gone" and one.a_name and one.b_name]
    depth = _common([name.split("/") for one in there for name in (one.a_name, one.b_name) if name])
    pairs = [(_unit(one.a_name, depth), _unit(one.b_name, depth)) for one in there]
    weights: Counter[str] = Counter()
    for one, pair in zip(there, pairs, strict=True):
        for unit in pair:
            weights[unit] += len(shown) * (one.kind == Kind.OVERLAPPING) + 1
    units = sorted(unit for unit, _ in weights.most_common(MOST_UNITS))
    near: Counter[tuple[str, str]] = Counter()
    deep: Counter[tuple[str, str]] = Counter()
    for one, pair in zip(there, pairs, strict=True):
        a, b = sorted(unit if unit in units else REST for unit in pair)
        for cell in {(a, b), (b, a)}:
            near[cell] += 1
            deep[cell] += one.kind == Kind.OVERLAPPING
    units += [REST] if any(REST in cell for cell in near) else []
    head = "".join(f"<th title='{_text(unit)}'>{n}" for n, unit in enumerate(units, 1))
    rows = ""
    for n, row in enumerate(units, 1):
        cells = "".join(_cell(deep[row, column], near[row, column]) for column in units)
        rows += f"<tr><th>{n} {_text(_shortened(row))}{cells}"
    return f"<table class=matrix><tr><th>{head}{rows}</table>"


def _shortened(name: str) -> str:
    """A name of at most `NAME` letters; a longer one without its middle."""
    half = (NAME - 1) // 2
    return name if len(name) <= NAME else f"{name[:half].rstrip()}…{name[-half:].lstrip()}"


def _common(paths: Sequence[Sequence[str]]) -> int:
    """Number of common leading elements of all paths, before their last ones."""
    depth = 0
    while paths and all(len(path) > depth + 1 and path[depth] == paths[0][depth] for path in paths):
        depth += 1
    return depth


def _unit(name: str | None, depth: int) -> str:
    return (name or "").split("/")[depth]


def _cell(deep: int, near: int) -> str:
    if not near:
        return "<td>"
    shade = f" style='background:rgb(235 104 20/{min(0.15 + deep / 10, 0.8):.2f})'" if deep else ""
    return f"<td{shade}>{deep:,}/{near:,}"


def _figures(
    env: Environment, groups: Sequence[Group], objects: dict[int, Object]
) -> Iterator[str]:
    up, drawn = up_axis(objects.values()), 0
    for group in groups:
        one = group.pairs[0]
        a, b = objects.get(one.a), objects.get(one.b)
        if one.kind == Kind.APART or one.place is None or a is None or b is None:
            continue
        data = base64.b64encode(snapshot(env.store, one, (a, b), up)).decode()
        yield (
            f'<figure><img alt="" src="data:image/png;base64,{data}"><figcaption>'
            f"<b class=o>{_text(one.a_name)}</b>, <b class=b>{_text(one.b_name)}</b>: "
            f"{one.kind} {one.length_text()}, {_text(group.status())}"
            f"{f', {len(group.pairs):,} pairs' * (len(group.pairs) > 1)}</figcaption></figure>"
        )
        drawn += 1
        if drawn == PICTURES:
            return


def view_of(one: Clash, pair: tuple[Object, Object]) -> tuple[Floats, float]:
    """Middle (3,) of a pair's two points, and half the edge of the view, metres."""
    places = np.array(one.place).reshape(2, 3)
    edge = min(float(np.linalg.norm(obj.bounds[1] - obj.bounds[0])) for obj in pair)
    radius = max(0.4 * edge, 2.0 * float(np.linalg.norm(places[1] - places[0])), 1e-6)
    return places.mean(axis=0), radius


def snapshot(store: Store, one: Clash, pair: tuple[Object, Object], up: int) -> bytes:
    """PNG of both surfaces around their two points; up : axis, 0 to 2."""
    middle, radius = view_of(one, pair)
    box = np.stack([middle - radius, middle + radius])[None]
    canvas = Canvas(box, SIZE, np.array([[0.0, 0.0], SIZE]), np.array(PAPER), up)
    for (_, part), tint in zip(parts_of(store, pair), TINTS, strict=True):
        canvas.fill(part.surface(), np.array(tint))
    picture = canvas.picture()
    draw = ImageDraw.Draw(picture)
    for x, y, _ in canvas.project(np.array(one.place).reshape(2, 3)).tolist():
        draw.circle((x, y), 9.0, outline=MARK)
    content = io.BytesIO()
    picture.save(content, "PNG")
    return content.getvalue()
