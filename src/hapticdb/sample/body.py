"""The car's body: panels cut from one smooth skin, glass, lights and trim.

World frame: x forward, y left, z up, the ground at z = 0. The lower skin has for its section at
each x a superellipse from the widest line over the shoulder to the middle of hood and boot, and
below the widest line a flank that is tucked in towards the sill.
"""

import numpy as np
from scipy.interpolate import PchipInterpolator

from hapticdb.sample.parts import AMBER, CHROME, DARK, GLASS, PAINT, RED, RUBBER, Assembly
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
    mirrored,
    moved,
    rod,
    rounded_rectangle,
    sheet,
    shift,
    sweep,
    tube,
    turn,
    turned,
)

FRONT_AXLE = 1.28
REAR_AXLE = -1.27
WHEEL_RADIUS = 0.31
ARCH = 0.365
WIDEST = 0.55
ROUNDNESS = 4.0
PANEL = 0.009
BELT = 52.0

half_width = PchipInterpolator(
    [-2.12, -2.0, -1.8, -1.4, 0.0, 1.3, 1.75, 1.95, 2.08],
    [0.70, 0.76, 0.80, 0.838, 0.85, 0.84, 0.80, 0.75, 0.66],
)
crest = PchipInterpolator(
    [-2.12, -1.9, -1.45, -0.5, 0.75, 1.3, 1.8, 2.08],
    [0.91, 0.96, 1.005, 1.0, 0.985, 0.915, 0.80, 0.69],
)


def skin(x: Floats, angle: Floats) -> Floats:
    """Points of the left half of the skin above its widest line; angle 0..90 degrees."""
    power = 2.0 / ROUNDNESS
    radians = np.radians(angle)
    y = half_width(x) * np.clip(np.cos(radians), 0.0, 1.0) ** power
    z = WIDEST + (crest(x) - WIDEST) * np.sin(radians) ** power
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1)


def flank(x: Floats, z: Floats) -> Floats:
    """Points of the left flank at given heights, below the widest line and above it."""
    above = np.clip((z - WIDEST) / (crest(x) - WIDEST), 0.0, 1.0)
    below = np.clip((WIDEST - z) / WIDEST, 0.0, 1.0)
    y = half_width(x) * (1.0 - above**ROUNDNESS) ** (1.0 / ROUNDNESS) - 0.16 * below**2
    return np.stack(np.broadcast_arrays(x, y, z), axis=-1)


def height_at(x: Floats, angle: float) -> Floats:
    """Height of the skin at an angle of its section."""
    return np.asarray(skin(x, np.full_like(x, angle))[..., 2])


def arch_edge(x: Floats, sill: float) -> Floats:
    """Lower edge of a panel: the sill, or the wheel arch above it."""
    edge = np.full_like(x, sill)
    for axle in (FRONT_AXLE, REAR_AXLE):
        rise = np.sqrt(np.maximum(ARCH**2 - (x - axle) ** 2, 0.0))
        edge = np.where(np.abs(x - axle) < ARCH, np.maximum(sill, WHEEL_RADIUS + rise), edge)
    return edge


def stations(start: float, end: float, step: float = 0.03) -> Floats:
    """Places along x from start to end, with the corners of the wheel arches among them."""
    x = np.linspace(start, end, max(int(abs(end - start) / step), 2) + 1)
    corners = [
        a + s * (ARCH + e) for a in (FRONT_AXLE, REAR_AXLE) for s in (-1, 1) for e in (1e-4, -1e-3)
    ]
    inside = [c for c in corners if min(start, end) + 1e-3 < c < max(start, end) - 1e-3]
    return np.unique(np.concatenate([x, inside]))


def side_panel(
    start: float, end: float, sill: float, angle: float, thickness: float = PANEL
) -> Mesh:
    """Panel of the left side from the sill, or the wheel arch, up to an angle of the section."""
    x = stations(start, end)
    low, high = arch_edge(x, sill), height_at(x, min(angle, BELT))
    z = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, 15)
    points = flank(np.broadcast_to(x[:, None], z.shape), z)
    if angle > BELT:
        angles = np.linspace(BELT, angle, 8)[1:]
        over = skin(np.broadcast_to(x[:, None], (len(x), 7)), np.broadcast_to(angles, (len(x), 7)))
        points = np.concatenate([points, over], axis=1)
    return sheet(points, thickness)


