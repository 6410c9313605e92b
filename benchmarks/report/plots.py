"""The plots of the evaluation: those of `hapticdb bench`, and curves, peers, voxelizing, scale."""

from hapticdb.bench.cells import number, word
from hapticdb.bench.drawing.draw import KINDS
from hapticdb.bench.drawing.plots import PlotKind, has_median, has_time
from report.layout_plots import draw_layouts
from report.peer_plots import draw_peers, draw_scale, draw_voxelizing

REPORT_KINDS = (
    *KINDS,
    PlotKind("layouts", "layouts", "Curves and layouts", ("curve",), has_time, draw_layouts),
    PlotKind(
        "peers",
        "peers",
        "hapticdb beside its peers",
        ("cache", "file", "curve"),
        lambda cell: has_median(cell) and bool(word(cell, "peer")),
        draw_peers,
    ),
    PlotKind(
        "voxelizing",
        "voxelizing",
        "Voxelizing CAD parts",
        (),
        lambda cell: (number(cell, "voxels_per_second") or 0) > 0,
        draw_voxelizing,
    ),
    PlotKind(
        "scale",
        "scale",
        "Time a frame and storage against the environment's size",
        ("environment", "poses"),
        lambda cell: (number(cell, "object_voxels") or 0) > 0,
        draw_scale,
    ),
)
"""What the evaluation draws."""
