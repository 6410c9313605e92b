"""Floor, seats, dashboard, pedals and linings. World frame as in `body`."""

import numpy as np

from hapticdb.sample.body import (
    BELT,
    REAR_WINDOW,
    WINDSCREEN,
    arc,
    between,
    flank,
    height_at,
    stations,
)
from hapticdb.sample.chassis import STEERING_WHEEL
from hapticdb.sample.parts import CHROME, CLOTH, DARK, LEATHER, RUBBER, SPRING, STEEL, Assembly
from hapticdb.sample.shapes import (
    Floats,
    Mesh,
    bent,
    box,
    cylinder,
    helix,
    join,
    loft,
    moved,
    repeated,
    ring_plate,
    rod,
    rounded_rectangle,
    sheet,
    shift,
    slab,
    sweep,
    torus,
    tube,
    turn,
    turned,
)

# ---- floor -----------------------------------------------------------------------------------


def floor_height(x: Floats, y: Floats) -> Floats:
    """Height of the floor: flat, with the tunnel, the toe board and the step under the bench."""
    tunnel = np.clip((0.19 - np.abs(y)) / 0.06, 0.0, 1.0)
    height = np.interp(x, [-1.2, -0.2, 0.45, 0.95], [0.20, 0.20, 0.30, 0.37])
    toe = np.interp(x, [0.66, 0.92], [0.0, 0.22])
    step = 0.15 * np.clip((-0.60 - x) / 0.06, 0.0, 1.0)
    return np.asarray(0.232 + np.maximum(np.maximum(height * tunnel**0.7, toe), step))


def floor_sheet(
    bounds: tuple[float, float], half: float, lift: float, thickness: float, swage: float
) -> Mesh:
    """Sheet following the floor, lifted off it; `swage` is the depth of its stiffening beads."""
    x = np.linspace(*bounds, 49)[:, None]
    y = np.linspace(half, -half, 41)[None, :]
    z = floor_height(x, y) + lift
    flat = (np.abs(y) > 0.22) & (np.abs(y) < 0.60)
    z = z + swage * flat * (np.sin(x * 2.0 * np.pi / 0.12) > 0.3)
    return sheet(np.stack(np.broadcast_arrays(x, y, z), axis=2), thickness)


def boot_floor() -> Mesh:
    """Boot floor with beads, and the wall behind the rear seat."""
    path = [
        (-1.03, 0.90),
        (-1.05, 0.60),
        (-1.08, 0.515),
        (-1.2, 0.505),
        *((x, 0.505 + 0.008 * (i % 2)) for i, x in enumerate(np.linspace(-1.3, -1.9, 22))),
        (-2.0, 0.505),
        (-2.03, 0.60),
    ]
    y = np.linspace(0.60, -0.60, 21)
    return sheet(
        np.stack([np.column_stack([np.full(21, x), y, np.full(21, z)]) for x, z in path]), 0.008
    )


def firewall() -> Mesh:
    """Wall between engine and cabin, cut out over the gearbox."""
    z = np.linspace(0.40, 0.93, 23)
    y = np.linspace(0.67, -0.67, 49)
    zz, yy = np.meshgrid(z, y, indexing="ij")
    x = (
        0.925
        - 0.05 * np.clip((zz - 0.75) / 0.18, 0.0, 1.0)
        + 0.006 * (np.sin(yy * 2.0 * np.pi / 0.16) > 0.4)
    )
    middle = 0.25 * (zz[:-1, :-1] + zz[1:, 1:]) * 2.0, 0.5 * (yy[:-1, :-1] + yy[1:, 1:])
    kept = ~((middle[0] < 0.60) & (np.abs(middle[1]) < 0.19))
    return sheet(np.stack([x, yy, zz], axis=2), 0.010, kept)


def parcel_shelf() -> Mesh:
    """Shelf under the rear window with two loudspeakers."""
    board = sheet(
        between(arc(-1.06, 0.0, 0.66, 0.925, 0.0), arc(-1.50, -0.10, 0.66, 0.925, 0.0), 9), 0.016
    )
    speakers = [
        moved(
            join(
                [
                    torus(0.075, 0.008, 36, 8),
                    *(torus(r, 0.003, 32, 6) for r in (0.02, 0.04, 0.06)),
                    tube(0.070, 0.064, 0.05),
                ]
            ),
            shift(-1.24, s * 0.40, 0.93),
        )
        for s in (-1, 1)
    ]
    return join([board, *speakers])


