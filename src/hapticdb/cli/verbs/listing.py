"""Verbs for the contents of an environment: info, objects."""

import sys
from contextlib import closing, suppress
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hapticdb.cli import render
from hapticdb.cli.emit import Output
from hapticdb.cli.selection import chosen, opened_to_store
from hapticdb.errors import AccessError, UsageError
from hapticdb.tabular.schema import OBJECT, record
from hapticdb.units import length_text, place_text

if TYPE_CHECKING:
    from hapticdb.paper.cost_model import CostModel
    from hapticdb.store.base import Object, Store

PAGE = 40
"""Default number of objects on a terminal."""
MEANINGS = {
    "statement": "a statement of ranges, without what it reads",
    "descent": "each range of a statement: a descent of the index",
    "block": "each leaf block scanned in the engine",
    "row": "each row handed to the client",
}
"""Times of a cost model, microseconds, with their meanings."""
RATIOS = ("rows_per_block", "caution", "distances")
"""Figures of a cost model without a unit: ratios."""
SOURCES = {
    "server statistics": "the server's own statistics",
    "kept": "computed and kept",
    "computed": "computed when needed",
}
"""Sources of the statistics of the keys, in words."""


def info(url: str, *, calibrate: bool = False, cold: bool = False, output: Output) -> None:
    """Show engine, grid, layout, size; measure costs.

    --calibrate measures the cost of statements, index descents and rows, and renews the statistics.
    The figures are stored in the environment; the strategies cbgroup and auto use them.

    Example: hapticdb info car.db --calibrate
    """
    from hapticdb.store.connect import open_store

    if cold and not calibrate:
        raise UsageError("--cold belongs to --calibrate: give it, too")
    costs, is_kept = _measured(url, cold=cold) if calibrate else (None, False)
    # the store alone: Environment also loads the code of touches and imports, 0.1 s
    with closing(open_store(url, read_only=True)) as store:
        values, words = _overview(store)
    if costs is not None:
        known = costs.figures()
        figures = {name: known[name] for name in (*MEANINGS, *RATIOS)}
        values["costs"] = {"figures": figures, "spread": costs.spread, "is_kept": is_kept}
    output.emit(values, partial(_show, words, costs))


def _overview(store: "Store") -> tuple[dict[str, Any], list[tuple[str, str]]]:
    """Facts of an environment for `info`, as JSON and in words."""
    from hapticdb.paper.quantiles import DEFAULT_RESOLUTION, QuantileVector
    from hapticdb.store.attributes import scene_bounds
    from hapticdb.store.engines import MayLag

    objects, grid, size = store.objects(), store.grid, store.size()
    n_banded = sum(obj.has_distances for obj in objects)
    voxels, scene = sum(obj.voxels for obj in objects), scene_bounds(objects)
    fresh = store.freshness(DEFAULT_RESOLUTION)
    source = QuantileVector.of(store, DEFAULT_RESOLUTION).source
    lag = store.lag() if isinstance(store, MayLag) else None
    values = record(store, "name engine layout") | {
        **record(grid, "voxel_size bits origin curve"),
        "objects": len(objects), "scene": render.box_record(scene), "voxels": voxels,
        **record(size, "rows bytes"), "distances": {"objects": n_banded},
        "surfaces": {"shapes": size.surfaces, "bytes": size.surface_bytes}, "standby": lag,
        "statistics": {"source": source, **fresh._asdict()},
    }  # fmt: skip
    a_voxel = f" ({size.bytes / voxels:.3g} a voxel)" if voxels else ""
    n_shapes = render.counted(size.surfaces, "shape")
    surfaces = f"{n_shapes}, {render.bytes_text(size.surface_bytes)}" if size.surfaces else "none"
    behind = f"{render.counted(fresh.changes, 'write')} behind" if fresh.changes else "fresh"
    age = "none made yet" if fresh.revision is None else behind
    words = [
        ("environment", store.url),
        ("name", store.name),
        ("engine", store.engine),
        ("voxel size", length_text(grid.voxel_size)),
        ("bits an axis", f"{grid.bits}: {render.counted(8.0**grid.bits, 'cell')}"),
        ("origin", f"{place_text(grid.origin, grid.voxel_size / 100)} m"),
        ("curve", grid.curve),
        ("layout", store.layout),
        ("objects", f"{len(objects):,}"),
        ("scene", "nothing in it" if scene is None else render.box(scene)),
        ("voxels", f"{voxels:,}"),
        ("rows", f"{size.rows:,}"),
        ("size", f"{render.bytes_text(size.bytes)}{a_voxel}"),
        ("distances", f"of {render.counted(n_banded, 'object')}" if n_banded else "none"),
        ("surfaces", surfaces),
        ("statistics", f"{SOURCES[source]}; {age}"),
    ]
    if lag is not None:
        old = "none yet" if lag.seconds is None else f"{lag.seconds:.3g} s old"
        words.insert(3, ("standby", f"replayed to {lag.replayed}, the last commit there: {old}"))
    return values, words


