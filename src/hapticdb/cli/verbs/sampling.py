"""Verbs without input: sample, demo."""

from collections import Counter
from pathlib import Path
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
    """Make, import, touch and draw the sample.

    Example: hapticdb demo demo --bits 11
    """
    from shlex import quote

    import numpy as np

    from hapticdb.demo import compare, prepare
    from hapticdb.pictures.demo import draw

    render.note(f"writing the sample into {folder}, importing it in both layouts ...")
    with render.import_bar() as progress:
        scene = prepare(folder, bits=bits, frames=frames, points=points, progress=progress)
    _show_scene(scene)
    comparison = compare(scene)
    for measured in comparison.layouts:
        _show_layout(measured, scene, float(np.median(comparison.trace.hits)))
    render.say(f"\n{comparison.against_paper()}")
    render.say(comparison.verdict)
    picture = folder / "demo.png"
    draw(picture, scene, comparison)
    render.say(f"picture: {picture}")
    url = quote(scene.imported[0].url)
    render.say(f"see it and feel it in a browser: {render.program()} view {url}")
    if comparison.disagreed:
        raise typer.Exit(1)


def _show_scene(scene: "DemoScene") -> None:
    rows = [
        ("sample", ", ".join(str(path) for path in scene.files)),
        ("grid", scene.grid_text),
    ]
    rows += [(f"import, {one.layout}", _import_text(one)) for one in scene.imported]
    rows.append(("tool", f"{len(scene.shell)} points, {len(scene.poses):,} poses"))
    render.facts(rows)


def _import_text(one: "Imported") -> str:
    size = (
        f"{render.counted(one.objects, 'object')}, {render.counted(one.voxels, 'voxel')}, "
        f"{render.counted(one.rows, 'row')}, {render.bytes_text(one.bytes)}"
    )
    if not one.is_new:
        return f"{one.url}: {size}; there already"
    rate = render.counted(one.voxels / one.seconds, "voxel")
    return f"{one.url}: {size}; {one.seconds:.1f} s, {rate} a second"


def _show_layout(measured: "LayoutFigures", scene: "DemoScene", hits: float) -> None:
    import numpy as np

    from hapticdb.demo import YARDSTICK

    base = measured.median_us(YARDSTICK)
    rows = []
    for name, queries in measured.felt.items():
        _, statements, ranges, n_rows, elapsed = zip(*queries, strict=True)
        median, p99 = np.percentile(elapsed, [50, 99])
        counts = (f"{np.mean(asked):.0f}" for asked in (statements, ranges, n_rows))
        rows.append((name, f"{median:.0f}", f"{p99:.0f}", *counts, f"{base / median:.1f}"))
    keys = np.median([query.ranges for query in measured.felt[YARDSTICK]])
    one = measured.imported
    render.say(
        f"\n{one.engine}, {one.layout} layout, {render.counted(one.rows, 'row')}; "
        "warm, strategies in turns\n"
        f"a frame: {len(scene.shell)} points, {keys:.0f} distinct keys, {hits:.0f} hits (medians)\n"
    )
    columns = ("strategy", "median µs>", "p99 µs>", "statements>", "ranges>", "rows>", "x faster>")
    render.table(columns, rows)
    used = Counter(query.strategy for query in measured.felt["auto"])
    render.say(f"auto chose {render.shares(used)}")