def lid(start: float, end: float, angle: float, thickness: float) -> Mesh:
    """Panel across the middle of the car, between an angle of the section on either side."""
    x = stations(start, end, 0.04)
    half = skin(
        np.broadcast_to(x[:, None], (len(x), 16)),
        np.broadcast_to(np.linspace(angle, 90.0, 16), (len(x), 16)),
    )
    other = half[:, -2::-1] * [1.0, -1.0, 1.0]
    return sheet(np.concatenate([half, other], axis=1), thickness)


def between(first: Floats, second: Floats, rows: int, bulge: float = 0.0) -> Floats:
    """Surface (rows, N, 3) from one curve (N, 3) to another, bulged along z and outward."""
    t = np.linspace(0.0, 1.0, rows)[:, None, None]
    rise = bulge * 4.0 * t * (1.0 - t) * np.array([0.0, 0.0, 1.0])
    return np.asarray(first * (1.0 - t) + second * t + rise)


def arc(x: float, bow: float, y: float, z: float, sag: float, columns: int = 25) -> Floats:
    """Curve across the car: half width y, its middle ahead by bow and its ends lower by sag."""
    t = np.linspace(1.0, -1.0, columns)
    return np.column_stack([x - bow * t**2, y * t, z - sag * t**2])


WINDSCREEN = (arc(0.80, 0.13, 0.715, 0.985, 0.055), arc(0.14, 0.05, 0.565, 1.385, 0.035))
REAR_WINDOW = (arc(-0.96, -0.02, 0.555, 1.365, 0.035), arc(-1.52, -0.14, 0.69, 1.01, 0.05))


def roof() -> Mesh:
    """Roof panel, between the upper edges of windscreen and rear window."""
    front, back = WINDSCREEN[1] + [-0.008, 0.0, 0.006], REAR_WINDOW[0] + [0.008, 0.0, 0.006]
    return sheet(between(front, back, 33, 0.045), 0.014)


def bumper(x: float, nose: float, width: float, low: float, high: float) -> Mesh:
    """Bumper skin: a section bowed outward, carried round the end of the car."""
    along = np.radians(np.linspace(-90.0, 90.0, 49))
    up = np.linspace(0.0, 1.0, 13)
    swell = 1.0 - 0.35 * np.abs(2.0 * up - 0.9) ** 2.5
    plan_x = np.sign(nose) * np.clip(np.cos(along), 0.0, 1.0) ** 0.55
    plan_y = np.sign(np.sin(along)) * np.abs(np.sin(along)) ** 0.55
    points = np.empty((49, 13, 3))
    points[..., 0] = x + plan_x[:, None] * abs(nose) * (0.55 + 0.45 * swell)
    points[..., 1] = plan_y[:, None] * (width - 0.05 * (1.0 - swell))
    points[..., 2] = low + (high - low) * up
    return sheet(points if nose < 0 else points[::-1], 0.012)


def grille() -> Mesh:
    """Frame and slats between the headlights."""
    outline = rounded_rectangle(0.72, 0.105, 0.03, 4)
    frame = [
        sweep(
            np.column_stack([np.full(len(outline), 2.03), outline]),
            0.011 * rounded_rectangle(1.0, 1.0, 0.3),
            ring=True,
        )
    ]
    frame += [
        moved(box(0.02, 0.69, 0.006, 0.002), shift(2.025, 0.0, z))
        for z in (-0.03, -0.01, 0.01, 0.03)
    ]
    frame += [
        moved(box(0.016, 0.006, 0.09, 0.002), shift(2.02, y)) for y in np.linspace(-0.3, 0.3, 9)
    ]
    return moved(join(frame), shift(z=0.625))


