"""Invented results of an evaluation, for tests of its pages: formulas that look like timings."""

import math
from collections.abc import Iterator
from typing import Any

Cell = dict[str, Any]
ENGINES = {"SQLite 3.51.0": 1.0, "PostgreSQL 15.18": 3.2, "PostgreSQL 18.6": 2.6}
GAPS = (0, 1, 10, 100, 300, 1000, 3000, 10_000, 100_000, 1_000_000)
BASE: Cell = {
    "environment": "sample",
    "curve": "z-order",
    "cache": "4 MB",
    "file": "cached",
    "poses": "slide",
    "shell": "sphere",
    "points": 300,
    "resolution": 10_000,
}


def spread(typical: float, frames: int = 1000) -> dict[str, float | None]:
    """Percentiles around a typical time."""
    shares = {"p10": 0.8, "p50": 0.98, "p90": 1.3, "p99": 2.1, "max": 9.0}
    found: dict[str, float | None] = {name: share * typical for name, share in shares.items()}
    slowest = 4.2 * typical if frames >= 10_000 else None
    return {"mean": 1.1 * typical, "typical": typical, **found, "p99.9": slowest}


def cell(typical: float, frames: int = 1000, **own: Any) -> Cell:  # noqa: ANN401 - a cell holds anything
    return {
        **BASE,
        "frames": frames,
        "cut_short": frames < 1000,
        "us": spread(typical, frames),
        **own,
    }


def curve_cells(
    engine: str, layout: str, *, looped: bool = False, dense: float = 1.0
) -> Iterator[Cell]:
    """MaxGap over all MAXGAP, and CBGroup."""
    slow = ENGINES[engine]
    room = 1 if layout == "brick" else 6
    form = "loop in the server" if looped else "one statement"
    a_range = 9.0 if looped else 1.5
    for gap in GAPS:
        ranges = 3 + 200 / (1 + gap / 120 * dense)
        false = room * dense * 9 * math.log1p(gap) ** 1.6 + gap / 900
        us = slow * (40 + a_range * ranges + 0.35 * (60 + false))
        yield cell(
            us,
            frames=220 if gap == GAPS[-1] else 1000,
            engine=engine,
            layout=layout,
            strategy="maxgap",
            maxgap=gap,
            form=form,
            ranges=ranges,
            rows=60 + false,
            false_rows=false,
        )
    us = slow * (40 + a_range * 38 + 0.35 * (60 + 120 * room * dense))
    yield cell(
        us,
        engine=engine,
        layout=layout,
        strategy="cbgroup",
        form=form,
        ranges=38.0,
        rows=60 + 120.0 * room,
        false_rows=120.0 * room,
        grouping_us=6.0,
    )


def strategy_cells(engine: str, layout: str, **own: Any) -> Iterator[Cell]:  # noqa: ANN401
    factor = own.pop("factor", 1.0) * ENGINES[engine] * (1 if layout == "brick" else 2.2)
    bases = {
        "points": 1500,
        "statement": 420,
        "array": 90 if engine.endswith("18.6") else 130,
        "maxgap": 118,
        "cbgroup": 111,
        "auto": 108,
    }
    for strategy, us in bases.items():
        if strategy == "points" and own.get("points", 300) > 1000:
            continue
        more: Cell = {"chosen": {"cbgroup": 900, "array": 100}} if strategy == "auto" else {}
        more |= {"maxgap": 500} if strategy == "maxgap" else {}
        yield cell(us * factor, engine=engine, layout=layout, strategy=strategy, **{**own, **more})


def both() -> list[tuple[str, str]]:
    return [(engine, layout) for layout in ("voxel", "brick") for engine in ENGINES]


def figure8() -> Iterator[Cell]:
    for engine, layout in both():
        for n in (10, 100, 1000, 10_000, 100_000):
            us = ENGINES[engine] * (95 + 300 / math.sqrt(n)) * (1 if layout == "brick" else 2.2)
            grouping = 4 + 1.2 * math.log(n)
            yield cell(
                us + grouping,
                engine=engine,
                layout=layout,
                strategy="cbgroup",
                resolution=n,
                grouping_us=grouping,
            )


def figure9() -> Iterator[Cell]:
    for cache in ("all cached", "4 MB"):
        for engine, layout in both():
            cells = list(curve_cells(engine, layout))
            if engine.startswith("P"):
                cells += curve_cells(engine, layout, looped=True)
            cells.append(
                cell(130 * ENGINES[engine], engine=engine, layout=layout, strategy="array")
            )
            yield from ({**one, "cache": cache} for one in cells)


def figure10() -> Iterator[Cell]:
    for engine, layout in both():
        for region, dense in (("high", 2.0), ("low", 0.5), ("middle", 1.0)):
            for one in curve_cells(engine, layout, dense=dense):
                yield {**one, "region": region, "density": 0.012 * dense}


def conditions() -> Iterator[Cell]:
    caches = (("4 MB", "cached", 1.0), ("all cached", "cached", 0.8), ("4 MB", "cold", 14.0))
    for engine, layout in both():
        for cache, file, factor in caches:
            for one in strategy_cells(engine, layout, factor=factor, cache=cache, file=file):
                if one["strategy"] in {"array", "maxgap", "cbgroup", "auto"}:
                    yield one


def strategies() -> Iterator[Cell]:
    for poses, shell in (("slide", "sphere"), ("random", "sphere"), ("recorded", "wrench")):
        for engine, layout in both():
            yield from strategy_cells(engine, layout, poses=poses, shell=shell)