def headliner() -> Mesh:
    """Lining under the roof, quilted."""
    front, back = WINDSCREEN[1] + [-0.05, 0.0, -0.028], REAR_WINDOW[0] + [0.05, 0.0, -0.028]
    points = between(front, back, 61, 0.042) * [1.0, 0.97, 1.0]
    rows = np.arange(61)[:, None]
    points[..., 2] -= 0.006 * (rows % 6 == 0)
    return sheet(points, 0.012)


# ---- seats -----------------------------------------------------------------------------------


def upholstered(length: float, width: float, depth: float, channels: int, bolster: float) -> Mesh:
    """Pad with its foam, 15 mm under the cover."""
    foam = pad(length - 0.03, width - 0.03, depth - 0.03, channels, bolster)
    return join([pad(length, width, depth, channels, bolster), foam])


def pad(length: float, width: float, depth: float, channels: int, bolster: float) -> Mesh:
    """Upholstered pad along x, its upper side towards +z: channels across, bolsters along."""
    y = np.linspace(-1.0, 1.0, 25)
    edge = np.clip((np.abs(y) - 0.72) / 0.28, 0.0, 1.0)
    profile = np.sqrt(np.clip(1.0 - np.abs(y) ** 8, 0.0, 1.0))
    rise = bolster * np.sin(np.pi * np.clip(edge * 0.8, 0.0, 1.0))
    sections = []
    steps = 4 * channels + 1
    for u in np.linspace(0.0, 1.0, steps):
        ends = (1.0 - abs(2.0 * u - 1.0) ** 10) ** 0.5
        groove = 0.010 * abs(np.sin(np.pi * channels * u)) ** 0.35 * (edge < 0.2)
        top = (0.5 * depth * max(ends, 0.25) * np.maximum(profile, 0.12)) + (rise + groove) * ends
        bottom = -0.5 * depth * max(ends, 0.25) * np.maximum(profile, 0.12)
        w = 0.5 * width * (0.94 + 0.06 * ends)
        over = np.column_stack([np.full(25, (u - 0.5) * length), w * y, top])
        under = np.column_stack([np.full(25, (u - 0.5) * length), w * y[::-1], bottom[::-1]])
        sections.append(np.vstack([over, under]))
    return loft(sections)


def seat_springs(length: float, width: float, columns: int, rows: int) -> Mesh:
    """Seat frame: rails, wire border, and rows of upright coil springs."""
    outline = rounded_rectangle(length, width, 0.04, 4)
    borders = [
        sweep(
            np.column_stack([outline, np.full(len(outline), z)]),
            0.008 * rounded_rectangle(1.0, 1.0, 0.3),
            ring=True,
        )
        for z in (0.0, 0.075)
    ]
    coil = rod(helix(0.026, 0.07, 3.5, 9), 0.0028, 4)
    x, y = (
        np.linspace(-0.5, 0.5, columns) * (length - 0.10),
        np.linspace(-0.5, 0.5, rows) * (width - 0.10),
    )
    coils = repeated(coil, [shift(a, b, 0.0375) for a in x for b in y])
    slats = [moved(slab(length, 0.016, 0.004), shift(0.0, b)) for b in y]
    return join([*borders, coils, *slats])


def seat_rails() -> Mesh:
    """Rails, feet and crossbars that carry a front seat."""
    beams = [moved(box(0.52, 0.030, 0.022, 0.005), shift(0.0, s * 0.19)) for s in (-1, 1)]
    feet = [
        moved(box(0.035, 0.035, 0.10, 0.006), shift(x, s * 0.19, -0.05))
        for x in (-0.22, 0.22)
        for s in (-1, 1)
    ]
    bars = [
        moved(cylinder(0.010, 0.38), shift(x, 0.0, 0.012) @ turn("x", 90.0)) for x in (-0.18, 0.2)
    ]
    return join([*beams, *feet, *bars])


