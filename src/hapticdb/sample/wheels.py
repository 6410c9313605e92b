"""Wheels and brakes, each made with its axis along z and its outer face towards +z."""

import numpy as np

from hapticdb.sample.body import FRONT_AXLE, REAR_AXLE, WHEEL_RADIUS
from hapticdb.sample.parts import CAST, CHROME, RED, RUBBER, STEEL, Assembly
from hapticdb.sample.shapes import (
    Mesh,
    ball,
    box,
    circle,
    cylinder,
    hex_bolt,
    join,
    lathe,
    loft,
    moved,
    repeated,
    rounded_rectangle,
    shift,
    tube,
    turn,
    turned,
)

TRACK = 0.73
CORNERS = {
    "front_left": (FRONT_AXLE, 1.0),
    "front_right": (FRONT_AXLE, -1.0),
    "rear_left": (REAR_AXLE, 1.0),
    "rear_right": (REAR_AXLE, -1.0),
}


def around(mesh: Mesh, copies: int, start: float = 0.0) -> Mesh:
    """Copies of a mesh turned evenly about the z axis."""
    return repeated(mesh, [turn("z", start + 360.0 * i / copies) for i in range(copies)])


def arc_block(
    radii: tuple[float, float], z: tuple[float, float], degrees: tuple[float, float]
) -> Mesh:
    """Block bent about the z axis, between two radii, heights and angles."""
    angle = np.radians(np.linspace(*degrees, 13))[:, None]
    r = np.array([radii[0], radii[1], radii[1], radii[0]])
    heights = np.broadcast_to(np.array([z[0], z[0], z[1], z[1]]), (13, 4))
    return loft(np.stack([r * np.cos(angle), r * np.sin(angle), heights], axis=2))


def tyre() -> Mesh:
    """Tyre with three grooves round the tread, blocks at its shoulders, and its inner side."""
    tread = [
        (0.302, 0.080),
        (0.309, 0.066),
        (0.310, 0.046),
        (0.302, 0.044),
        (0.302, 0.036),
        (0.310, 0.034),
        (0.310, 0.005),
        (0.302, 0.004),
    ]
    half = [(0.206, 0.078), (0.216, 0.090), (0.245, 0.098), (0.275, 0.097), (0.295, 0.090), *tread]
    inside = [
        (0.296, 0.060),
        (0.285, 0.080),
        (0.262, 0.088),
        (0.235, 0.086),
        (0.218, 0.076),
        (0.208, 0.066),
    ]
    outer = np.array(half + [(r, -z) for r, z in half[::-1]])
    inner = np.array([(r, -z) for r, z in inside[::-1]] + inside)
    section = np.vstack([outer, inner])
    segments = 78
    r = np.tile(section[:, 0], (segments, 1))
    block = (np.arange(segments) % 3 == 0)[:, None] & (r > 0.3005) & (np.abs(section[:, 1]) > 0.045)
    r = np.where(block, r - 0.008, r)
    direction = circle(1.0, segments)
    z = np.broadcast_to(section[:, 1], r.shape)
    return loft(np.stack([r * direction[:, :1], r * direction[:, 1:], z], axis=2), ring=True)


def rim() -> Mesh:
    """Rim: barrel with its flanges, ten spokes in pairs, hub ring with five bosses, cap."""
    outer = [
        (0.212, -0.084),
        (0.212, -0.078),
        (0.203, -0.072),
        (0.203, -0.050),
        (0.180, -0.030),
        (0.180, 0.030),
        (0.203, 0.050),
        (0.203, 0.072),
        (0.212, 0.078),
        (0.212, 0.084),
    ]
    inner = [
        (0.200, 0.080),
        (0.196, 0.060),
        (0.173, 0.034),
        (0.173, -0.034),
        (0.196, -0.054),
        (0.196, -0.080),
    ]
    spoke = loft(
        [
            np.array([[x, y, z] for y, z in rounded_rectangle(w, t, 0.006) + np.array([0.0, h])])
            for x, w, t, h in (
                (0.055, 0.030, 0.030, 0.046),
                (0.10, 0.024, 0.026, 0.058),
                (0.15, 0.024, 0.024, 0.060),
                (0.182, 0.034, 0.024, 0.050),
            )
        ]
    )
    pair = join([moved(spoke, turn("z", a)) for a in (-11.0, 11.0)])
    hub = lathe(
        [(0.030, 0.028), (0.075, 0.028), (0.075, 0.052), (0.068, 0.058), (0.030, 0.058)], 40
    )
    cap = moved(
        turned([(0.031, -0.02), (0.031, 0.0), (0.024, 0.006), (0.008, 0.008)], 24), shift(z=0.060)
    )
    bosses = around(moved(tube(0.014, 0.009, 0.034, 16), shift(0.055, 0.0, 0.045)), 5, 36.0)
    return join([lathe(outer + inner, 54), around(pair, 5), hub, cap, bosses])


