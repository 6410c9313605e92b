"""The verbs that look at an environment: info, objects, calibrate, analyze."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hapticdb.cli import render
from hapticdb.cli.columns import Columns
from hapticdb.cli.pages import PAGE, Corners, Order, page_of, selected
from hapticdb.cli.root import Json, Url

if TYPE_CHECKING:
    from hapticdb.query.cost_model import CostModel
    from hapticdb.store.base import Freshness, Object

MEANINGS = {
    "statement": "a statement of ranges, whatever it reads",
    "descent": "each range in it: a descent of the index",
    "block": "each leaf block scanned in the engine",
    "row": "each row handed to the client",
    "lookup": "a statement of keys",
    "probe": "each key in it",
    "single": "a point query of the sequence",
    "aggregate": "Figure 3, with the statement for ids",
    "point": "each shell point in it",
    "group": "grouping by cost, a frame",
    "group_key": "and each key in it",
}
RATIOS = ("rows_per_block", "crowding", "presence", "caution")
"""Of the figures, those that are no times."""
SOURCES = {
    "server statistics": "the server's own statistics",
    "kept": "computed and kept",
    "computed": "computed when needed",
}

NO_CHECKSUMS = "none of pages; 'hapticdb copy' makes an environment that has them"


def info(url: Url, *, json: Json = False) -> None:
    """Show an environment's engine, grid, layout, scene, size and statistics.

    Example: hapticdb info car.db --json
    """
    from contextlib import closing

    from hapticdb.query.quantiles import DEFAULT_RESOLUTION, QuantileVector
    from hapticdb.store.base import scene_bounds
    from hapticdb.store.connect import open_store

    # the store: an Environment brings what touches and imports, a tenth of a second
    with closing(open_store(url, read_only=True)) as env:
        grid, size, objects, layout = env.grid, env.size(), env.objects(), env.layout
        freshness = env.freshness(DEFAULT_RESOLUTION)
        quantiles = QuantileVector.of(env, DEFAULT_RESOLUTION)
        has_checksums = env.checker().has_page_checksums()
    voxels = sum(obj.voxels for obj in objects)
    scene = scene_bounds(objects)
    if json:
        render.say_json(
            {
                "name": env.name,
                "engine": env.engine,
                "voxel_size": grid.voxel_size,
                "bits": grid.bits,
                "origin": list(grid.origin),
                "curve": grid.curve,
                "layout": layout,
                "objects": len(objects),
                "scene": render.box_record(scene),
                "voxels": voxels,
                "rows": size.rows,
                "bytes": size.bytes,
                "page_checksums": has_checksums,
                "statistics": {"source": quantiles.source, **freshness._asdict()},
            }
        )
        return
    origin = ", ".join(f"{x:.6g}" for x in grid.origin)
    a_voxel = f" ({size.bytes / voxels:.3g} a voxel)" if voxels else ""
    render.show(
        render.facts(
            [
                ("environment", env.url),
                ("name", env.name),
                ("engine", env.engine),
                ("voxel size", render.metres(grid.voxel_size)),
                ("bits an axis", f"{grid.bits}: {render.counted(8.0**grid.bits, 'cell')}"),
                ("edge", render.metres(grid.edge)),
                ("origin", f"({origin}) m"),
                ("curve", grid.curve),
                ("layout", layout),
                ("objects", f"{len(objects):,}"),
                ("scene", "nothing in it" if scene is None else render.box(scene)),
                ("voxels", f"{voxels:,}"),
                ("rows", f"{size.rows:,}"),
                ("size", f"{render.bytes_text(size.bytes)}{a_voxel}"),
                ("checksums", "of pages" if has_checksums else NO_CHECKSUMS),
                ("statistics", f"{SOURCES[quantiles.source]}; {_age(freshness)}"),
            ]
        )
    )


def objects(
    url: Url,
    *,
    name: Annotated[
        list[str] | None,
        typer.Option(metavar="ID|NAME", help="Only these: 7 or 3,4 or 'wheel*'; again for more."),
    ] = None,
    box: Annotated[
        Corners | None,
        typer.Option(
            metavar="X0 Y0 Z0 X1 Y1 Z1", help="Only those whose bounds meet this box, metres."
        ),
    ] = None,
    sort: Annotated[
        Order, typer.Option(help="By name; or by voxels or longest side, the largest first.")
    ] = "id",
    reverse: Annotated[bool, typer.Option("--reverse", help="The other way round.")] = False,
    limit: Annotated[
        int | None,
        typer.Option(
            metavar="N",
            help="Objects on a page; 0: all.",
            show_default=f"{PAGE} on a terminal, all in a pipe",
        ),
    ] = None,
    page: Annotated[int | None, typer.Option(metavar="N", help="Which page, from 1.")] = None,
    json: Json = False,
) -> None:
    """List the objects of an environment.

    Verbs take objects by id, by name and by pattern. A name is a path, such as
    body/door/handle. One without / fits any element of a path, one with / the
    path from its start; where it ends at a sub-assembly, it means all below.
    In a pattern * stands for anything, ? for one character, [ab] for a or b;
    case counts.

    Example: hapticdb objects car.db

    Example: hapticdb objects car.db --name 'wheel*' --sort voxels --limit 10
    """
    from contextlib import closing

    from hapticdb.errors import ObjectNotFoundError
    from hapticdb.store.connect import open_store

    with closing(open_store(url, read_only=True)) as env:
        shown = env.url
        try:
            found = selected(env, name, box, sort, reverse=reverse)
        except ObjectNotFoundError as error:
            raise ObjectNotFoundError(f"--name: {error}") from None
    is_whole = json and limit is None and page is None
    part = page_of(found, 0 if is_whole else limit, page)
    if json:
        for obj in part.objects:
            render.say_json(record_of(obj))
        return
    if not found:
        nothing = f"{shown} is empty; 'hapticdb import URL FILE' fills it"
        render.note(nothing if box is None else f"{shown}: no object meets the box")
        return
    rows = [
        (str(o.id), o.name, f"{o.voxels:,}", size_text(o), Path(o.link).name) for o in part.objects
    ]
    render.show(render.table(("id>", "name", "voxels>", "size, mm>", "file"), rows))
    last = part.first + len(rows) - 1
    if len(rows) < part.total:
        more = "" if last == part.total else f"; --page {last // len(rows) + 1} goes on"
        render.note(
            f"objects {part.first:,} to {last:,} of {part.total:,}{more}, --limit 0 shows all"
        )


def record_of(obj: "Object") -> dict[str, object]:
    """One object as JSON knows it: metres, world frame."""
    return {
        "id": obj.id,
        "name": obj.name,
        "link": obj.link,
        "voxels": obj.voxels,
        "bounds": obj.bounds.tolist(),
        "transform": obj.transform.tolist(),
        "digest": obj.digest,
        "attributes": dict(obj.attributes),
        "revision": obj.revision,
    }


def size_text(obj: "Object") -> str:
    """Sides of an object's bounding box in millimetres: ``1200 x 35 x 4``."""
    return " x ".join(
        f"{1000 * side:.3g}" if side < 1 else f"{1000 * side:.0f}"
        for side in (obj.bounds[1] - obj.bounds[0]).tolist()
    )


