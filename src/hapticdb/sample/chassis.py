"""Suspension, steering and frame. World frame as in `body`."""

import numpy as np

from hapticdb.sample.body import ARCH, FRONT_AXLE, REAR_AXLE, WHEEL_RADIUS
from hapticdb.sample.parts import CAST, COPPER, DARK, SPRING, STEEL, Assembly
from hapticdb.sample.shapes import (
    Floats,
    Mesh,
    aligned,
    ball,
    bent,
    box,
    cylinder,
    join,
    lathe,
    loft,
    moved,
    pipe,
    rod,
    rounded_rectangle,
    sheet,
    shift,
    spring,
    sweep,
    torus,
    tube,
    turn,
    turned,
)
from hapticdb.sample.wheels import CORNERS

# ---- suspension ------------------------------------------------------------------------------


def damper() -> Mesh:
    """Damper along z from its eye at 0 to its top mount at 0.46, with the spring's seats."""
    body = moved(cylinder(0.024, 0.24), shift(z=0.14))
    stem = moved(cylinder(0.009, 0.22), shift(z=0.35))
    seat = lathe(
        [
            (0.024, 0.128),
            (0.070, 0.128),
            (0.076, 0.140),
            (0.070, 0.138),
            (0.066, 0.134),
            (0.024, 0.134),
        ],
        32,
    )
    mount = lathe(
        [
            (0.010, 0.430),
            (0.072, 0.430),
            (0.072, 0.436),
            (0.040, 0.444),
            (0.030, 0.462),
            (0.010, 0.462),
        ],
        32,
    )
    bellows = [moved(torus(0.024, 0.006, 14, 6), shift(z=z)) for z in np.linspace(0.27, 0.36, 8)]
    eye = moved(tube(0.022, 0.010, 0.04), turn("y", 90.0))
    return join([body, stem, seat, mount, *bellows, eye])


def wishbone(x: float) -> Mesh:
    """Left lower wishbone: two arms from their bushes to the ball joint, and a web."""
    joint = np.array([x, 0.625, 0.205])
    bushes = [np.array([x + d, 0.33, 0.215]) for d in (0.15, -0.15)]
    section = rounded_rectangle(0.036, 0.028, 0.008)
    arms = [
        sweep(bent([b, 0.5 * (b + joint) - [0.25 * (b[0] - x), 0.0, 0.012], joint], 4), section)
        for b in bushes
    ]
    rings = [moved(tube(0.026, 0.010, 0.055), shift(*b) @ turn("y", 90.0)) for b in bushes]
    web = moved(box(0.012, 0.14, 0.02), shift(x, 0.46, 0.203) @ turn("z", 90.0))
    ball_joint = [
        moved(ball(0.022), shift(*joint)),
        moved(cylinder(0.009, 0.07), shift(joint[0], joint[1], 0.24)),
    ]
    return join([*arms, *rings, web, *ball_joint])


def knuckle(x: float) -> Mesh:
    """Left upright: the bearing's carrier, arms up and down, brake bracket."""
    carrier = moved(tube(0.062, 0.0505, 0.05, 32), shift(x, 0.685, WHEEL_RADIUS) @ turn("x", 90.0))
    arms = [
        sweep(bent(p, 4), rounded_rectangle(0.034, 0.026, 0.007))
        for p in (
            [(x, 0.675, 0.365), (x, 0.62, 0.415), (x, 0.578, 0.43)],
            [(x, 0.675, 0.255), (x, 0.645, 0.235), (x, 0.63, 0.228)],
            [(x - 0.055, 0.675, 0.31), (x - 0.11, 0.665, 0.315), (x - 0.135, 0.64, 0.32)],
        )
    ]
    return join([carrier, *arms])


def anti_roll_bar(x: float, bow: float) -> Mesh:
    """Anti-roll bar: across the car, its ends cranked towards the wishbones."""
    path = [
        (x - bow, 0.50, 0.25),
        (x, 0.44, 0.26),
        (x + 0.05, 0.36, 0.26),
        (x + 0.05, -0.36, 0.26),
        (x, -0.44, 0.26),
        (x - bow, -0.50, 0.25),
    ]
    clamps = [moved(box(0.05, 0.035, 0.05, 0.008), shift(x + 0.05, y, 0.26)) for y in (-0.28, 0.28)]
    return join([rod(bent(path, 6), 0.012), *clamps])