def headlight() -> Mesh:
    """Left headlight: bowl, lens with rings and bulb."""
    lens = turned([(0.072, 0.0), (0.07, 0.012), (0.055, 0.026), (0.03, 0.034), (0.006, 0.036)], 36)
    bowl = lathe(
        [
            (0.02, -0.09),
            (0.05, -0.06),
            (0.075, -0.005),
            (0.083, -0.005),
            (0.083, 0.008),
            (0.073, 0.008),
            (0.046, -0.052),
            (0.02, -0.08),
        ],
        36,
    )
    shapes = join(
        [lens, bowl, moved(ball(0.016), shift(z=-0.035)), moved(torus_trim(), shift(z=0.004))]
    )
    return moved(shapes, shift(2.0, 0.51, 0.635) @ turn("z", 12.0) @ turn("y", 84.0))


def torus_trim() -> Mesh:
    """Bright ring around a headlight."""
    return lathe([(0.082, -0.006), (0.092, -0.004), (0.092, 0.006), (0.082, 0.012)], 36)


def tail_light() -> Mesh:
    """Left tail light: three lenses in a row on a base."""
    lenses = [moved(box(0.03, 0.078, 0.10, 0.012), shift(0.0, y)) for y in (-0.085, 0.0, 0.085)]
    base = moved(box(0.02, 0.27, 0.125, 0.008), shift(0.014))
    ribs = [
        moved(box(0.036, 0.004, 0.102, 0.001), shift(-0.001, y))
        for y in np.linspace(-0.11, 0.11, 12)
    ]
    return moved(join([*lenses, base, *ribs]), shift(-2.075, 0.55, 0.72) @ turn("z", 10.0))


def plate(text: int) -> Mesh:
    """Licence plate with a raised rim and bars for characters."""
    rim = sweep(
        np.column_stack([np.zeros(16), rounded_rectangle(0.50, 0.105, 0.012)]),
        rounded_rectangle(0.006, 0.006, 0.002),
        ring=True,
    )
    bars = [
        moved(box(0.006, 0.030, h, 0.002), shift(0.003, y, 0.004 * ((i * text) % 3 - 1)))
        for i, (y, h) in enumerate(
            zip(
                np.linspace(-0.19, 0.19, 7), (0.07, 0.05, 0.07, 0.03, 0.07, 0.06, 0.07), strict=True
            )
        )
    ]
    return join([rim, box(0.006, 0.49, 0.095, 0.002), *bars])


def mirror() -> Mesh:
    """Left door mirror: shell, glass and foot."""
    shell = turned(
        [(0.03, -0.05), (0.06, -0.035), (0.078, 0.0), (0.082, 0.035), (0.078, 0.038)], 28
    )
    shell = Mesh(shell.vertices * [0.75, 1.15, 1.0], shell.faces)
    foot = rod([(0.0, -0.15, -0.035), (0.0, -0.11, -0.03), (0.0, -0.06, 0.0)], 0.012)
    return moved(join([moved(shell, turn("y", -90.0)), foot]), shift(0.52, 0.925, 0.985))


def wiper(side: float) -> Mesh:
    """Wiper: arm and blade lying on the windscreen, pivot at the cowl."""
    low, high = WINDSCREEN
    across = np.linspace(side, side + 0.24, 9)
    t = np.linspace(0.06, 0.52, 9)
    surface = np.array(
        [low[0] * 0 + _on_glass(u, y, low, high) for u, y in zip(t, across, strict=True)]
    )
    normal = np.array([0.52, 0.0, 0.85])
    blade = sweep(surface + 0.010 * normal, rounded_rectangle(0.010, 0.014, 0.003))
    arm = rod(
        [surface[0] + 0.004 * normal, surface[2] + 0.028 * normal, surface[5] + 0.024 * normal],
        0.005,
    )
    pivot = moved(cylinder(0.014, 0.05), aligned(surface[0], surface[0] + normal))
    return join([blade, arm, pivot])


def _on_glass(t: float, y: float, low: Floats, high: Floats) -> Floats:
    """Point of the windscreen at a share t of its height, at lateral position y."""
    line = low * (1.0 - t) + high * t + [0.0, 0.0, 4.0 * 0.02 * t * (1.0 - t)]
    order = np.argsort(line[:, 1])
    return np.array([np.interp(y, line[order, 1], line[order, axis]) for axis in range(3)])