def headrest() -> Mesh:
    """Headrest with its two posts."""
    cushion = pad(0.16, 0.27, 0.085, 2, 0.006)
    posts = [
        moved(cylinder(0.006, 0.14), shift(-0.13, s * 0.06) @ turn("y", 90.0)) for s in (-1, 1)
    ]
    return join([cushion, *posts])


def add_seats(car: Assembly) -> None:
    """Two front seats and a rear bench: cushions, backs, springs, headrests."""
    shapes = (
        (
            "cushion",
            upholstered(0.50, 0.52, 0.13, 5, 0.035),
            LEATHER,
            shift(-0.02, 0.0, 0.455) @ turn("y", -7.0),
        ),
        (
            "back",
            upholstered(0.60, 0.50, 0.11, 6, 0.040),
            LEATHER,
            shift(-0.34, 0.0, 0.76) @ turn("y", -106.0) @ turn("x", 180.0),
        ),
        (
            "headrest",
            headrest(),
            LEATHER,
            shift(-0.455, 0.0, 1.165) @ turn("y", -104.0) @ turn("x", 180.0),
        ),
        (
            "springs",
            join([seat_springs(0.44, 0.46, 6, 6), moved(seat_rails(), shift(0.0, 0.0, -0.035))]),
            SPRING,
            shift(-0.02, 0.0, 0.41) @ turn("y", -7.0),
        ),
    )
    for side, y in (("left", 0.36), ("right", -0.36)):
        for name, mesh, color, placement in shapes:
            car.add(f"seats/seat_{name}_{side}", mesh, color, shift(0.0, y) @ placement)
    car.add(
        "seats/bench_cushion",
        upholstered(0.48, 1.26, 0.14, 5, 0.02),
        LEATHER,
        shift(-0.72, 0.0, 0.485) @ turn("y", -7.0),
    )
    car.add(
        "seats/bench_back",
        upholstered(0.56, 1.24, 0.12, 6, 0.02),
        LEATHER,
        shift(-0.98, 0.0, 0.745) @ turn("y", -111.0) @ turn("x", 180.0),
    )
    car.add(
        "seats/bench_springs",
        seat_springs(0.42, 1.16, 5, 13),
        SPRING,
        shift(-0.72, 0.0, 0.44) @ turn("y", -7.0),
    )


# ---- dashboard, console, pedals --------------------------------------------------------------


def dashboard() -> Mesh:
    """Dashboard: one body across the car with a binnacle, vents, glove box, radio."""
    glove = moved(box(0.02, 0.38, 0.12, 0.008), shift(0.465, -0.40, 0.765) @ turn("y", -18.0))
    return join([_dashboard_body(), *map(_vent, (-0.60, -0.08, 0.08, 0.60)), glove, _radio()])


def _dashboard_body() -> Mesh:
    """One outline, drawn across the car and swollen into a binnacle before the driver."""
    outline = np.array(
        [
            (0.70, 0.925),
            (0.56, 0.945),
            (0.46, 0.925),
            (0.43, 0.885),
            (0.45, 0.80),
            (0.50, 0.72),
            (0.58, 0.66),
            (0.66, 0.66),
            (0.78, 0.74),
            (0.80, 0.86),
        ]
    )
    outline = bent(np.vstack([outline, outline[:1]]), 3)[:-1]
    y = np.linspace(0.70, -0.70, 45)
    swell = 0.030 * np.exp(-(((y - 0.36) / 0.17) ** 2))
    centre = outline.mean(axis=0)
    return loft(
        [
            np.column_stack(
                [
                    centre[0] + (outline[:, 0] - centre[0]) * (1.0 - 0.35 * s),
                    np.full(len(outline), v),
                    outline[:, 1] + s * (outline[:, 1] > 0.88),
                ]
            )
            for v, s in zip(y, swell, strict=True)
        ]
    )


