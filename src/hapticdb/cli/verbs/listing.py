"""The verbs that look at an environment: info, objects."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NamedTuple, Self

import typer

from hapticdb.cli import fitting, render
from hapticdb.cli.columns import Columns
from hapticdb.cli.options import JsonOption, UrlArgument
from hapticdb.cli.pages import PAGE, Corners, ListingPage, Order, page_of, selected

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from hapticdb.grid import Grid
    from hapticdb.query.cost_model import CostModel
    from hapticdb.store.base import Freshness, Layout, Object, Size, Store
    from hapticdb.store.engines import Lag

MEANINGS = {
    "statement": "a statement of ranges, without what it reads",
    "descent": "each range of a statement: a descent of the index",
    "block": "each leaf block scanned in the engine",
    "row": "each row handed to the client",
}
"""Figures of a cost model that are times, microseconds, and what each is the time of."""
RATIOS = ("rows_per_block", "caution", "distances")
"""Figures of a cost model that are ratios, and not times."""
SOURCES = {
    "server statistics": "the server's own statistics",
    "kept": "computed and kept",
    "computed": "computed when needed",
}
"""Where the statistics of the keys come from, in words."""

NameOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="WORDS",
        help="Only these objects: 7 or 3,4, 'wheel*', attribute=value. Give it again for more.",
    ),
]
BoxOption = Annotated[
    Corners | None,
    typer.Option(
        metavar="X0 Y0 Z0 X1 Y1 Z1", help="Only objects whose bounding boxes meet this box, metres."
    ),
]
SortOption = Annotated[
    Order, typer.Option(help="By id or name; or by voxels or longest side, the largest first.")
]
ReverseOption = Annotated[bool, typer.Option("--reverse", help="Reverse the order.")]
LimitOption = Annotated[
    int | None,
    typer.Option(
        metavar="N",
        help="Objects on a page; 0: all.",
        show_default=f"{PAGE} on a terminal, all in a pipe",
    ),
]
PageOption = Annotated[int | None, typer.Option(metavar="N", help="Which page, from 1.")]

CalibrateOption = Annotated[
    bool,
    typer.Option("--calibrate", help="Measure what queries cost on this machine, and keep it."),
]
ColdOption = Annotated[
    bool,
    typer.Option("--cold", help="With --calibrate: measure with empty caches, on SQLite."),
]


def info(
    url: UrlArgument,
    *,
    calibrate: CalibrateOption = False,
    cold: ColdOption = False,
    json: JsonOption = False,
) -> None:
    """Show an environment's engine, grid, layout, scene, size and statistics.

    With --calibrate, what statements, descents and rows cost is measured, and
    the statistics are renewed. The figures are kept in the environment; the
    strategies cbgroup and auto decide by them.

    Example: hapticdb info car.db --calibrate
    """
    from contextlib import closing

    from hapticdb.errors import UsageError
    from hapticdb.store.connect import open_store

    if cold and not calibrate:
        raise UsageError("--cold belongs to --calibrate: give it, too")
    measured = _measured(url, cold=cold) if calibrate else None
    # the store: an Environment brings what touches and imports, a tenth of a second
    with closing(open_store(url, read_only=True)) as store:
        looked_at = _Overview.of(store)
    if json:
        costs = {} if measured is None else {"costs": _costs_record(*measured)}
        render.say_json(looked_at.record() | costs)
        return
    render.show(render.facts(looked_at.facts()))
    if measured is not None:
        _show_costs(measured[0])


class _Overview(NamedTuple):
    """What `info` tells of an environment."""

    url: str
    name: str
    engine: str
    grid: "Grid"
    layout: "Layout"
    size: "Size"
    n_objects: int
    n_with_distances: int
    voxels: int
    scene: "NDArray[np.float64] | None"
    freshness: "Freshness"
    source: str
    lag: "Lag | None"

    @classmethod
    def of(cls, store: "Store") -> Self:
        """Ask a store."""
        from hapticdb.query.quantiles import DEFAULT_RESOLUTION, QuantileVector
        from hapticdb.store.base import scene_bounds
        from hapticdb.store.engines import MayLag

        objects = store.objects()
        return cls(
            url=store.url,
            name=store.name,
            engine=store.engine,
            grid=store.grid,
            layout=store.layout,
            size=store.size(),
            n_objects=len(objects),
            n_with_distances=sum(obj.has_distances for obj in objects),
            voxels=sum(obj.voxels for obj in objects),
            scene=scene_bounds(objects),
            freshness=store.freshness(DEFAULT_RESOLUTION),
            source=QuantileVector.of(store, DEFAULT_RESOLUTION).source,
            lag=store.lag() if isinstance(store, MayLag) else None,
        )

    @property
    def has_distances(self) -> bool:
        """Whether every object has distances, and there is one."""
        return 0 < self.n_with_distances == self.n_objects

    @property
    def _distances(self) -> str:
        """Put in words which objects have distances, and what these take."""
        if not self.n_with_distances:
            return "none"
        whose = "all objects"
        if not self.has_distances:
            whose = f"{self.n_with_distances:,} of {render.counted(self.n_objects, 'object')}"
        band = self.size.band_bytes
        return f"of {whose}: {self.size.band_rows:,} rows, {render.bytes_text(band)}"

    @property
    def fit(self) -> fitting.Accuracy | None:
        """Accuracy of fit under the smooth law; None where that law cannot be felt."""
        return fitting.accuracy_at(self.grid.voxel_size) if self.has_distances else None

    def record(self) -> dict[str, object]:
        """Put it in JSON."""
        return {
            "name": self.name,
            "engine": self.engine,
            "voxel_size": self.grid.voxel_size,
            "bits": self.grid.bits,
            "origin": list(self.grid.origin),
            "curve": self.grid.curve,
            "layout": self.layout,
            "objects": self.n_objects,
            "scene": render.box_record(self.scene),
            "voxels": self.voxels,
            "rows": self.size.rows,
            "bytes": self.size.bytes,
            "distances": {
                "objects": self.n_with_distances,
                "rows": self.size.band_rows,
                "bytes": self.size.band_bytes,
            },
            "standby": None if self.lag is None else self.lag._asdict(),
            "fit": None if self.fit is None else self.fit._asdict(),
            "statistics": {"source": self.source, **self.freshness._asdict()},
        }

    def facts(self) -> list[tuple[str, str]]:
        """Put it in words."""
        grid, size = self.grid, self.size
        origin = ", ".join(f"{x:.6g}" for x in grid.origin)
        a_voxel = f" ({size.bytes / self.voxels:.3g} a voxel)" if self.voxels else ""
        return [
            ("environment", self.url),
            ("name", self.name),
            ("engine", self.engine),
            *([] if self.lag is None else [("standby", _lag_text(self.lag))]),
            ("voxel size", render.metres(grid.voxel_size)),
            ("bits an axis", f"{grid.bits}: {render.counted(8.0**grid.bits, 'cell')}"),
            ("edge", render.metres(grid.edge)),
            ("origin", f"({origin}) m"),
            ("curve", grid.curve),
            ("layout", self.layout),
            ("objects", f"{self.n_objects:,}"),
            ("scene", "nothing in it" if self.scene is None else render.box(self.scene)),
            ("voxels", f"{self.voxels:,}"),
            ("rows", f"{size.rows:,}"),
            ("size", f"{render.bytes_text(size.bytes)}{a_voxel}"),
            ("distances", self._distances),
            *(self.fit.facts if self.fit is not None else ()),
            ("statistics", f"{SOURCES[self.source]}; {_age(self.freshness)}"),
        ]


def _lag_text(lag: "Lag") -> str:
    """Put in words how far a standby is behind."""
    age = "none yet" if lag.seconds is None else f"{lag.seconds:.3g} s old"
    return f"replayed to {lag.replayed}, the last commit there: {age}"


def objects(
    url: UrlArgument,
    *,
    name: NameOption = None,
    box: BoxOption = None,
    sort: SortOption = "id",
    reverse: ReverseOption = False,
    limit: LimitOption = None,
    page: PageOption = None,
    json: JsonOption = False,
) -> None:
    """List the objects of an environment.

    Verbs take objects by id, by name, by pattern and by attribute. A name is a path, such as
    body/door/handle. A name without / fits any element of a path, a name with /
    the path from its start. The name of a sub-assembly means all objects below it.
    In a pattern * stands for anything, ? for one character, [ab] for a or b;
    case counts. attribute=value chooses the objects that have that attribute; the
    value may be a pattern, and outer.inner=value names one inside another. A word
    with = that fits the name of an object chooses that name.

    Example: hapticdb objects car.db

    Example: hapticdb objects car.db --name 'wheel*' --sort voxels --limit 10

    Example: hapticdb objects car.db --name up=z
    """
    from contextlib import closing

    from hapticdb.errors import ObjectNotFoundError
    from hapticdb.store.connect import open_store

    with closing(open_store(url, read_only=True)) as store:
        shown_url = store.url
        try:
            found = selected(store, name, box, sort, reverse=reverse)
        except ObjectNotFoundError as error:
            raise ObjectNotFoundError(f"--name: {error}") from None
    is_whole = json and limit is None and page is None
    part = page_of(found, 0 if is_whole else limit, page)
    if json:
        for obj in part.objects:
            render.say_json(record_of(obj))
    elif found:
        _show_page(part)
    elif box is None:
        render.note(f"{shown_url} is empty; 'hapticdb import URL FILE' fills it")
    else:
        render.note(f"{shown_url}: no object meets the box")


def _show_page(page: ListingPage) -> None:
    """Print a page as a table, and where the next one begins."""
    rows = [
        (str(o.id), o.name, f"{o.voxels:,}", size_text(o), Path(o.link).name) for o in page.objects
    ]
    render.show(render.table(("id>", "name", "voxels>", "size, mm>", "file"), rows))
    last = page.first + len(rows) - 1
    if len(rows) < page.total:
        more = "" if last == page.total else f"; --page {last // len(rows) + 1} goes on"
        render.note(
            f"objects {page.first:,} to {last:,} of {page.total:,}{more}, --limit 0 shows all"
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


def _measured(url: str, *, cold: bool) -> "tuple[CostModel, bool]":
    """Costs as measured now, and whether they are kept; renews the statistics, too, if it may."""
    from contextlib import suppress

    import hapticdb
    from hapticdb.errors import AccessError, ReadOnlyError

    try:
        env = hapticdb.open(url)
        is_kept = True
    except ReadOnlyError:
        env = hapticdb.open(url, read_only=True)
        is_kept = False
    with env:
        render.compile_kernels("calibrate")
        if is_kept:
            with suppress(AccessError):  # a role may keep costs only
                env.analyze()
        costs = env.calibrate(cold=cold)
    if not is_kept:
        render.note(f"{env.url} can only be read: the figures were measured, and not kept")
    return costs, is_kept


def _costs_record(costs: "CostModel", is_kept: bool) -> dict[str, object]:  # noqa: FBT001 - private
    known = costs.figures()
    figures = {name: known[name] for name in (*MEANINGS, *RATIOS)}
    return {"figures": figures, "spread": dict(costs.spread), "kept": is_kept}


def _show_costs(costs: "CostModel") -> None:
    render.show(_costs_table(costs))
    worth = costs.descent / costs.row_in_gap if costs.row_in_gap else None
    when = "always" if worth is None else f"when it should hold fewer than {worth:.1f} rows"
    render.say(f"{costs.rows_per_block:.0f} rows in a leaf block; a gap is scanned {when}")


def _age(freshness: "Freshness") -> str:
    """Put the age of statistics in words."""
    if freshness.revision is None:
        return "none made yet"
    if not freshness.changes:
        return "fresh"
    return f"{render.counted(freshness.changes, 'write')} behind"


def _costs_table(costs: "CostModel") -> Columns:
    rows = []
    figures = costs.figures()
    for name, meaning in MEANINGS.items():
        spread = costs.spread.get(name)
        known = "" if spread is None else f"± {100 * spread:.0f} %"
        rows.append((name, f"{figures[name]:.3f}", known, meaning))
    return render.table(("figure", "µs>", "spread>", "what it is"), rows)
