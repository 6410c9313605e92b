"""Cooling, exhaust, fuel and wiring. World frame as in `body`."""

import numpy as np

from hapticdb.sample.engine import along
from hapticdb.sample.parts import AMBER, CHROME, COPPER, DARK, RUBBER, STEEL, Assembly
from hapticdb.sample.shapes import (
    Mesh,
    aligned,
    bent,
    bored_block,
    box,
    cylinder,
    hex_bolt,
    join,
    lathe,
    loft,
    moved,
    pipe,
    ring_plate,
    rod,
    rounded_rectangle,
    shift,
    slab,
    torus,
    tube,
    turn,
    turned,
)

# ---- cooling ---------------------------------------------------------------------------------


def radiator() -> Mesh:
    """Radiator: two tanks, flat tubes across, thin fins between them, filler cap."""
    tanks = [moved(box(0.062, 0.05, 0.40, 0.012), shift(0.0, s * 0.315)) for s in (-1, 1)]
    tubes = [moved(slab(0.044, 0.60, 0.0045), shift(z=z)) for z in np.linspace(-0.18, 0.18, 25)]
    fins = [moved(slab(0.040, 0.0012, 0.37), shift(0.0, y)) for y in np.linspace(-0.285, 0.285, 72)]
    bars = [moved(box(0.060, 0.68, 0.016, 0.004), shift(z=s * 0.198)) for s in (-1, 1)]
    cap = moved(
        turned([(0.024, 0.0), (0.028, 0.004), (0.028, 0.016), (0.02, 0.02)], 24),
        shift(0.0, 0.315, 0.20),
    )
    return moved(join([*tanks, *tubes, *fins, *bars, cap]), shift(1.79, 0.0, 0.485))


def condenser() -> Mesh:
    """Condenser: one pipe to and fro, thin fins, side plates."""
    rows = np.linspace(-0.165, 0.165, 14)
    path = [
        (0.0, s * (1 if i % 2 else -1) * 0.27, z) for i, z in enumerate(rows) for s in (1.0, -1.0)
    ]
    fins = [moved(slab(0.022, 0.0012, 0.35), shift(0.0, y)) for y in np.linspace(-0.265, 0.265, 54)]
    plates = [moved(box(0.026, 0.006, 0.37, 0.002), shift(0.0, s * 0.295)) for s in (-1, 1)]
    return moved(join([rod(bent(path, 3), 0.0065, 8), *fins, *plates]), shift(1.85, 0.0, 0.475))


def fan() -> Mesh:
    """Fan along z: seven twisted blades, ring, motor."""
    stations = [(0.045, 48.0), (0.08, 40.0), (0.12, 32.0), (0.158, 26.0)]
    blade = loft(
        [
            moved(
                Mesh(
                    np.column_stack(
                        [np.full(8, 0.0), rounded_rectangle(0.055 + 0.1 * r, 0.004, 0.0015, 1)]
                    ),
                    np.zeros((0, 3), np.int64),
                ),
                shift(r) @ turn("x", a),
            ).vertices
            for r, a in stations
        ]
    )
    ring = lathe([(0.156, -0.015), (0.162, -0.015), (0.162, 0.015), (0.156, 0.015)], 64)
    hub = turned([(0.046, -0.02), (0.048, 0.016), (0.040, 0.024), (0.010, 0.027)], 36)
    motor = moved(cylinder(0.038, 0.045, 28), shift(z=-0.035))
    return join([*(moved(blade, turn("z", 360.0 * i / 7.0)) for i in range(7)), ring, hub, motor])


def shroud() -> Mesh:
    """Fan shroud: a plate with a round opening and its collar, struts for the motor."""
    plate = bored_block(0.60, 0.38, 0.008, 0.170, 64)
    collar = lathe([(0.168, -0.03), (0.175, -0.03), (0.175, 0.004), (0.168, 0.004)], 64)
    rim = ring_plate(
        rounded_rectangle(0.61, 0.39, 0.02, 4),
        rounded_rectangle(0.598, 0.378, 0.016, 4),
        -0.004,
        0.03,
    )
    struts = [
        moved(box(0.132, 0.012, 0.008, 0.003), turn("z", a) @ shift(0.104, 0.0, -0.028))
        for a in (45.0, 135.0, 225.0, 315.0)
    ]
    seat = moved(tube(0.046, 0.039, 0.02, 32), shift(z=-0.028))
    return join([plate, collar, rim, *struts, seat])