def _vent(across: float) -> Mesh:
    """A frame with three slats; `across` is its y."""
    frame = ring_plate(
        rounded_rectangle(0.15, 0.055, 0.012, 4),
        rounded_rectangle(0.138, 0.043, 0.008, 4),
        -0.012,
        0.008,
    )
    slats = [moved(slab(0.138, 0.003, 0.014), shift(0.0, v)) for v in (-0.012, 0.0, 0.012)]
    return moved(
        join([frame, *slats]), shift(0.433, across, 0.85) @ turn("z", -90.0) @ turn("x", 80.0)
    )


def _radio() -> Mesh:
    """A box with two knobs and five buttons."""
    body = box(0.02, 0.19, 0.06, 0.006)
    knobs = [
        moved(cylinder(0.012, 0.03, 20), shift(-0.012, s * 0.075) @ turn("y", 90.0))
        for s in (-1, 1)
    ]
    buttons = [
        moved(box(0.012, 0.016, 0.010, 0.002), shift(-0.010, u, -0.016))
        for u in np.linspace(-0.045, 0.045, 5)
    ]
    return moved(join([body, *knobs, *buttons]), shift(0.452, 0.0, 0.785) @ turn("y", -14.0))


def cluster() -> Mesh:
    """Instruments: two dials with ticks and needles, three small ones, in a frame."""

    def dial(radius: float, ticks: int, needle: float) -> Mesh:
        bezel = moved(torus(radius, 0.005, 40, 8), shift(z=0.004))
        face = turned([(0.96 * radius, -0.004), (0.96 * radius, 0.0)], 40)
        marks = [
            moved(slab(0.010, 0.0025, 0.004), turn("z", a) @ shift(0.82 * radius))
            for a in np.linspace(-40.0, 220.0, ticks)
        ]
        hand = moved(
            slab(0.8 * radius, 0.004, 0.003), turn("z", needle) @ shift(0.35 * radius, 0.0, 0.004)
        )
        return join([bezel, face, *marks, hand, moved(cylinder(0.006, 0.01, 16), shift(z=0.004))])

    dials = [
        moved(dial(r, n, a), shift(x, y))
        for x, y, r, n, a in (
            (-0.082, 0.0, 0.055, 15, 120.0),
            (0.082, 0.0, 0.055, 11, 60.0),
            (0.0, 0.024, 0.022, 5, 90.0),
            (0.0, -0.030, 0.022, 5, 140.0),
        )
    ]
    frame = ring_plate(
        rounded_rectangle(0.32, 0.14, 0.05, 6), rounded_rectangle(0.30, 0.12, 0.044, 6), -0.01, 0.03
    )
    return join([*dials, frame, moved(box(0.30, 0.12, 0.006, 0.04, 6), shift(z=-0.010))])


def moved_outline(outline: Floats, x: float, z: float) -> Floats:
    """An outline (K, 2) of y and height as points (K, 3) at one x, lifted by z."""
    return np.column_stack([np.full(len(outline), x), outline[:, 0], outline[:, 1] + z])


def console() -> Mesh:
    """Centre console along the tunnel: body, gaiter ring, cup holders, armrest, hand brake."""
    path = [
        (0.46, 0.60, 0.17, 0.15),
        (0.40, 0.585, 0.17, 0.10),
        (0.10, 0.505, 0.17, 0.09),
        (-0.25, 0.47, 0.16, 0.10),
        (-0.50, 0.46, 0.15, 0.10),
    ]
    body = loft(
        [moved_outline(rounded_rectangle(w, h, 0.02), x, z - h / 2.0) for x, z, w, h in path]
    )
    cups = [
        moved(tube(0.040, 0.036, 0.03, 28), shift(x, 0.0, z))
        for x, z in ((0.20, 0.545), (0.10, 0.52))
    ]
    armrest = moved(box(0.30, 0.14, 0.05, 0.02, 4), shift(-0.32, 0.0, 0.525))
    brake = rod(bent([(-0.12, 0.055, 0.50), (0.0, 0.055, 0.545), (0.13, 0.055, 0.59)], 4), 0.013)
    return join([body, *cups, armrest, brake])