def brake_disc() -> Mesh:
    """Ventilated disc: two rings, vanes between them, and the bell."""
    rings = [
        lathe([(0.085, z), (0.150, z), (0.150, z + 0.007), (0.085, z + 0.007)], 36)
        for z in (-0.030, -0.014)
    ]
    vane = moved(box(0.055, 0.004, 0.009, 0.001), shift(0.118, 0.0, -0.0185) @ turn("z", 25.0))
    bell = lathe(
        [
            (0.034, 0.020),
            (0.080, 0.020),
            (0.088, -0.008),
            (0.082, -0.008),
            (0.074, 0.014),
            (0.034, 0.014),
        ],
        48,
    )
    return join([*rings, around(vane, 20), bell])


def caliper() -> Mesh:
    """Caliper: a bridge over the disc, two pistons, two pads."""
    span = (150.0, 200.0)
    body = [
        arc_block((0.100, 0.170), (-0.062, -0.040), span),
        arc_block((0.156, 0.170), (-0.040, 0.004), span),
        arc_block((0.105, 0.170), (0.004, 0.014), span),
    ]
    pads = [
        arc_block((0.098, 0.148), z, (155.0, 195.0)) for z in ((-0.038, -0.031), (-0.006, 0.001))
    ]
    pot = moved(cylinder(0.022, 0.03), shift(0.130, 0.0, -0.075))
    return join([*body, *pads, *(moved(pot, turn("z", a)) for a in (163.0, 187.0))])


def hub() -> Mesh:
    """Hub: flange, bearing rings, and the balls between them."""
    flange = lathe(
        [
            (0.014, -0.050),
            (0.028, -0.050),
            (0.028, 0.006),
            (0.072, 0.010),
            (0.072, 0.019),
            (0.026, 0.019),
            (0.026, 0.040),
            (0.014, 0.040),
        ],
        36,
    )
    outer = lathe([(0.040, -0.055), (0.050, -0.055), (0.050, -0.018), (0.040, -0.018)], 36)
    return join([flange, outer, around(moved(ball(0.0058, 10), shift(0.034, 0.0, -0.036)), 14)])


def add_wheels(car: Assembly) -> None:
    """Four wheels with their brakes, hubs and twenty bolts, instances of one shape each."""
    shapes = {
        "tyre": (tyre(), RUBBER),
        "rim": (rim(), CHROME),
        "brake_disc": (brake_disc(), STEEL),
        "brake_caliper": (caliper(), RED),
        "hub": (hub(), CAST),
    }
    bolt = hex_bolt(0.017, 0.035)
    for corner, (x, side) in CORNERS.items():
        world_from_wheel = shift(x, side * TRACK, WHEEL_RADIUS) @ turn("x", -90.0 * side)
        if side < 0.0:
            world_from_wheel = world_from_wheel @ turn("z", 180.0)
        for name, (mesh, color) in shapes.items():
            if name == "brake_caliper" and x < 0.0:
                car.add(f"wheels/{name}_{corner}", mesh, color, world_from_wheel @ turn("z", 180.0))
            else:
                car.add(f"wheels/{name}_{corner}", mesh, color, world_from_wheel)
        for i in range(5):
            seat = turn("z", 36.0 + 72.0 * i) @ shift(0.055, 0.0, 0.0625)
            car.add(f"wheels/wheel_bolt_{corner}_{i + 1}", bolt, STEEL, world_from_wheel @ seat)


def add_spare(car: Assembly) -> None:
    """Spare wheel, lying in the boot."""
    car.add("wheels/spare_wheel", join([tyre(), rim()]), RUBBER, shift(-1.66, 0.0, 0.645))
