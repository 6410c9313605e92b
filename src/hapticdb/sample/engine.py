"""The engine: four cylinders in line, its crankshaft along x. World frame as in `body`.

Most shapes are made with their axis along z and placed by `ALONG`, which carries x, y, z of the
shape onto y, z, x of the world: a section drawn in (x, y) stands across the car as one sees it
from the front.
"""

import numpy as np

from hapticdb.sample.parts import CAST, COPPER, DARK, STEEL, Assembly
from hapticdb.sample.shapes import (
    Floats,
    Mesh,
    at_height,
    bored_block,
    box,
    circle,
    cylinder,
    extrude,
    hex_bolt,
    join,
    lathe,
    loft,
    moved,
    repeated,
    ring_plate,
    rod,
    rounded_rectangle,
    shift,
    tube,
    turn,
    turned,
)

ALONG = np.array(
    [[0.0, 0.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
CRANK = 0.40
DECK = 0.62
CAM = 0.715
CYLINDERS = (1.42, 1.315, 1.21, 1.105)
PHASES = (0.0, 180.0, 180.0, 0.0)
THROW = 0.040
ROD = 0.135
PITCH = 0.105
MIDDLE = 1.2625


def along(x: float, y: float = 0.0, z: float = CRANK) -> Floats:
    """Placement of a shape whose axis shall lie along x, its origin at a point of the world."""
    return np.asarray(shift(x, y, z) @ ALONG)


def pin_height(phase: float) -> float:
    """Height of a piston pin over the crankshaft's axis."""
    angle = np.radians(phase)
    return float(THROW * np.cos(angle) + np.sqrt(ROD**2 - (THROW * np.sin(angle)) ** 2))


def block() -> Mesh:
    """Block: deck with four bores, liners, ribbed water jacket, bulkheads, bell flange."""
    deck = [
        moved(bored_block(PITCH, 0.22, 0.016, 0.0405, 32), shift(x, 0.0, DECK - 0.008))
        for x in CYLINDERS
    ]
    liners = [
        moved(tube(0.047, 0.0405, 0.135, 32), shift(x, 0.0, DECK - 0.0835)) for x in CYLINDERS
    ]
    jacket = ring_plate(
        rounded_rectangle(0.44, 0.22, 0.03, 6),
        rounded_rectangle(0.416, 0.196, 0.02, 6),
        0.37,
        DECK - 0.016,
    )
    jacket = moved(jacket, shift(MIDDLE))
    ends = [MIDDLE + d * PITCH for d in (-2.0, -1.0, 0.0, 1.0, 2.0)]
    bulkheads = [
        moved(
            bored_block(0.196, 0.11, 0.018, 0.027, 24),
            along(0.985 * x + 0.015 * MIDDLE, 0.0, CRANK + 0.005),
        )
        for x in ends
    ]
    ribs = [
        moved(box(0.008, 0.016, 0.20, 0.003), shift(x, s * 0.116, 0.485))
        for s in (-1, 1)
        for x in np.linspace(1.07, 1.455, 12)
    ]
    bars = [
        moved(box(0.40, 0.014, 0.010, 0.003), shift(MIDDLE, s * 0.115, z))
        for s in (-1, 1)
        for z in (0.43, 0.54)
    ]
    flange = moved(ring_plate(circle(0.155, 48), circle(0.125, 48), -0.008, 0.008), along(1.035))
    bosses = [
        moved(tube(0.016, 0.008, 0.05, 16), shift(x, s * 0.135, 0.47) @ turn("x", 90.0))
        for s in (-1, 1)
        for x in (1.12, 1.40)
    ]
    return join([*deck, *liners, jacket, *bulkheads, *ribs, *bars, flange, *bosses])


def head() -> Mesh:
    """Cylinder head: floor with chambers, walls, ports on both sides, cam bearings, bolts."""
    floor = [
        moved(bored_block(PITCH, 0.23, 0.012, 0.030, 24), shift(x, 0.0, DECK + 0.008))
        for x in CYLINDERS
    ]
    walls = ring_plate(
        rounded_rectangle(0.45, 0.245, 0.02, 5),
        rounded_rectangle(0.43, 0.225, 0.012, 5),
        DECK + 0.002,
        CAM - 0.005,
    )
    walls = moved(walls, shift(MIDDLE))
    ports = [
        moved(tube(0.024, 0.017, 0.05, 20), shift(x, s * 0.125, 0.664) @ turn("x", 90.0))
        for x in CYLINDERS
        for s in (-1, 1)
    ]
    bearings = [
        moved(bored_block(0.045, 0.045, 0.016, 0.0145, 16), along(x, s * 0.065, CAM))
        for x in (1.04, 1.16, 1.2625, 1.365, 1.485)
        for s in (-1, 1)
    ]
    guides = [
        moved(tube(0.009, 0.004, 0.04, 12), shift(x, s * 0.04, 0.665) @ turn("x", -s * 18.0))
        for x in CYLINDERS
        for s in (-1, 1)
    ]
    bolts = repeated(
        hex_bolt(0.014, 0.05),
        [shift(x, y, DECK + 0.016) for x in np.linspace(1.06, 1.465, 5) for y in (-0.095, 0.095)],
    )
    return join([*floor, walls, *ports, *bearings, *guides, bolts])


def head_cover() -> Mesh:
    """Head cover: a domed shell with ribs, oil cap and bolts."""
    sections = [
        at_height(rounded_rectangle(x, y, 0.02, 4), z)
        for x, y, z in (
            (0.462, 0.257, 0.0),
            (0.462, 0.257, 0.012),
            (0.442, 0.237, 0.016),
            (0.436, 0.232, 0.048),
            (0.415, 0.212, 0.060),
        )
    ]
    inner = [
        at_height(rounded_rectangle(x, y, 0.02, 4), z)
        for x, y, z in ((0.405, 0.202, 0.054), (0.424, 0.220, 0.044), (0.430, 0.225, 0.0))
    ]
    ribs = [
        moved(box(0.38, 0.010, 0.012, 0.004), shift(0.0, y, 0.064))
        for y in (-0.06, -0.03, 0.03, 0.06)
    ]
    cap = moved(
        join(
            [
                cylinder(0.026, 0.03, 24),
                *(
                    moved(box(0.006, 0.006, 0.026, 0.001), turn("z", a) @ shift(0.027))
                    for a in range(0, 360, 20)
                ),
            ]
        ),
        shift(0.13, 0.0, 0.072),
    )
    bolts = repeated(
        hex_bolt(0.010, 0.014),
        [shift(x, s * 0.1225, 0.012) for x in np.linspace(-0.19, 0.19, 4) for s in (-1, 1)],
    )
    return join([loft([*sections[::-1], *inner[::-1]]), *ribs, cap, bolts])


def oil_pan() -> Mesh:
    """Oil pan: a trough with its flange, and the drain plug."""
    outer = (
        (0.46, 0.245, 0.0, 0.0),
        (0.46, 0.245, -0.012, 0.0),
        (0.43, 0.21, -0.014, 0.0),
        (0.42, 0.20, -0.08, 0.0),
        (0.28, 0.17, -0.145, -0.06),
    )
    inner = ((0.27, 0.16, -0.138, -0.06), (0.405, 0.185, -0.076, 0.0), (0.415, 0.19, 0.0, 0.0))
    sections = [
        at_height(rounded_rectangle(x, y, 0.025, 4) + np.array([d, 0.0]), z)
        for x, y, z, d in outer[::-1] + inner[::-1]
    ]
    plug = moved(hex_bolt(0.02, 0.015), shift(-0.10, 0.0, -0.146) @ turn("x", 180.0))
    bolts = repeated(
        hex_bolt(0.009, 0.02),
        [
            shift(x, s * 0.115, -0.012) @ turn("x", 180.0)
            for x in np.linspace(-0.2, 0.2, 7)
            for s in (-1, 1)
        ],
    )
    return moved(join([loft(sections), plug, bolts]), shift(MIDDLE, 0.0, 0.368))


def piston() -> Mesh:
    """Piston: crown with three ring grooves, hollow skirt, pin; the pin at the origin."""
    grooves = [(0.040, 0.036)]
    for z in (0.030, 0.023, 0.015):
        grooves += [(0.040, z), (0.0365, z - 0.0005), (0.0365, z - 0.0035), (0.040, z - 0.004)]
    profile = [
        (0.030, 0.036),
        *grooves,
        (0.0395, -0.030),
        (0.034, -0.030),
        (0.033, 0.020),
        (0.020, 0.026),
    ]
    return join([turned(profile, 40), moved(tube(0.011, 0.006, 0.066, 20), turn("y", 90.0))])


def connecting_rod() -> Mesh:
    """Rod from the piston pin at the origin down to the crank pin, with its cap and bolts."""
    small, big = tube(0.018, 0.011, 0.026, 28), moved(tube(0.036, 0.024, 0.026, 36), shift(y=-ROD))
    web = np.array(
        [
            (0.010, 0.010),
            (0.010, 0.003),
            (-0.010, 0.003),
            (-0.010, 0.010),
            (-0.012, 0.010),
            (-0.012, -0.010),
            (-0.010, -0.010),
            (-0.010, -0.003),
            (0.010, -0.003),
            (0.010, -0.010),
            (0.012, -0.010),
            (0.012, 0.010),
        ]
    )
    shank = loft(
        [
            np.column_stack([web[:, 0] * w, np.full(len(web), y), web[:, 1]])
            for y, w in ((-0.016, 0.8), (-0.06, 1.0), (-0.103, 1.5))
        ]
    )
    bolts = repeated(
        hex_bolt(0.010, 0.03),
        [shift(s * 0.034, -ROD - 0.016, 0.0) @ turn("x", 90.0) for s in (-1, 1)],
    )
    return join([small, big, shank, bolts])


def crankshaft() -> Mesh:
    """Crankshaft along z, its middle at the origin: journals, throws, counterweights, nose."""
    shapes = [
        moved(cylinder(0.0255, 0.034, 32), shift(z=d * PITCH)) for d in (-2.0, -1.0, 0.0, 1.0, 2.0)
    ]
    fan = np.radians(np.linspace(200.0, 340.0, 15))
    cheek = np.vstack(
        [
            0.072 * np.column_stack([np.cos(fan), np.sin(fan)]),
            [(0.040, -0.005), (0.032, 0.045)],
            circle(0.032, 24)[1:12] + np.array([0.0, THROW]),
            [(-0.032, 0.045), (-0.040, -0.005)],
        ]
    )
    web = extrude(cheek, -0.009, 0.009)
    for x, phase in zip(CYLINDERS, PHASES, strict=True):
        throw = [
            moved(cylinder(0.0235, 0.036, 28), shift(y=THROW)),
            *(moved(web, shift(z=s * 0.026)) for s in (-1, 1)),
        ]
        shapes.append(moved(join(throw), shift(z=x - MIDDLE) @ turn("z", phase)))
    nose = [
        moved(cylinder(0.018, 0.11, 24), shift(z=0.275)),
        moved(cylinder(0.040, 0.014, 32), shift(z=-0.232)),
    ]
    return join([*shapes, *nose])


def camshaft(lead: float) -> Mesh:
    """Camshaft along z, its middle at the origin: a shaft, eight lobes, five journals."""
    angle = np.radians(np.arange(0.0, 360.0, 10.0))
    reach = 0.016 + 0.009 * np.clip(np.cos(angle), 0.0, None) ** 2
    lobe = extrude(reach[:, None] * np.column_stack([np.cos(angle), np.sin(angle)]), -0.007, 0.007)
    shapes = [moved(cylinder(0.011, 0.50, 20), shift(z=0.02))]
    for x, order in zip(CYLINDERS, (0.0, 90.0, 270.0, 180.0), strict=True):
        shapes += [
            moved(lobe, shift(z=x - MIDDLE + s * 0.018) @ turn("z", lead + order)) for s in (-1, 1)
        ]
    shapes += [
        moved(cylinder(0.014, 0.020, 20), shift(z=x - MIDDLE))
        for x in (1.04, 1.16, 1.2625, 1.365, 1.485)
    ]
    return join(shapes)


def valve() -> Mesh:
    """Poppet valve along z, its head at the origin, with its spring and retainer."""
    stem = turned(
        [
            (0.013, -0.002),
            (0.0145, 0.0),
            (0.0145, 0.002),
            (0.006, 0.009),
            (0.0035, 0.016),
            (0.0035, 0.084),
            (0.003, 0.085),
        ],
        24,
    )
    retainer = moved(
        lathe([(0.0036, 0.0), (0.012, 0.002), (0.012, 0.005), (0.0036, 0.007)], 24), shift(z=0.076)
    )
    angle = np.linspace(0.0, 2.0 * np.pi * 5.0, 61)
    coil = rod(
        np.column_stack(
            [0.010 * np.cos(angle), 0.010 * np.sin(angle), 0.044 + 0.032 * angle / angle[-1]]
        ),
        0.0017,
        6,
    )
    return join([stem, retainer, coil])


def add_moving_parts(car: Assembly) -> None:
    """Crankshaft, pistons, rods, camshafts, valves."""
    car.add("engine/crankshaft", crankshaft(), STEEL, along(MIDDLE))
    shapes = piston(), connecting_rod()
    for i, (x, phase) in enumerate(zip(CYLINDERS, PHASES, strict=True), 1):
        pin = CRANK + pin_height(phase)
        car.add(f"engine/piston_{i}", shapes[0], CAST, shift(x, 0.0, pin))
        car.add(f"engine/connecting_rod_{i}", shapes[1], STEEL, along(x, 0.0, pin))
    for side, sign in (("intake", 1), ("exhaust", -1)):
        car.add(
            f"engine/camshaft_{side}",
            camshaft(90.0 + 110.0 * sign),
            STEEL,
            along(MIDDLE, sign * 0.065, CAM),
        )
    poppet = valve()
    for side, sign in (("intake", 1), ("exhaust", -1)):
        for i, x in enumerate(CYLINDERS, 1):
            car.add(
                f"engine/valve_{side}_{i}",
                poppet,
                COPPER,
                shift(x, sign * 0.028, 0.622) @ turn("x", -sign * 18.0),
            )


def add_engine(car: Assembly) -> None:
    """The engine, without what hangs on it."""
    for name, mesh, color in (
        ("block", block(), CAST),
        ("cylinder_head", head(), STEEL),
        ("head_cover", moved(head_cover(), shift(MIDDLE, 0.0, CAM + 0.012)), (0.60, 0.14, 0.12)),
        ("oil_pan", oil_pan(), DARK),
    ):
        car.add(f"engine/{name}", mesh, color)
    add_moving_parts(car)