def pedal(width: float, height: float) -> Mesh:
    """Pedal: a ribbed pad at the origin, its arm up to the pivot."""
    plate = box(0.012, width, height, 0.004)
    ribs = [
        moved(slab(0.008, 0.9 * width, 0.005), shift(-0.008, 0.0, z))
        for z in np.linspace(-0.4, 0.4, 6) * height
    ]
    arm = sweep(
        bent([(0.006, 0.0, 0.0), (0.05, 0.0, 0.10), (0.075, 0.0, 0.22), (0.07, 0.0, 0.30)], 5),
        rounded_rectangle(0.012, 0.022, 0.004),
    )
    pivot = moved(tube(0.014, 0.008, 0.04), shift(0.07, 0.0, 0.30) @ turn("x", 90.0))
    return join([plate, *ribs, arm, pivot])


def add_controls(car: Assembly) -> None:
    """Dashboard, instruments, console, pedals."""
    car.add("cabin/dashboard", dashboard(), DARK)
    world_from_dial = shift(0.425, STEERING_WHEEL[1], 0.925) @ turn("z", -90.0) @ turn("x", 72.0)
    car.add("cabin/instruments", cluster(), CHROME, world_from_dial)
    car.add("cabin/console", console(), CLOTH)
    for name, y, width, height in (
        ("clutch", 0.46, 0.06, 0.065),
        ("brake", 0.36, 0.085, 0.065),
        ("accelerator", 0.26, 0.05, 0.13),
    ):
        car.add(f"cabin/pedal_{name}", pedal(width, height), RUBBER, shift(0.66, y, 0.43))


def door_trim(start: float, end: float, rest: float) -> Mesh:
    """Left door lining: a quilted panel with an armrest, pocket, loudspeaker and catch."""
    x = stations(start, end)
    high = height_at(x, BELT) - 0.012
    low = np.maximum(0.31, np.where(x < -0.78, 0.31 + 1.1 * (-0.78 - x), 0.31))
    z = low[:, None] + (high - low)[:, None] * np.linspace(0.0, 1.0, 19)
    points = flank(np.broadcast_to(x[:, None], z.shape), z)
    points[..., 1] = np.minimum(points[..., 1], 0.835) - 0.060 - 0.006 * (np.arange(19) % 4 == 0)
    lining = sheet(points, 0.014)
    arm = moved(box(0.32, 0.075, 0.045, 0.018, 4), shift(rest, 0.745, 0.64))
    pocket = moved(
        ring_plate(
            rounded_rectangle(0.34, 0.05, 0.015),
            rounded_rectangle(0.328, 0.038, 0.010),
            -0.05,
            0.05,
        ),
        shift(rest, 0.748, 0.40),
    )
    catch = rod(
        bent(
            [(rest + 0.20, 0.755, 0.76), (rest + 0.17, 0.73, 0.765), (rest + 0.10, 0.73, 0.765)], 4
        ),
        0.008,
    )
    return join([lining, arm, pocket, catch])


def add_linings(car: Assembly) -> None:
    """Floor pan, walls, carpet, head and door linings."""
    car.add("cabin/floor_pan", floor_sheet((0.92, -1.06), 0.70, 0.0, 0.010, 0.008), STEEL)
    car.add("cabin/carpet", floor_sheet((0.90, -1.02), 0.685, 0.026, 0.012, 0.0), CLOTH)
    car.add("cabin/boot_floor", boot_floor(), STEEL)
    mat = sheet(
        between(arc(-1.10, 0.0, 0.585, 0.53, 0.0), arc(-2.0, 0.0, 0.585, 0.53, 0.0), 9), 0.012
    )
    car.add("cabin/boot_carpet", mat, CLOTH)
    car.add("cabin/firewall", firewall(), STEEL)
    car.add("cabin/parcel_shelf", parcel_shelf(), CLOTH)
    car.add("cabin/headliner", headliner(), CLOTH)
    car.add_pair("cabin/door_trim_front", door_trim(0.66, -0.20, 0.16), LEATHER)
    car.add_pair("cabin/door_trim_rear", door_trim(-0.27, -0.86, -0.52), LEATHER)


def add_cabin(car: Assembly) -> None:
    """Everything inside."""
    add_linings(car)
    add_seats(car)
    add_controls(car)
