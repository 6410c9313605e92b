"""Verbs without input: sample, demo."""

from collections import Counter
from pathlib import Path
from shlex import quote
from typing import TYPE_CHECKING

import typer

from hapticdb.cli import render

if TYPE_CHECKING:
    from hapticdb.demo import DemoScene, Imported, LayoutFigures


def sample(folder: Path, *, frames: int = 1000) -> None:
    """Write sample files: car.glb, spanner.stl, path.csv, rules.toml.

    The path slides the spanner over the car; the rules leave one clash of its parts open.

    Example: hapticdb sample sample
    """
    from hapticdb.sample import write_sample

    for path in write_sample(folder, frames):
        render.say(str(path))


def demo(
    folder: Path = Path("demo"), *, bits: int = 10, frames: int = 1000, points: int = 300
) -> None:
    """Answer four questions about a car, draw it, then compare all strategies.

    Example: hapticdb demo demo --bits 11
    """
    import numpy as np

    from hapticdb.demo import answers, compare, prepare
    from hapticdb.pictures.demo_picture import draw

    render.note(f"writing the sample into {folder}, importing it ...")
    with render.import_bar() as progress:
        scene = prepare(folder, bits=bits, frames=frames, points=points, progress=progress)
    render.facts([("car", _import_text(scene.imported)), ("grid", scene.grid_text)])
    found = answers(scene)
    picture = folder / "demo.png"
    draw(picture, scene, found)
    url = quote(scene.imported.url)
    view = f"{render.program()} view {url}"
    render.facts([*found.lines, ("picture", str(picture)), ("see and feel it", view)])
    render.note("importing it in the paper's layout, too, and comparing all strategies ...")
    with render.import_bar() as progress:
        comparison = compare(scene, progress)
    for measured in comparison.layouts:
        _show_layout(measured, scene, float(np.median(found.hits)))
    for line in ("", comparison.against_paper(), comparison.verdict):
        render.say(line)
    if comparison.disagreed:
        raise typer.Exit(1)


def _import_text(one: "Imported") -> str:
    size = render.counts(object=one.objects, voxel=one.voxels, row=one.rows)
    size += f", {render.bytes_text(one.bytes)}"
    if not one.is_new:
        return f"{one.url}: {size}; there already"
    rate = render.counted(one.voxels / one.seconds, "voxel")
    return f"{one.url}: {size}; {one.seconds:.1f} s, {rate} a second"


def _show_layout(measured: "LayoutFigures", scene: "DemoScene", hits: float) -> None:
    import numpy as np

    from hapticdb.demo import YARDSTICK

    base = measured.median_us(YARDSTICK)
    rows = []
    for name, queries in measured.queries.items():
        _, statements, ranges, n_rows, elapsed = zip(*queries, strict=True)
        median, p99 = np.percentile(elapsed, [50, 99])
        counts = (f"{np.mean(counts):.0f}" for counts in (statements, ranges, n_rows))
        rows.append((name, f"{median:.0f}", f"{p99:.0f}", *counts, f"{base / median:.1f}"))
    keys = np.median([query.ranges for query in measured.queries[YARDSTICK]])
    one = measured.imported
    render.say()
    render.say(f"{one.engine}, {one.layout} layout, {render.counted(one.rows, 'row')}; warm")
    medians = f"{keys:.0f} distinct keys, {hits:.0f} hits (medians)"
    render.say(f"a frame: {len(scene.shell)} points, {medians}; strategies in turns")
    columns = ("strategy", "median µs>", "p99 µs>", "statements>", "ranges>", "rows>", "x faster>")
    render.table(columns, rows)
    used = Counter(query.strategy for query in measured.queries["auto"])
    render.say(f"auto chose {render.shares(used)}")