def calibrate(
    url: Url,
    *,
    cold: Annotated[
        bool,
        typer.Option(
            "--cold", help="With empty caches, on SQLite; these figures are then the ones kept."
        ),
    ] = False,
    json: Json = False,
) -> None:
    """Measure what statements, descents and rows cost on this database and machine.

    The figures are kept in the environment; the strategies cbgroup and auto decide by them.

    Example: hapticdb calibrate car.db
    """
    import hapticdb
    from hapticdb.errors import ReadOnlyError

    try:
        env = hapticdb.open(url)
        is_kept = True
    except ReadOnlyError:
        env = hapticdb.open(url, read_only=True)
        is_kept = False
    with env:
        render.compile_kernels("calibrate")
        costs = env.calibrate(cold=cold)
        rows = env.size().rows
    if not is_kept:
        render.note(f"{env.url} can only be read: the figures were measured, and not kept")
    if json:
        figures = {name: getattr(costs, name) for name in (*MEANINGS, *RATIOS)}
        render.say_json({"figures": figures, "spread": dict(costs.spread), "kept": is_kept})
        return
    render.show(_costs_table(costs))
    worth = costs.descent / costs.row_in_gap if costs.row_in_gap else None
    when = "always" if worth is None else f"when it should hold fewer than {worth:.1f} rows"
    render.say(
        f"{render.counted(rows, 'row')}, {costs.rows_per_block:.0f} in a leaf block; "
        f"a gap is scanned {when}"
    )


def analyze(url: Url, *, json: Json = False) -> None:
    """Renew the statistics of the keys, by which cbgroup and auto expect how many rows a gap holds.

    An import does so at its end, PostgreSQL's autovacuum now and then: this
    is for after many edits.

    Example: hapticdb analyze car.db
    """
    import hapticdb

    with hapticdb.open(url) as env:
        before = env.freshness()
        found = env.analyze()
    if json:
        render.say_json(
            {
                "source": found.source,
                "buckets": found.resolution,
                "rows": found.n_rows,
                "before": before._asdict(),
            }
        )
        return
    render.say(
        f"{env.url}: {SOURCES[found.source]}, {render.counted(found.resolution, 'bucket')} over "
        f"{render.counted(found.n_rows, 'row')}; before: {_age(before)}"
    )


def _age(freshness: "Freshness") -> str:
    """Put the age of statistics in words."""
    if freshness.revision is None:
        return "none made yet"
    if not freshness.changes:
        return "fresh"
    return f"{render.counted(freshness.changes, 'write')} behind"


def _costs_table(costs: "CostModel") -> Columns:
    rows = []
    for name, meaning in MEANINGS.items():
        spread = costs.spread.get(name)
        known = "" if spread is None else f"± {100 * spread:.0f} %"
        rows.append((name, f"{getattr(costs, name):.3f}", known, meaning))
    return render.table(("figure", "µs>", "spread>", "what it is"), rows)