def undertray() -> Mesh:
    """Shield under the engine, with louvres."""
    x, y = np.linspace(1.86, 0.98, 41), np.linspace(0.36, -0.36, 13)
    z = 0.165 + 0.10 * np.clip((x - 1.60) / 0.26, 0.0, 1.0) ** 2 + 0.006 * (np.arange(41) % 4 == 0)
    points = np.stack(np.broadcast_arrays(x[:, None], y[None, :], z[:, None]), axis=2)
    kept = np.ones((40, 12), dtype=np.bool_)
    kept[26:38:4, 2:10] = False
    return sheet(points, 0.006, kept)


def add_suspension(car: Assembly) -> None:
    """Spring, damper, wishbone and upright at each corner, two anti-roll bars."""
    coil, strut = spring(0.058, 0.0065, 0.29, 7.0), damper()
    for corner, (x, side) in CORNERS.items():
        foot, top = np.array([x, side * 0.565, 0.385]), np.array([x - 0.02, side * 0.50, 0.85])
        world_from_strut = aligned(foot, top)
        car.add(f"suspension/spring_{corner}", coil, SPRING, world_from_strut @ shift(z=0.285))
        car.add(f"suspension/damper_{corner}", strut, DARK, world_from_strut)
    for end, x in (("front", FRONT_AXLE), ("rear", REAR_AXLE)):
        car.add_pair(f"suspension/wishbone_{end}", wishbone(x), CAST)
        car.add_pair(f"suspension/knuckle_{end}", knuckle(x), STEEL)
    car.add("suspension/anti_roll_bar_front", anti_roll_bar(FRONT_AXLE - 0.26, -0.18), STEEL)
    car.add("suspension/anti_roll_bar_rear", anti_roll_bar(REAR_AXLE - 0.30, -0.20), STEEL)


# ---- steering --------------------------------------------------------------------------------

STEERING_WHEEL = np.array([0.235, 0.36, 0.895])


def steering_wheel() -> Mesh:
    """Steering wheel, its axis along z towards the driver: rim, three spokes, boss."""
    spoke = sweep(
        bent([(0.03, 0.0, -0.01), (0.10, 0.0, 0.004), (0.178, 0.0, 0.0)], 4),
        rounded_rectangle(0.034, 0.010, 0.003),
    )
    boss = turned(
        [(0.055, -0.03), (0.062, -0.01), (0.058, 0.012), (0.03, 0.022), (0.008, 0.024)], 32
    )
    return join(
        [
            torus(0.183, 0.0145, 64, 14),
            *(moved(spoke, turn("z", a)) for a in (0.0, 180.0, 270.0)),
            boss,
        ]
    )


def add_steering(car: Assembly) -> None:
    """Wheel, column with its joints, rack with bellows, tie rods."""
    axis = np.array([-0.90, 0.0, 0.435])
    world_from_wheel = aligned(STEERING_WHEEL, STEERING_WHEEL + axis)
    car.add(
        "steering/steering_wheel", moved(steering_wheel(), turn("z", 0.0)), DARK, world_from_wheel
    )
    start = STEERING_WHEEL - 0.03 * axis
    knee, foot = STEERING_WHEEL - 0.66 * axis, np.array([1.08, 0.30, 0.27])
    column = [
        pipe([start, STEERING_WHEEL - 0.40 * axis], 0.030, 0.022),
        rod([start, knee], 0.012),
        rod([knee, foot], 0.011),
    ]
    joints = [moved(ball(0.020), shift(*p)) for p in (knee, foot)]
    stalks = [
        rod(
            [
                start - 0.06 * axis,
                start - 0.06 * axis + [0.0, s * 0.10, 0.02],
                start - 0.06 * axis + [0.0, s * 0.17, 0.035],
            ],
            0.006,
        )
        for s in (-1, 1)
    ]
    car.add("steering/steering_column", join([*column, *joints, *stalks]), STEEL)
    rack = [
        moved(cylinder(0.026, 0.62), shift(1.10, 0.0, 0.25) @ turn("x", 90.0)),
        moved(cylinder(0.032, 0.09), shift(1.10, 0.29, 0.26)),
    ]
    bellows = [
        moved(torus(0.022, 0.008, 20, 8), shift(1.10, s * y, 0.25) @ turn("x", 90.0))
        for s in (-1, 1)
        for y in np.linspace(0.31, 0.40, 7)
    ]
    car.add("steering/steering_rack", join([*rack, *bellows]), CAST)
    tie = [
        rod([(1.10, 0.40, 0.25), (1.115, 0.52, 0.27), (1.14, 0.645, 0.30)], 0.008),
        moved(ball(0.016), shift(1.14, 0.645, 0.30)),
    ]
    car.add_pair("steering/tie_rod", join(tie), STEEL)


