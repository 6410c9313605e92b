"""What hangs on the engine: timing, pulleys, manifolds, filters. World frame as in `body`."""

import numpy as np

from hapticdb.sample.engine import CAM, CRANK, CYLINDERS, MIDDLE, along
from hapticdb.sample.parts import CAST, COPPER, DARK, RUBBER, SPRING, STEEL, Assembly
from hapticdb.sample.shapes import (
    Mesh,
    belt,
    bent,
    bored_block,
    box,
    circle,
    cylinder,
    gear,
    join,
    lathe,
    moved,
    pipe,
    ring_plate,
    rounded_rectangle,
    shift,
    slab,
    sweep,
    tube,
    turn,
    turned,
)


def pulley(radius: float, width: float, grooves: int) -> Mesh:
    """Ribbed belt pulley along z with a web and a bored boss."""
    z = np.linspace(-width / 2.0, width / 2.0, 2 * grooves + 1)
    r = radius - 0.004 * (np.arange(2 * grooves + 1) % 2)
    wall = radius - 0.010
    rim = [*zip(r, z, strict=True), (wall, width / 2.0), (wall, -width / 2.0)]
    web = lathe(
        [
            (0.012, -0.004),
            (wall, -0.004),
            (wall, 0.004),
            (0.020, 0.004),
            (0.020, 0.012),
            (0.012, 0.012),
        ],
        36,
    )
    return join([lathe(rim, 48), web])


def alternator() -> Mesh:
    """Alternator along z: finned case, vents, pulley with its nut, mounting ears."""
    case = turned(
        [
            (0.035, -0.075),
            (0.058, -0.065),
            (0.062, -0.03),
            (0.062, 0.03),
            (0.055, 0.045),
            (0.02, 0.05),
        ],
        36,
    )
    fins = [
        moved(box(0.006, 0.004, 0.075, 0.001), turn("z", a) @ shift(0.064))
        for a in range(0, 360, 15)
    ]
    ears = [moved(tube(0.014, 0.006, 0.05, 16), shift(0.0, s * 0.074)) for s in (-1, 1)]
    wheel = [
        moved(pulley(0.031, 0.022, 5), shift(z=0.075)),
        moved(cylinder(0.0125, 0.05), shift(z=0.066)),
    ]
    return join([case, *fins, *ears, *wheel])


def intake_manifold() -> Mesh:
    """Intake on the left: plenum, four runners, throttle body."""
    plenum = moved(cylinder(0.048, 0.44, 28), along(MIDDLE, 0.285, 0.76))
    runners = [
        pipe(
            bent([(x, 0.145, 0.664), (x, 0.22, 0.655), (x, 0.29, 0.69), (x, 0.292, 0.74)], 5),
            0.023,
            0.018,
        )
        for x in CYLINDERS
    ]
    flanges = [
        moved(bored_block(0.075, 0.055, 0.010, 0.018), shift(x, 0.152, 0.664) @ turn("x", 90.0))
        for x in CYLINDERS
    ]
    throttle = [
        moved(tube(0.038, 0.030, 0.09), along(1.525, 0.285, 0.76)),
        moved(
            turned([(0.029, -0.001), (0.029, 0.001)], 24),
            along(1.53, 0.285, 0.76) @ turn("y", 40.0),
        ),
    ]
    return join([plenum, *runners, *flanges, *throttle])


def exhaust_manifold() -> Mesh:
    """Exhaust on the right: flanges and four pipes into one."""
    gather = (1.16, -0.245, 0.46)
    pipes = [
        pipe(
            bent(
                [
                    (x, -0.145, 0.664),
                    (x, -0.195, 0.658),
                    (0.5 * (x + 1.16), -0.245, 0.58),
                    (gather[0] + 0.02 * (i - 1.5), gather[1], gather[2]),
                ],
                6,
            ),
            0.021,
            0.017,
        )
        for i, x in enumerate(CYLINDERS)
    ]
    flanges = [
        moved(bored_block(0.075, 0.055, 0.010, 0.017), shift(x, -0.152, 0.664) @ turn("x", 90.0))
        for x in CYLINDERS
    ]
    collector = lathe(
        [(0.050, 0.03), (0.055, 0.0), (0.032, -0.06), (0.028, -0.06), (0.050, 0.0), (0.046, 0.03)],
        32,
    )
    return join([*pipes, *flanges, moved(collector, shift(*gather))])


def air_filter() -> Mesh:
    """Air filter: box with lid, the pleated element inside, snout and duct to the throttle."""
    case = ring_plate(
        rounded_rectangle(0.22, 0.20, 0.03, 5),
        rounded_rectangle(0.212, 0.192, 0.026, 5),
        -0.06,
        0.05,
    )
    cover = moved(box(0.228, 0.208, 0.02, 0.03, 5), shift(z=0.06))
    pleats = [moved(slab(0.002, 0.18, 0.06), shift(x)) for x in np.linspace(-0.095, 0.095, 40)]
    clips = [
        moved(box(0.02, 0.008, 0.03, 0.002), shift(x, s * 0.103, 0.045))
        for x in (-0.06, 0.06)
        for s in (-1, 1)
    ]
    body = moved(join([case, cover, *pleats, *clips]), shift(1.60, 0.47, 0.625))
    duct = pipe(
        bent(
            [(1.57, 0.285, 0.76), (1.61, 0.30, 0.755), (1.64, 0.36, 0.715), (1.62, 0.42, 0.675)], 8
        ),
        0.040,
        0.034,
    )
    return join([body, duct])