def pillars() -> dict[str, Mesh]:
    """Left pillars, the foremost with the roof rail."""
    section = rounded_rectangle(0.055, 0.035, 0.01)
    a = bent(
        [
            WINDSCREEN[0][0] + [-0.005, 0.005, -0.01],
            (0.40, 0.662, 1.185),
            WINDSCREEN[1][0] + [-0.005, 0.02, 0.0],
        ],
        8,
    )
    b = [(-0.24, 0.695, 0.90), (-0.245, 0.668, 1.10), (-0.25, 0.600, 1.345)]
    rail = bent(
        [a[-1], (-0.2, 0.598, 1.372), (-0.6, 0.594, 1.362), REAR_WINDOW[0][0] + [0.0, 0.02, 0.0]], 8
    )
    top = np.linspace(
        REAR_WINDOW[0][0] + [0.22, 0.035, 0.0], REAR_WINDOW[0][0] + [-0.01, 0.012, 0.0], 9
    )
    base = np.linspace((-1.02, 0.712, 0.925), REAR_WINDOW[1][0] + [-0.02, -0.03, -0.002], 9)
    c = sheet(between(base, top, 13)[:, ::-1], 0.022)
    return {
        "pillar_a": join([sweep(a, section), sweep(rail, section)]),
        "pillar_b": sweep(b, section),
        "pillar_c": c,
    }


def door(start: float, end: float, window: list[tuple[float, float]], grip: float) -> Mesh:
    """Left door: hollow leaf, handle at `grip`, window frame through (x, share of height)."""
    leaf = side_panel(start, end, 0.30, BELT, 0.034)
    beam = rod(
        [
            (start + 0.08, 0.805, 0.45),
            (end - 0.08, 0.805, 0.60),
        ],
        0.014,
    )
    points = [
        (x, 0.690 - 0.078 * t + 0.014 * np.sin(np.pi * t), 0.935 + 0.405 * t) for x, t in window
    ]
    frame = sweep(bent(points, 5), rounded_rectangle(0.028, 0.022, 0.005))
    return join([leaf, beam, frame, handle(grip)])


def handle(x: float) -> Mesh:
    """Left door handle: a bow on two feet."""
    bow = bent(
        [
            (x - 0.085, 0.828, 0.80),
            (x - 0.06, 0.858, 0.802),
            (x + 0.06, 0.858, 0.802),
            (x + 0.085, 0.828, 0.80),
        ],
        4,
    )
    return join(
        [
            sweep(bow, rounded_rectangle(0.016, 0.022, 0.005)),
            moved(cylinder(0.012, 0.02), shift(x + 0.11, 0.832, 0.80) @ turn("x", 90.0)),
        ]
    )


def nose_panel() -> Mesh:
    """Panel between bumper and hood, open behind the grille."""
    points = between(arc(1.985, 0.05, 0.72, 0.53, 0.0), arc(1.985, 0.05, 0.69, 0.705, 0.03), 9)
    kept = np.ones((8, 24), dtype=np.bool_)
    kept[3:7, 7:17] = False
    return sheet(points, PANEL, kept)