def add_cooling(car: Assembly) -> None:
    """Radiator, condenser, fan and hoses."""
    car.add("cooling/radiator", radiator(), STEEL)
    car.add("cooling/condenser", condenser(), COPPER)
    car.add("cooling/fan", fan(), DARK, along(1.685, 0.0, 0.485))
    car.add("cooling/fan_shroud", shroud(), DARK, along(1.715, 0.0, 0.485))
    upper = bent(
        [
            (1.76, -0.315, 0.64),
            (1.70, -0.31, 0.72),
            (1.60, -0.22, 0.74),
            (1.53, -0.17, 0.70),
            (1.47, -0.13, 0.665),
        ],
        7,
    )
    lower = bent(
        [
            (1.76, 0.315, 0.33),
            (1.68, 0.30, 0.30),
            (1.60, 0.20, 0.32),
            (1.53, 0.14, 0.42),
            (1.48, 0.11, 0.46),
        ],
        7,
    )
    for name, path in (("upper", upper), ("lower", lower)):
        clips = [moved(torus(0.0215, 0.004, 24, 6), aligned(path[i], path[i + 1])) for i in (2, -4)]
        car.add(f"cooling/hose_{name}", join([pipe(path, 0.021, 0.016), *clips]), RUBBER)


# ---- exhaust, fuel, wiring -------------------------------------------------------------------


def catalyst() -> Mesh:
    """Catalytic converter along z: a shell with cones, and the honeycomb inside."""
    profile = [
        (0.027, -0.22),
        (0.030, -0.22),
        (0.070, -0.15),
        (0.070, 0.15),
        (0.030, 0.22),
        (0.027, 0.22),
        (0.066, 0.148),
        (0.066, -0.148),
    ]
    comb = [
        moved(slab(w, 0.0015, 0.24), turn("z", a) @ shift(0.0, d))
        for a in (0.0, 90.0)
        for d in np.linspace(-0.055, 0.055, 12)
        for w in (2.0 * np.sqrt(0.064**2 - d**2),)
    ]
    bands = [moved(torus(0.071, 0.004, 40, 8), shift(z=z)) for z in (-0.10, 0.10)]
    return join([lathe(profile, 48), *comb, *bands])


def muffler() -> Mesh:
    """Muffler along z: oval shell, two baffles, perforated-tube core."""
    oval = rounded_rectangle(0.24, 0.15, 0.07, 8)
    inner = rounded_rectangle(0.232, 0.142, 0.066, 8)
    profile = ((0.6, -0.235), (1.0, -0.225), (1.0, 0.225), (0.6, 0.235))
    shell = loft([*(np.column_stack([s * oval, np.full(len(oval), z)]) for s, z in profile)])
    lining = loft(
        [
            *(
                np.column_stack([s * inner, np.full(len(inner), z)])
                for s, z in ((1.0, -0.215), (1.0, 0.215))
            )
        ]
    )
    baffles = [
        moved(
            ring_plate(
                0.97 * inner,
                np.array([0.028, 0.028]) * inner / np.linalg.norm(inner, axis=1, keepdims=True),
                -0.003,
                0.003,
            ),
            shift(z=z),
        )
        for z in (-0.08, 0.08)
    ]
    return join([shell, lining, *baffles, tube(0.026, 0.022, 0.43)])


def add_exhaust(car: Assembly) -> None:
    """From the manifold to the tail."""
    front = bent(
        [
            (1.16, -0.245, 0.41),
            (1.15, -0.245, 0.26),
            (1.06, -0.24, 0.165),
            (0.85, -0.24, 0.145),
            (0.66, -0.24, 0.145),
        ],
        7,
    )
    car.add("exhaust/front_pipe", pipe(front, 0.027, 0.023, 20), COPPER)
    car.add("exhaust/catalyst", catalyst(), STEEL, along(0.44, -0.24, 0.145))
    middle = bent(
        [
            (0.22, -0.24, 0.145),
            (-0.3, -0.24, 0.118),
            (-0.75, -0.24, 0.14),
            (-1.0, -0.26, 0.20),
            (-1.18, -0.27, 0.47),
            (-1.36, -0.27, 0.47),
            (-1.52, -0.26, 0.30),
            (-1.60, -0.26, 0.27),
        ],
        8,
    )
    car.add("exhaust/middle_pipe", pipe(middle, 0.026, 0.022, 20), STEEL)
    car.add("exhaust/muffler", muffler(), STEEL, along(-1.80, -0.26, 0.27))
    tail = bent(
        [
            (-2.00, -0.31, 0.27),
            (-2.06, -0.32, 0.255),
            (-2.12, -0.33, 0.205),
            (-2.155, -0.33, 0.195),
        ],
        6,
    )
    car.add("exhaust/tail_pipe", pipe(tail, 0.032, 0.027, 24), CHROME)