def objects(
    url: str, *, name: list[str] | None = None, limit: int | None = None, output: Output
) -> None:
    """List the objects of an environment.

    Verbs accept objects by id, by name, by pattern and by attribute. A name is a path, such as
    body/door/handle. A name without / fits any element of a path, a name with / the path from its
    start. The name of a sub-assembly means all objects below it. In a pattern * stands for
    anything, ? for one character, [ab] for a or b; case counts. attribute=value chooses the objects
    with this attribute; the value may be a pattern, and outer.inner=value names a nested attribute.
    A word with = is a name if an object has this name. A number is an id, or a name if no object
    has this id; name=3 is a name.

    Example: hapticdb objects car.db

    Example: hapticdb objects car.db --name 'wheel*' --limit 10

    Example: hapticdb objects car.db --name up=z
    """
    from hapticdb.store.connect import open_store

    if limit is not None and limit < 0:
        raise UsageError(f"--limit {limit}: give 0, for all, or more")
    with closing(open_store(url, read_only=True)) as store:
        shown_url = store.url
        found = chosen(store, name, "--name") if name else store.objects()
    if limit is None:
        limit = PAGE if sys.stdout.isatty() and not output.json else 0
    shown = found[: limit or None]
    for obj in shown if output.json else ():
        render.say_json(record(obj, OBJECT))
    if found and not output.json:
        rows = ((o.id, o.name, f"{o.voxels:,}", size_text(o), Path(o.link).name) for o in shown)
        render.table(("id>", "name", "voxels>", "size, mm>", "file?"), rows)
        if len(shown) < len(found):
            render.note(f"{len(shown):,} of {len(found):,} objects; --limit 0 shows all")
    elif not output.json:
        render.note(f"{shown_url} is empty; 'hapticdb import URL FILE' fills it")


def size_text(obj: "Object") -> str:
    """Sides of an object's bounding box in millimetres: ``1200 x 35 x 4``."""
    return " x ".join(
        f"{1000 * side:.3g}" if side < 1 else f"{1000 * side:.0f}"
        for side in (obj.bounds[1] - obj.bounds[0]).tolist()
    )


def _measured(url: str, *, cold: bool) -> "tuple[CostModel, bool]":
    """Costs measured now, and whether they are stored; renews the statistics if permitted."""
    with opened_to_store(url) as env:
        is_kept = not env.store.is_read_only
        if is_kept:
            with suppress(AccessError):  # a role may keep costs only
                env.analyze()
        costs = env.calibrate(cold=cold)
    if not is_kept:
        render.note(f"{env.url} can only be read: the figures were measured, and not kept")
    return costs, is_kept


def _show(words: list[tuple[str, str]], costs: "CostModel | None") -> None:
    render.facts(words)
    if costs is None:
        return
    rows, figures = [], costs.figures()
    for name, meaning in MEANINGS.items():
        spread = costs.spread.get(name)
        known = "" if spread is None else f"± {100 * spread:.0f} %"
        rows.append((name, f"{figures[name]:.3f}", known, meaning))
    render.table(("figure", "µs>", "spread>", "what it is"), rows)
    worth = costs.descent / costs.row_in_gap if costs.row_in_gap else None
    when = "always" if worth is None else f"when it should hold fewer than {worth:.1f} rows"
    render.say(f"{costs.rows_per_block:.0f} rows in a leaf block; a gap is scanned {when}")
