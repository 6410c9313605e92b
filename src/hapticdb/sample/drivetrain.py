"""Gearbox and drive line. World frame as in `body`."""

import numpy as np

from hapticdb.sample.body import REAR_AXLE
from hapticdb.sample.engine import CRANK, along
from hapticdb.sample.parts import CAST, CHROME, COPPER, DARK, STEEL, Assembly
from hapticdb.sample.shapes import (
    Mesh,
    aligned,
    ball,
    bent,
    bored_block,
    box,
    cylinder,
    gear,
    hex_bolt,
    join,
    lathe,
    moved,
    repeated,
    rod,
    sheet,
    shift,
    torus,
    tube,
    turn,
    turned,
)

LAYSHAFT = 0.30
TEETH = ((14, 30), (19, 25), (24, 20), (28, 16))
GEARS_AT = (0.62, 0.69, 0.76, 0.83)
DIFFERENTIAL = 0.31
DRIVE_END = -1.165


# ---- gearbox and drive line ------------------------------------------------------------------


def gearbox_case() -> Mesh:
    """Gearbox: a ribbed trough, open at the top so that the gears show, and the bell."""
    angle = np.radians(np.linspace(10.0, -190.0, 33))
    x = np.array([0.555, 0.57, 0.64, 0.71, 0.78, 0.85, 0.885])
    width = np.array([0.085, 0.098, 0.100, 0.100, 0.100, 0.105, 0.115])
    ring = np.column_stack([np.cos(angle), np.where(np.sin(angle) < 0.0, 1.0, 0.5) * np.sin(angle)])
    points = np.stack(
        [
            np.column_stack([np.full(33, u), w * ring[:, 0], CRANK - 0.015 + 1.9 * w * ring[:, 1]])
            for u, w in zip(x, width, strict=True)
        ]
    )
    trough = sheet(points, 0.008)
    bell = moved(
        lathe(
            [
                (0.110, 0.0),
                (0.118, 0.0),
                (0.128, 0.05),
                (0.158, 0.125),
                (0.162, 0.138),
                (0.150, 0.138),
                (0.148, 0.125),
                (0.120, 0.05),
            ],
            64,
        ),
        along(0.885),
    )
    walls = [
        moved(bored_block(0.185, 0.11, 0.012, 0.024, 32), along(u, 0.0, z))
        for u in (0.56, 0.885)
        for z in (CRANK - 0.002, LAYSHAFT)
    ]
    ribs = [
        moved(box(0.30, 0.008, 0.020, 0.002), shift(0.72, s * 0.104, z))
        for s in (-1, 1)
        for z in (0.30, 0.34, 0.38)
    ]
    tail = moved(
        lathe(
            [
                (0.024, -0.09),
                (0.040, -0.09),
                (0.060, 0.0),
                (0.050, 0.0),
                (0.034, -0.08),
                (0.024, -0.08),
            ],
            36,
        ),
        along(0.555),
    )
    bolts = repeated(
        hex_bolt(0.014, 0.03),
        [along(1.010) @ turn("z", a) @ shift(0.140) @ turn("y", 180.0) for a in range(20, 360, 40)],
    )
    return join([trough, bell, *walls, *ribs, tail, bolts])


def shaft(steps: list[tuple[float, float, float]]) -> Mesh:
    """Stepped shaft along x: (from, to, radius) for each step, as one turned solid."""
    profile = [(r, x) for start, end, r in steps for x in (start, end)]
    return turned(profile, 28)


def add_gearbox(car: Assembly) -> None:
    """Case, two shafts, four pairs of gears in mesh, gear lever."""
    car.add("gearbox/gearbox_case", gearbox_case(), CAST)
    main = shaft(
        [(0.44, 0.60, 0.016), (0.60, 0.865, 0.019), (0.865, 0.90, 0.022), (0.90, 1.00, 0.014)]
    )
    lay = shaft([(0.55, 0.60, 0.014), (0.60, 0.865, 0.017), (0.865, 0.892, 0.014)])
    car.add("gearbox/main_shaft", main, STEEL, along(0.0))
    car.add("gearbox/layshaft", lay, STEEL, along(0.0, 0.0, LAYSHAFT))
    for i, (x, (above, below)) in enumerate(zip(GEARS_AT, TEETH, strict=True), 1):
        distance = CRANK - LAYSHAFT
        upper = gear(above, distance * above / 44.0, 0.032, 0.0192)
        lower = gear(below, distance * below / 44.0, 0.032, 0.0172)
        car.add(f"gearbox/main_gear_{i}", upper, CHROME, along(x) @ turn("z", -90.0))
        car.add(
            f"gearbox/lay_gear_{i}",
            lower,
            COPPER,
            along(x, 0.0, LAYSHAFT) @ turn("z", 90.0 + 180.0 / below),
        )
    lever = [
        rod(bent([(0.49, 0.0, 0.45), (0.46, 0.0, 0.60), (0.40, 0.0, 0.70)], 5), 0.008),
        moved(ball(0.026, 20), shift(0.395, 0.0, 0.71)),
        *(
            moved(torus(r, 0.008, 28, 8), shift(0.482 - 0.15 * (z - 0.51), 0.0, z))
            for r, z in (
                (0.060, 0.515),
                (0.050, 0.53),
                (0.040, 0.545),
                (0.030, 0.56),
                (0.022, 0.575),
            )
        ),
    ]
    car.add("gearbox/gear_lever", join(lever), DARK)