def add_panels(car: Assembly) -> None:
    """Painted panels."""
    car.add("body/hood", lid(0.80, 2.0, 61.0, 0.012), PAINT)
    car.add("body/trunk_lid", lid(-2.06, -1.55, 61.0, 0.012), PAINT)
    car.add("body/roof", roof(), PAINT)
    car.add("body/rear_deck", lid(-1.545, -1.36, 61.0, PANEL), PAINT)
    car.add("body/bumper_front", bumper(1.66, 0.44, 0.822, 0.20, 0.555), PAINT)
    car.add("body/bumper_rear", bumper(-1.66, -0.46, 0.822, 0.22, 0.60), PAINT)
    car.add_pair("body/fender", _fender(), PAINT)
    car.add_pair("body/quarter_panel", _quarter(), PAINT)
    front = [
        (0.62, -0.02),
        (0.40, 0.42),
        (0.13, 0.93),
        (-0.05, 1.0),
        (-0.205, 0.99),
        (-0.205, 0.5),
        (-0.20, -0.02),
    ]
    rear = [
        (-0.285, -0.02),
        (-0.285, 0.5),
        (-0.285, 0.99),
        (-0.5, 1.0),
        (-0.72, 0.95),
        (-0.90, 0.45),
        (-1.0, -0.02),
    ]
    car.add_pair("body/door_front", door(-0.236, 0.72, front, -0.12), PAINT)
    car.add_pair("body/door_rear", door(-0.895, -0.248, rear, -0.70), PAINT)
    for name, mesh in pillars().items():
        car.add_pair(f"body/{name}", mesh, PAINT)
    sill = moved(box(1.70, 0.10, 0.10, 0.02), shift(0.015, 0.755, 0.235))
    car.add_pair("body/sill", sill, PAINT)
    back = between(arc(-2.085, -0.10, 0.70, 0.60, 0.0), arc(-2.07, -0.07, 0.70, 0.912, 0.075), 9)
    car.add("body/rear_panel", sheet(back, PANEL), PAINT)
    car.add("body/nose_panel", nose_panel(), PAINT)
    beam = np.column_stack(
        [
            1.93 - 0.16 * np.linspace(1.0, -1.0, 17) ** 2,
            0.66 * np.linspace(1.0, -1.0, 17),
            np.full(17, 0.42),
        ]
    )
    section = rounded_rectangle(0.10, 0.05, 0.012)
    car.add("body/bumper_beam_front", sweep(beam, section), DARK)
    car.add(
        "body/bumper_beam_rear", sweep(beam * [-1.0, 1.0, 1.0] + [-0.13, 0.0, 0.02], section), DARK
    )
    car.add("body/hood_lining", moved(lid(0.86, 1.93, 63.0, 0.010), shift(z=-0.030)), DARK)


def _fender() -> Mesh:
    return join([side_panel(0.73, 1.66, 0.22, 60.0), side_panel(1.668, 2.0, 0.56, 60.0)])


def _quarter() -> Mesh:
    return join([side_panel(-1.64, -0.903, 0.24, 60.0), side_panel(-2.06, -1.645, 0.605, 60.0)])


def add_glass(car: Assembly) -> None:
    """Windscreen and rear window; the side windows are wound down."""
    car.add("body/windscreen", sheet(between(*WINDSCREEN, 25, 0.02), 0.007), GLASS)
    car.add("body/rear_window", sheet(between(*REAR_WINDOW, 21, 0.02), 0.007), GLASS)


def add_trim(car: Assembly) -> None:
    """Lights, grille, mirrors, wipers, plates, handles."""
    slots = np.ones((4, 40), dtype=np.bool_)
    slots[1:3, 1:-1:2] = False
    cowl = between(
        arc(0.795, 0.0, 0.70, 0.955, 0.04, 41), arc(0.68, 0.06, 0.70, 0.945, 0.04, 41), 5
    )
    car.add("trim/cowl", sheet(cowl, 0.006, slots), DARK)
    car.add("trim/grille", grille(), CHROME)
    car.add_pair("trim/headlight", headlight(), AMBER)
    car.add_pair("trim/tail_light", tail_light(), RED)
    car.add_pair("trim/mirror", mirror(), PAINT)
    car.add("trim/wiper_left", wiper(0.10), RUBBER)
    car.add("trim/wiper_right", wiper(-0.45), RUBBER)
    car.add("trim/plate_front", moved(plate(2), shift(2.115, 0.0, 0.40)), CHROME)
    car.add(
        "trim/plate_rear",
        moved(mirrored(plate(2)), shift(-2.10, 0.0, 0.74) @ turn("z", 180.0)),
        CHROME,
    )
    car.add(
        "trim/antenna",
        moved(
            join(
                [
                    moved(tube(0.012, 0.004, 0.02), shift(z=0.01)),
                    rod([(0, 0, 0), (-0.05, 0, 0.14), (-0.12, 0, 0.29)], 0.003, 6),
                    moved(ball(0.006, 8), shift(-0.12, 0.0, 0.29)),
                ]
            ),
            shift(-0.80, 0.0, 1.42),
        ),
        DARK,
    )


def add_body(car: Assembly) -> None:
    """Everything that one sees from outside, wheels apart."""
    add_panels(car)
    add_glass(car)
    add_trim(car)