def oil_filter() -> Mesh:
    """Oil filter cartridge with its fluted end."""
    can = turned([(0.030, 0.0), (0.038, 0.004), (0.038, 0.085), (0.030, 0.092), (0.012, 0.092)], 32)
    flutes = [
        moved(box(0.005, 0.006, 0.02, 0.001), turn("z", a) @ shift(0.036, 0.0, 0.082))
        for a in range(0, 360, 24)
    ]
    return join([can, *flutes])


def add_timing(car: Assembly) -> None:
    """Sprockets, toothed belt, pulleys, fan belt, water pump, alternator, starter."""
    sprocket = gear(32, 0.052, 0.022, 0.011)
    for side, sign in (("intake", 1), ("exhaust", -1)):
        car.add(f"engine/cam_sprocket_{side}", sprocket, STEEL, along(1.52, sign * 0.065, CAM))
    loop = belt([(0.0, CRANK, 0.034), (0.065, CAM, 0.0545), (-0.065, CAM, 0.0545)], 0.020, 0.004)
    car.add("engine/timing_belt", loop, RUBBER, along(1.52, 0.0, 0.0))
    car.add(
        "engine/crank_pulley",
        join([pulley(0.068, 0.026, 5), moved(gear(20, 0.0325, 0.022, 0.018), shift(z=-0.036))]),
        STEEL,
        along(1.556),
    )
    car.add(
        "engine/water_pump",
        join(
            [
                pulley(0.050, 0.024, 5),
                moved(
                    turned([(0.042, -0.058), (0.045, -0.03), (0.020, -0.018), (0.012, 0.016)], 28),
                    shift(),
                ),
            ]
        ),
        CAST,
        along(1.556, -0.045, 0.545),
    )
    car.add("engine/alternator", alternator(), CAST, along(1.481, -0.195, 0.475))
    fan_belt = belt(
        [(0.0, CRANK, 0.068), (-0.045, 0.545, 0.050), (-0.195, 0.475, 0.031)], 0.022, 0.004
    )
    car.add("engine/fan_belt", fan_belt, RUBBER, along(1.556, 0.0, 0.0))
    starter = [
        moved(cylinder(0.036, 0.15, 28), shift()),
        moved(cylinder(0.020, 0.11, 20), shift(0.0, 0.055, 0.0)),
        moved(gear(10, 0.016, 0.03, 0.006), shift(z=-0.105)),
        moved(cylinder(0.006, 0.06), shift(z=-0.10)),
    ]
    car.add("engine/starter", join(starter), DARK, along(1.145, 0.175, 0.39))


def flywheel() -> Mesh:
    """Flywheel with its toothed ring, and the clutch's cover springs."""
    ring = gear(64, 0.126, 0.012, 0.112)
    plate = lathe(
        [
            (0.020, -0.010),
            (0.1125, -0.010),
            (0.1125, 0.010),
            (0.045, 0.010),
            (0.045, 0.004),
            (0.020, 0.004),
        ],
        64,
    )
    fingers = [
        moved(box(0.045, 0.010, 0.003, 0.001), turn("z", a) @ shift(0.058, 0.0, -0.026))
        for a in range(0, 360, 20)
    ]
    cover = lathe(
        [
            (0.075, -0.030),
            (0.105, -0.024),
            (0.108, -0.010),
            (0.103, -0.010),
            (0.100, -0.020),
            (0.075, -0.026),
        ],
        64,
    )
    return join([ring, plate, cover, *fingers])


def add_ancillaries(car: Assembly) -> None:
    """Everything on the engine that is not in it."""
    add_timing(car)
    car.add("engine/flywheel", flywheel(), STEEL, along(1.015))
    car.add("engine/intake_manifold", intake_manifold(), CAST)
    car.add("engine/exhaust_manifold", exhaust_manifold(), COPPER)
    car.add("engine/air_filter", air_filter(), DARK)
    car.add("engine/oil_filter", oil_filter(), SPRING, shift(1.33, -0.125, 0.42) @ turn("x", 100.0))
    dipstick = sweep(
        bent([(1.40, 0.125, 0.40), (1.41, 0.15, 0.55), (1.415, 0.16, 0.73)], 6), circle(0.004, 8)
    )
    car.add(
        "engine/dipstick",
        join(
            [
                dipstick,
                moved(tube(0.014, 0.009, 0.006, 20), shift(1.415, 0.16, 0.745) @ turn("x", 90.0)),
            ]
        ),
        SPRING,
    )