def fuel_tank() -> Mesh:
    """Fuel tank: two half shells with their seam, baffles inside, sender on top."""
    sections = (
        (0.40, 0.40, -0.10),
        (0.44, 0.46, -0.09),
        (0.45, 0.47, -0.004),
        (0.47, 0.49, -0.003),
        (0.47, 0.49, 0.003),
        (0.45, 0.47, 0.004),
        (0.44, 0.46, 0.08),
        (0.40, 0.42, 0.09),
    )
    shell = loft(
        [
            np.column_stack([rounded_rectangle(x, y, 0.05, 5), np.full(24, z)])
            for x, y, z in sections
        ]
    )
    lining = moved(box(0.425, 0.44, 0.165, 0.03, 4), shift(z=-0.005))
    baffles = [
        moved(bored_block(0.15, 0.40, 0.004, 0.03, 24), shift(x, 0.0, -0.005) @ turn("y", 90.0))
        for x in (-0.14, -0.07, 0.0, 0.07, 0.14)
    ]
    cross = [
        moved(bored_block(0.42, 0.15, 0.004, 0.03, 24), shift(0.0, y, -0.005) @ turn("x", 90.0))
        for y in (-0.1, 0.1)
    ]
    sender = moved(
        turned([(0.055, 0.0), (0.055, 0.008), (0.03, 0.012), (0.03, 0.03), (0.01, 0.034)], 32),
        shift(0.05, 0.0, 0.088),
    )
    straps = [moved(box(0.03, 0.475, 0.215, 0.02), shift(x, 0.0, -0.008)) for x in (-0.13, 0.17)]
    return join([shell, lining, *baffles, *cross, sender, *straps])


def battery() -> Mesh:
    """Battery: case, lid, six caps, plates inside, two poles with clamps."""
    plates = [
        moved(slab(0.003, 0.14, 0.12), shift(x, 0.0, -0.005))
        for x in np.linspace(-0.105, 0.105, 24)
    ]
    caps = [
        moved(cylinder(0.011, 0.012, 16), shift(x, 0.02, 0.098))
        for x in np.linspace(-0.085, 0.085, 6)
    ]
    poles = [
        moved(
            join(
                [
                    cylinder(0.009, 0.03, 16),
                    moved(torus(0.011, 0.005, 20, 8), shift(z=-0.003)),
                    moved(hex_bolt(0.010, 0.02), shift(0.016) @ turn("y", 90.0)),
                ]
            ),
            shift(x, -0.05, 0.105),
        )
        for x in (-0.09, 0.09)
    ]
    tray = moved(box(0.27, 0.20, 0.012, 0.01), shift(z=-0.09))
    return join(
        [
            box(0.245, 0.172, 0.165, 0.008),
            moved(box(0.252, 0.178, 0.020, 0.008), shift(z=0.085)),
            *plates,
            *caps,
            *poles,
            tray,
        ]
    )


def harness() -> Mesh:
    """Wiring: a trunk along the car with its branches and plugs."""
    trunk = bent(
        [
            (1.50, 0.50, 0.78),
            (1.10, 0.53, 0.74),
            (0.93, 0.58, 0.68),
            (0.80, 0.60, 0.45),
            (0.6, 0.60, 0.275),
            (0.0, 0.61, 0.27),
            (-0.8, 0.61, 0.275),
            (-1.0, 0.58, 0.50),
            (-1.5, 0.57, 0.53),
            (-1.95, 0.56, 0.66),
        ],
        8,
    )
    branches = [
        [(1.48, 0.50, 0.775), (1.72, 0.54, 0.72), (1.90, 0.52, 0.65)],
        [
            (1.10, 0.53, 0.74),
            (0.98, 0.40, 0.78),
            (0.96, 0.0, 0.80),
            (1.02, -0.4, 0.76),
            (1.5, -0.53, 0.72),
            (1.90, -0.52, 0.65),
        ],
        [(0.82, 0.60, 0.50), (0.72, 0.50, 0.70), (0.70, 0.1, 0.74)],
        [(-1.93, 0.56, 0.66), (-2.0, 0.2, 0.62), (-2.0, -0.3, 0.62), (-1.97, -0.54, 0.66)],
    ]
    plugs = [moved(box(0.035, 0.03, 0.022, 0.004), shift(*b[-1])) for b in branches]
    return join([rod(trunk, 0.010, 8), *(rod(bent(b, 7), 0.007, 8) for b in branches), *plugs])


def add_supply(car: Assembly) -> None:
    """Fuel and electricity."""
    car.add("supply/fuel_tank", fuel_tank(), DARK, shift(-1.70, 0.13, 0.32))
    line = bent(
        [
            (-1.65, 0.13, 0.43),
            (-1.40, 0.22, 0.45),
            (-1.15, 0.30, 0.40),
            (-0.95, 0.32, 0.19),
            (0.0, 0.32, 0.14),
            (0.75, 0.32, 0.15),
            (0.94, 0.30, 0.40),
            (1.05, 0.28, 0.66),
        ],
        8,
    )
    car.add("supply/fuel_line", rod(line, 0.006), COPPER)
    car.add("supply/battery", battery(), DARK, shift(1.06, -0.52, 0.72) @ turn("z", 90.0))
    car.add("supply/wiring_harness", harness(), AMBER)


def add_supplies(car: Assembly) -> None:
    """What cools, feeds and relieves the engine."""
    add_cooling(car)
    add_exhaust(car)
    add_supply(car)