def differential_case() -> Mesh:
    """Differential: a round case with cooling ribs, nose and side tubes."""
    body = moved(
        turned(
            [
                (0.05, -0.085),
                (0.105, -0.07),
                (0.122, -0.02),
                (0.122, 0.02),
                (0.105, 0.07),
                (0.05, 0.085),
            ],
            48,
        ),
        shift(REAR_AXLE, 0.0, DIFFERENTIAL) @ turn("x", 90.0),
    )
    nose = moved(
        lathe([(0.030, 0.10), (0.068, 0.10), (0.046, 0.20), (0.046, 0.225), (0.030, 0.225)], 36),
        along(REAR_AXLE - 0.02, 0.0, DIFFERENTIAL),
    )
    sides = [
        moved(tube(0.036, 0.026, 0.10), shift(REAR_AXLE, s * 0.13, DIFFERENTIAL) @ turn("x", 90.0))
        for s in (-1, 1)
    ]
    ribs = [
        moved(
            lathe([(0.118, -0.003), (0.132, -0.003), (0.132, 0.003), (0.118, 0.003)], 48),
            shift(REAR_AXLE, y, DIFFERENTIAL) @ turn("x", 90.0),
        )
        for y in np.linspace(-0.02, 0.02, 3)
    ]
    return join([body, nose, *sides, *ribs])


def drive_shaft(x: float) -> Mesh:
    """Left half-shaft with its bellows and joints."""
    start, end = np.array([x, 0.17, DIFFERENTIAL]), np.array([x, 0.70, 0.31])
    frame = aligned(start, end)
    profile = [(0.036, 0.0), (0.036, 0.03)]
    for i in range(5):
        profile += [(0.040 - 0.004 * i, 0.035 + 0.014 * i), (0.030 - 0.003 * i, 0.042 + 0.014 * i)]
    length = float(np.linalg.norm(end - start))
    inner = [(0.0125, 0.11), (0.0125, length - 0.11)]
    outer = [(r, length - z) for r, z in profile[::-1]]
    return moved(turned([*profile, *inner, *outer], 28), frame)


def add_drive_line(car: Assembly) -> None:
    """Propeller shaft, differential with crown wheel and pinion, half-shafts."""
    ends = np.array([0.44, 0.0, CRANK]), np.array([DRIVE_END + 0.09, 0.0, DIFFERENTIAL + 0.005])
    length = float(np.linalg.norm(ends[1] - ends[0]))
    line = [
        (0.030, 0.0),
        (0.030, 0.05),
        (0.020, 0.06),
        (0.020, 0.10),
        (0.036, 0.13),
        (0.036, length - 0.13),
        (0.020, length - 0.10),
        (0.020, length - 0.06),
        (0.034, length - 0.05),
        (0.034, length),
    ]
    crosses = [
        moved(cylinder(0.010, 0.084, 16), shift(z=z) @ turn(axis, 90.0))
        for z in (0.08, length - 0.08)
        for axis in ("x", "y")
    ]
    car.add(
        "driveline/propeller_shaft",
        moved(join([turned(line, 32), *crosses]), aligned(*ends)),
        STEEL,
    )
    car.add("driveline/differential", differential_case(), CAST)
    car.add(
        "driveline/crown_wheel",
        gear(37, 0.088, 0.022, 0.045),
        STEEL,
        shift(REAR_AXLE, 0.035, DIFFERENTIAL) @ turn("x", 90.0),
    )
    pinion = join([gear(9, 0.026, 0.04, 0.008), moved(cylinder(0.0185, 0.16, 24), shift(z=0.10))])
    car.add("driveline/pinion", pinion, STEEL, along(REAR_AXLE + 0.085, -0.002, DIFFERENTIAL))
    car.add_pair("driveline/half_shaft", drive_shaft(REAR_AXLE), STEEL)


def add_drivetrain(car: Assembly) -> None:
    """Everything between the engine and the wheels."""
    add_gearbox(car)
    add_drive_line(car)