# ---- frame -----------------------------------------------------------------------------------


def hollow_beam(path: Floats, width: float, depth: float, wall: float = 0.006) -> Mesh:
    """Rectangular tube along a path, open at both ends."""
    outside = sweep(path, rounded_rectangle(width, depth, 0.012)).vertices[:-2]
    inside = sweep(path, rounded_rectangle(width - 2 * wall, depth - 2 * wall, 0.008)).vertices[:-2]
    shape = (len(path), -1, 3)
    return loft(np.concatenate([outside.reshape(shape), inside.reshape(shape)[::-1]]), ring=True)


def rail() -> Mesh:
    """Left longitudinal rail, raised over the axles."""
    path = [
        (1.95, 0.40, 0.40),
        (1.55, 0.40, 0.40),
        (1.10, 0.40, 0.36),
        (0.75, 0.42, 0.21),
        (0.2, 0.44, 0.185),
        (-0.6, 0.44, 0.185),
        (-0.90, 0.42, 0.24),
        (-1.15, 0.40, 0.42),
        (-1.5, 0.40, 0.44),
        (-2.02, 0.40, 0.44),
    ]
    return hollow_beam(bent(path, 5), 0.075, 0.060)


def cross_member(x: float, half: float, z: float, holes: int) -> Mesh:
    """Cross-member: a channel with lightening holes in its web."""
    y = np.linspace(half, -half, 4 * holes + 3)
    section = np.array(
        [
            (-0.05, -0.035),
            (-0.05, 0.03),
            (-0.044, 0.035),
            (-0.018, 0.035),
            (0.018, 0.035),
            (0.044, 0.035),
            (0.05, 0.03),
            (0.05, -0.035),
        ]
    )
    points = np.stack(
        [
            np.column_stack([section[:, 0] + x, np.full(len(section), v), section[:, 1] + z])
            for v in y
        ]
    )
    kept = np.ones((len(y) - 1, len(section) - 1), dtype=np.bool_)
    kept[2:-2:4, 3] = False
    kept[3:-2:4, 3] = False
    return sheet(points, 0.007, kept)


def wheel_arch_liner(x: float) -> Mesh:
    """Left wheel house: an arch over the wheel and its inner wall."""
    angle = np.radians(np.linspace(-8.0, 188.0, 41))
    arch = np.array(
        [
            (0.79, ARCH - 0.012),
            (0.70, ARCH - 0.012),
            (0.66, ARCH - 0.016),
            (0.635, ARCH - 0.035),
            (0.63, ARCH - 0.07),
            (0.63, 0.27),
        ]
    )
    points = np.stack(
        [
            np.column_stack(
                [x + arch[:, 1] * np.cos(a), arch[:, 0], WHEEL_RADIUS + arch[:, 1] * np.sin(a)]
            )
            for a in angle
        ]
    )
    return sheet(points, 0.009)


def add_frame(car: Assembly) -> None:
    """Rails, cross-members, wheel houses, brake lines."""
    car.add_pair("frame/rail", rail(), DARK)
    members = (
        ("front", 1.86, 0.42, 0.36, 6),
        ("engine", 1.16, 0.42, 0.24, 5),
        ("middle", -0.35, 0.50, 0.165, 7),
        ("rear", -1.02, 0.42, 0.27, 5),
        ("tail", -2.0, 0.42, 0.39, 6),
    )
    for name, x, half, z, holes in members:
        car.add(f"frame/cross_member_{name}", cross_member(x, half, z, holes), DARK)
    for end, x in (("front", FRONT_AXLE), ("rear", REAR_AXLE)):
        car.add_pair(f"frame/wheel_arch_{end}", wheel_arch_liner(x), DARK)
    car.add("frame/undertray", undertray(), DARK)
    line = bent(
        [
            (0.95, 0.50, 0.60),
            (0.93, 0.47, 0.35),
            (0.70, 0.36, 0.165),
            (0.0, 0.36, 0.15),
            (-0.8, 0.36, 0.155),
            (-1.1, 0.42, 0.30),
            (REAR_AXLE, 0.60, 0.37),
        ],
        8,
    )
    lines = [rod(line, 0.006, 8), rod(line * [1.0, -1.0, 1.0], 0.006, 8)]
    car.add("frame/brake_lines", join(lines), COPPER)


def add_chassis(car: Assembly) -> None:
    """Everything that springs, steers and carries."""
    add_suspension(car)
    add_steering(car)
    add_frame(car)