def layouts() -> Iterator[Cell]:
    curves = {"z-order": 1.0, "hilbert": 0.93, "lexicographic": 1.7}
    for engine, layout in both():
        for curve, factor in curves.items():
            if layout == "voxel" or curve != "lexicographic":
                for one in strategy_cells(engine, layout, factor=factor, curve=curve):
                    if one["strategy"] in {"array", "cbgroup", "auto"}:
                        yield one


def points() -> Iterator[Cell]:
    for engine, layout in both():
        for n in (300, 1000, 10_000, 100_000):
            yield from strategy_cells(engine, layout, factor=(n / 300) ** 0.8, points=n)


def tail() -> Iterator[Cell]:
    for engine, layout in both():
        for one in strategy_cells(engine, layout):
            if one["strategy"] in {"array", "cbgroup", "auto"}:
                us = one["us"]["typical"]
                yield {**one, "frames": 20_000, "us": spread(us, 20_000)}


def peers() -> Iterator[Cell]:
    same, hits = "the same hits and wrench", "the same hits"
    known = {
        "dense bitmap": (same, 3.0, 0.4, {"memory_bytes": 1 << 30}),
        "hapticdb, SQLite, bricks, auto": (same, 70.0, 40.0, {"file_bytes": 30 << 20}),
        "hapticdb, PostgreSQL 18, bricks, auto": (same, 190.0, 60.0, {"file_bytes": 60 << 20}),
        "NumPy searchsorted": (hits, 25.0, 2.0, {"memory_bytes": 100 << 20}),
        "Python set": (hits, 60.0, 4.0, {"memory_bytes": 900 << 20}),
        "LMDB": (hits, 150.0, 9.0, {"file_bytes": 200 << 20}),
        "DuckDB": (hits, 1100.0, 8.0, {"file_bytes": 90 << 20}),
        "Open3D occupancy": ("inside a closed surface, not on it", 94.0, 1.0, {}),
        "coal": ("contacts of mesh with mesh", 9400.0, 3.0, {}),
    }
    for peer, (question, us, build_s, size) in known.items():
        agree = 1.0 if question.startswith("the same") else None
        yield cell(
            us, peer=peer, question=question, build_s=build_s, hits_agree=agree, hits=21.0, **size
        )


def voxelizing() -> Iterator[Cell]:
    for tool, speed in (("Open3D", 7e5), ("hapticdb", 3.1e6), ("trimesh", 9e4)):
        yield {
            "environment": "sample",
            "tool": tool,
            "parts": 200,
            "object_voxels": 13_500_000,
            "seconds": 13.5e6 / speed,
            "voxels_per_second": speed,
        }


def scale() -> Iterator[Cell]:
    for engine in ("SQLite 3.51.0", "PostgreSQL 18.6"):
        for step, voxels in enumerate((1.4e6, 1.4e7, 1.4e8, 1.4e9)):
            for poses, factor in (("slide", 1.0), ("random", 1.0 + 0.4 * step)):
                for one in strategy_cells(engine, "brick", factor=factor, poses=poses):
                    if one["strategy"] in {"array", "cbgroup", "auto"}:
                        yield {
                            **one,
                            "copies": 10**step,
                            "object_voxels": int(voxels),
                            "rows": voxels / 40,
                            "bytes": int(voxels * 2 * ENGINES[engine]),
                            "bytes_per_voxel": 2.0 * ENGINES[engine] - 0.1 * step,
                            "import_s": voxels / 4e6,
                        }


def table1() -> Iterator[Cell]:
    known = (
        ("sample", 206, 11, 1.6),
        ("demo_vintage_car", 200, 11, 1.6),
        ("assembly_vw_t1", 1428, 11, 2.4),
    )
    for name, objects, bits, extent in known:
        yield {
            "environment": name,
            "objects": objects,
            "object_voxels": 13_500_000,
            "distinct_voxels": 12_800_000,
            "bits": bits,
            "cells_of_space": 8**bits,
            "extent": extent,
            "bytes_brick": 25_000_000,
            "rows_brick": 480_000,
        }


def costs() -> Iterator[Cell]:
    """Fitted figures of every engine and layout."""
    for engine, slow in ENGINES.items():
        for layout in ("brick", "voxel"):
            yield {
                **{name: BASE[name] for name in ("environment", "curve", "cache", "file")},
                "engine": engine,
                "layout": layout,
                "statement": 40 * slow,
                "descent": 0.6 * slow,
                "row_scanned": 0.4,
                "lookup": 38 * slow,
                "probe": 0.3 * slow,
                "caution": 2.0,
                "gap_rows": 0.75 * slow,
            }


MAKERS = {
    "table1": table1,
    "costs": costs,
    "figure8": figure8,
    "figure9": figure9,
    "figure10": figure10,
    "conditions": conditions,
    "strategies": strategies,
    "layouts": layouts,
    "points": points,
    "tail": tail,
    "peers": peers,
    "voxelizing": voxelizing,
    "scale": scale,
}


def everything() -> dict[str, dict[str, Any]]:
    """A full set, as `make figures` leaves it."""
    return {
        name: {
            "name": name,
            "commit": "0123abc",
            "machine": {"processor": "made up", "cores": 2, "memory": "8 GB"},
            "versions": {"SQLite": "3.51.0", "PostgreSQL": ["15.18", "18.6"]},
            "inputs": {"seed": 20, "poses": 1000, "window": 64},
            "notes": ["not measured: Apache Nowhere: not installed"] if name == "peers" else [],
            "cells": list(make()),
        }
        for name, make in MAKERS.items()
    }
