"""The measures: what each one is, how it is taken, and what is wanted of the smooth law."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from hapticdb.bench.markdown import NONE

Cell = Mapping[str, Any]


@dataclass(frozen=True)
class Measure:
    """One line of the table.

    key : name of its cells; title : what is measured, with the cases that its values stand for;
    how : definition, by which a reader can repeat it; unit : after the values; percent : whether
    values are shares, shown as percentages; wanted : in words; limits : of each value, or one for
    all of them; none where nothing is demanded; is_floor : whether limits are least values.
    """

    key: str
    title: str
    how: str
    wanted: str = ""
    limits: Sequence[float] = ()
    unit: str = "N"
    percent: bool = False
    is_floor: bool = False

    def missed(self, cell: Cell) -> bool:
        """Whether a cell has a value beyond its limit."""
        values = list(cell["values"])
        limits = list(self.limits)
        if not limits or not values:
            return False
        limits = limits * len(values) if len(limits) == 1 else limits
        pairs = zip(values, limits, strict=True)
        if self.is_floor:
            return any(not value >= limit for value, limit in pairs)
        return any(not value <= limit for value, limit in pairs)

    def text(self, cell: Cell | None) -> str:
        """Values of a cell with their unit; a dash without values."""
        if cell is None or not cell["values"]:
            return NONE
        factor, unit = (100.0, "%") if self.percent else (1.0, self.unit)
        numbers = " / ".join(number_text(factor * value) for value in cell["values"])
        said = f"{numbers} {unit}".strip()
        if cell.get("unfelt"):
            return f"{said}; nothing felt in {cell['unfelt']:,} of {cell['slides']:,}"
        return f"{said}; nearest {number_text(cell['nearest'])}" if "nearest" in cell else said


def number_text(value: float) -> str:
    """A number with three digits at most; what is below a millionth is 0."""
    if not math.isfinite(value):
        return "none"
    if abs(value) < 1e-6:
        return "0" if value == 0.0 else f"{value:.0e}"
    if abs(value) >= 99.5:
        return f"{value:,.0f}"
    return f"{value:.2g}" if abs(value) < 9.95 else f"{value:.3g}"


MEASURES: Sequence[Measure] = (
    Measure(
        "touch_ripple",
        "`touch`: ripple on planes, 9 / 100 / 289 points",
        "Standard deviation over mean of the normal force, while a flat tool slides 10 voxels at a "
        "constant true depth. The worst of 28 planes (0, 5, 20, 45 degrees to the grid, 24 turned "
        "at random) and of the depths 0.1, 0.2, 0.35, 0.5, 0.65 and 0.8 voxels. A slide on which "
        "nothing is felt at all has no ripple; it is counted beside.",
        "<= 2 / 1 / 1 %",
        (0.02, 0.01, 0.01),
        percent=True,
    ),
    Measure(
        "touch_step",
        "`touch`: largest step within 0.1 mm, planes, to 0.5 / 0.8 voxels deep",
        "Largest change of the force between two poses 0.1 mm apart, on all these slides; voxels "
        "of 5 mm, K = 1000 N/m. Deeper than half a voxel, some of the 8 centres around a point lie "
        "behind the sheet, where distances grow again, and the distance between them comes out too "
        "large, most of all at 45 degrees. The step is as large on distances that are not rounded "
        "to 8 bits; the average and the share of a point are constant there.",
        "<= 0.05 N",
        (0.05,),
    ),
    Measure(
        "touch_cylinder",
        "`touch`: ripple round a cylinder of 20 voxels",
        "Standard deviation over mean of the size of the force, while a flat tool of 9 points "
        "rolls over one radian of a cylinder at a depth of 0.5 voxels, its points' plane "
        "tangent to it.",
        percent=True,
    ),
    Measure(
        "touch_shape_steps",
        "`touch`: largest step within 0.1 mm, cylinder / convex edge / concave corner",
        "The same step, for that tool on the cylinder, for a flat tool of 100 points that is "
        "pushed over an edge of 90 degrees and off it, and for a ball of 300 points and a radius "
        "of 6 voxels that is drawn along a corner of 90 degrees, all at a depth of 0.5 voxels.",
    ),
    Measure(
        "touch_errors",
        "`touch`: error, cylinder / convex edge / concave corner",
        "Greatest difference from the force of the smooth law over the exact distances of the same "
        "closed form, on these ways, as a share of the largest exact force.",
        percent=True,
    ),
    Measure(
        "session_ripple",
        "session: ripple at 0.5 / 2 / 10 mm",
        "The worst of the same planes and of 9 and 100 points: a hand that is led, at 1 kHz, to "
        "such a depth below the onset of contact, and slides 20 mm at 50 mm/s; the first quarter "
        "of a slide does not count. k = 1000 N/m, voxels of 5 mm.",
        "<= 2 / 1 / 0.2 %",
        (0.02, 0.01, 0.002),
        percent=True,
    ),
    Measure(
        "session_force",
        "session: error of the force at 2 / 5 / 10 mm",
        "Difference of the mean normal force of a slide from k times the hand's depth, as a share "
        "of it; the worst of voxels of 5, 0.5 and 0.116 mm, 9 points, a plane of 20 degrees.",
        "<= 1 %",
        (0.01,),
        percent=True,
    ),
    Measure(
        "session_edge_step",
        "session: largest step round a convex edge, 0.4 / 0.8 voxels deep",
        "Largest change of the force within 0.1 mm of the hand's way, while the hand is led round "
        "an edge of 90 degrees at 50 mm/s, so deep below the onset of contact; the worse of a tool "
        "of one point and a ball of 300 points. At a depth d the force k d turns with the hand, on "
        "a way of radius 1.5 s - d: an exact law changes it by k d 0.1 mm / (1.5 s - d). That is "
        "0.036 N at 0.4 voxels, 0.05 N at half a voxel and 0.11 N at 0.8, whatever the voxel size, "
        "and without bound at 1.5, where the tool must snap from one face to the other. So the "
        "limit is one for up to half a voxel. The ball has more than the point: the edge catches "
        "between its points, and slips to the next gap.",
        "<= 0.05 N up to half a voxel",
        (0.05, math.inf),
    ),
    Measure(
        "session_edge_side",
        "session: side force round a convex edge, 0.4 / 0.8 voxels deep",
        "Largest part of that force across the hand's outward direction, over k times the depth. "
        "The B-spline rounds: near an edge its distances are too large by an eighth of their "
        "curvature, so the surface of contact is 0.09 voxels lower round the edge than over the "
        "faces. The side force of that grows with d / (1.5 s - d).",
        "<= 20 % up to half a voxel",
        (0.20, math.inf),
        percent=True,
    ),
    Measure(
        "session_scale",
        "session: difference at scale 0.1 to 100",
        "The same way of the device in scenes 0.1, 10 and 100 times as large, at that scale: "
        "greatest difference of the device's force from that at scale 1, over the largest force.",
        "<= 1e-4 %",
        (1e-6,),
        percent=True,
    ),
    Measure(
        "session_lift",
        "session: least normal force at lift-off, 0.2 m/s",
        "Least force along the plane's normal while the hand is lifted from a depth of 5 mm; below "
        "0 the tool holds the hand back.",
        ">= 0 N",
        (0.0,),
        is_floor=True,
    ),
    Measure(
        "session_enter",
        "session: largest step a millisecond, entering at 10 mm/s",
        "Largest change of the force between two periods at 1 kHz while the hand comes in, to a "
        "depth of 5 mm; the worst of all planes. k times the hand's way is 0.01 N of it.",
        "<= 0.05 N",
        (0.05,),
    ),
    Measure(
        "session_energy",
        "session: energy of a press and release, share of its bound",
        "Work of the force on the hand over half a second in which the hand goes down to 5 mm and "
        "up again by a cosine, over K (T/2) times the integral of v^2 in contact, which a spring "
        "that is held over each period T gives.",
        "<= 1",
        (1.0,),
        unit="",
    ),
    Measure(
        "tap",
        "tap at 0.3 m/s, firm grip: overshoot",
        "Largest force over the force at rest, less 1. The arm moves at 0.3 m/s to a depth of "
        "10 mm and stays; the person is the simulated one, below.",
        "<= 25 %",
        (0.25,),
        percent=True,
    ),
    Measure(
        "z_width",
        "stiffest wall at rest, {cases}",
        "Largest stiffness k, to 1.2 %, with which a simulated person who presses 5 mm in comes to "
        "rest. It is no rest, but a limit cycle, if in the last 0.2 s of 1.2 s the force swings by "
        "more than 0.1 N from peak to peak, and by more than 0.7 of its swing in the 0.2 s before. "
        "Above 20,000 N/m nothing is tried. The plane law's k is its spring's: its force stays "
        "below k times half a voxel.",
        unit="N/m",
    ),
    Measure(
        "sheets",
        "sheets and half-voxel plates at 0.5 to 20 m/s: held",
        "Share of throws in which no point of a spinning ball of 60 points is ever 2 voxels behind "
        "the middle plane, while the hand goes through and rests behind it; the worst of sheets "
        "and plates, voxels of 5 and of 0.5 mm. The nearest point is the least height above that "
        "plane, in voxels.",
        "all",
        (1.0,),
        percent=True,
        is_floor=True,
    ),
    Measure(
        "astride",
        "starting astride a sheet: free without a step",
        "Share of 24 starts with a sheet through the tool, after which the tool is drawn out at "
        "50 mm/s, no change of the force between two periods is above 0.05 N, and none is left.",
        "all",
        (1.0,),
        percent=True,
        is_floor=True,
    ),
    Measure(
        "peg",
        "peg: radial clearance of free motion, round / square",
        "Least clearance, in voxels, between a peg and a hole 12 voxels wide, turned alike, at "
        "which `touch` feels at most 0.01 N along all of the peg's way through. In the corners of "
        "the square hole interpolated distances are too small, and the edges of the peg feel "
        "about 0.1 N there at less than that.",
        "<= 0.1 voxels",
        (0.1,),
        unit="voxels",
    ),
    Measure(
        "period",
        "computing a period, 289 points in contact, p50 / p99",
        "Time of one call of the coupling over resident cells, both laws in turns, while a flat "
        "tool slides at a depth of 2 mm; with the call's cost from Python.",
        "<= 40 / 100 us",
        (40.0, 100.0),
        unit="us",
    ),
    Measure(
        "walk",
        "walk over a model: largest step a millisecond / force above 30 Hz",
        "A ball of 300 points and a radius of 12 voxels is led over the model, 2 mm below its "
        "surface. Largest change of the force between two periods at 1 kHz, and the root mean "
        "square of its part above 30 Hz, where the hand's way has nothing.",
    ),
)
"""The measures, in the order of the table."""
