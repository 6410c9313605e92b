"""Sessions with distances: both renderings, the device's coupling, recordings."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from children import TIMEOUT
from hapticdb import Coupling, Environment, Handle, PointShell, TangentPlane
from hapticdb.devices.protocol import Device
from hapticdb.devices.scripted import Player
from hapticdb.devices.simulated import SimulatedDevice
from hapticdb.errors import UsageError
from hapticdb.query.law import DistanceField, ForceLaw
from hapticdb.recording.file import Recording, State
from hapticdb.session.coupling import DirectRendering, SettledCoupling
from hapticdb.session.prefetch.resident_cells import ResidentCells
from hapticdb.session.report import Report
from hapticdb.session.session import Session
from hapticdb.tabular.schema import plain
from session.hands import Beckoned, Steady, at, still
from session.sessions import NEVER_STALE, RATE, felt_at, floored, recorded, until
from session.worlds import SIZE, make

HEIGHT = 31.5
"""Height of the floor in voxels from the grid's origin: 1 mm below the world's origin."""
ONSET = 1.5 * SIZE
"""Distance at which contact begins, metres."""
RADIUS = 0.012
"""Radius of the tool, metres."""


@pytest.fixture(scope="module")
def cells(distance_floor: Environment) -> Iterator[ResidentCells]:
    with ResidentCells(distance_floor.url, budget_bytes=4 << 20) as made:
        yield made


def pressing(depth: float, seconds: float = 1.0) -> Player:
    """A hand that comes down until the sphere's lowest point would be so deep below the floor."""
    low = SIZE * (HEIGHT - 32.0) + ONSET + RADIUS - depth
    times = np.array([0.0, 0.3, 0.8, 0.9]) * seconds
    return Player(times, [at(0.0, 0.0, z) for z in (0.03, low, low, 0.03)], clock=Steady())


def felt(
    cells: ResidentCells | str,
    shell: PointShell,
    hand: Device,
    path: Path | None = None,
    **options: object,
) -> Report:
    with Session(
        cells,
        shell,
        hand,
        rate=RATE,
        record=path,
        staleness=NEVER_STALE,
        **options,  # type: ignore[arg-type]
    ) as session:
        report = session.wait(TIMEOUT)
    assert report is not None
    return report


@pytest.fixture(scope="module")
def ball() -> PointShell:
    return PointShell.sphere(RADIUS, 300)


def test_session_force_is_stiffness_times_depth(
    cells: ResidentCells, ball: PointShell, tmp_path: Path
) -> None:
    assert cells.has_distances
    report = felt(cells, ball, pressing(0.004), tmp_path / "s.hdbrec")
    assert (report.law, report.rendering) == ("distance", "coupled")
    assert isinstance(report.coupling, SettledCoupling)
    assert report.coupling.stiffness == 1000.0
    # a sphere of 300 points touches with a point that lies up to a fifth of a millimetre higher
    assert report.peak_force == pytest.approx(4.0, abs=0.4)
    assert report.objects == (1,)
    assert report.inside_frames == report.unknown_frames == 0
    frames = recorded(tmp_path / "s.hdbrec")
    assert not frames["applied"][0].any()
    assert not frames["applied"][-1].any()
    assert (frames["applied"][:, 2] >= 0.0).all()
    header = Recording(tmp_path / "s.hdbrec").header
    assert header.law == DistanceField()
    assert header.coupling["stiffness"] == 1000.0
    assert json.loads(json.dumps(plain(report), allow_nan=False))["law"] == "distance"


@pytest.mark.parametrize("law", [TangentPlane(800.0), DistanceField(800.0)])
def test_session_direct_rendering_up_to_caps(
    cells: ResidentCells,
    ball: PointShell,
    distance_floor: Environment,
    tmp_path: Path,
    law: ForceLaw,
) -> None:
    """The tool is at the hand; the device gets each frame's wrench, once the force has risen."""
    coupling = Coupling(cap=1.0, torque_cap=1e-3)
    report = felt(
        cells, ball, pressing(0.004), tmp_path / "d.hdbrec", law=law, rendering="direct",
        coupling=coupling,
    )  # fmt: skip
    assert (report.law, report.rendering) == (law.name, "direct")  # type: ignore[attr-defined]
    assert type(report.coupling) is DirectRendering
    header = Recording(tmp_path / "d.hdbrec").header
    assert (header.law, header.rendering) == (law, "direct")
    frames = recorded(tmp_path / "d.hdbrec")
    assert (frames["tool"] == frames["hand"]).all()
    assert not frames["applied"][0].any()
    late = frames[frames["time"] > 0.1]
    wrenches = felt_at(distance_floor, ball, late, law)
    for part, cap in ((slice(0, 3), 1.0), (slice(3, 6), 1e-3)):  # about the centre, the origin here
        sizes = np.linalg.norm(wrenches[:, part], axis=1, keepdims=True)
        capped = wrenches[:, part] * np.minimum(1.0, cap / np.maximum(sizes, 1e-30))
        np.testing.assert_allclose(late["applied"][:, part], capped, rtol=1e-9, atol=1e-12)
    assert report.peak_force == pytest.approx(1.0)


def test_session_stiffness_lowered_for_device(cells: ResidentCells, ball: PointShell) -> None:
    hand = SimulatedDevice(still(0.03))
    report = felt(cells, ball, hand, seconds=0.1, coupling=Coupling(stiffness=50_000.0))
    assert isinstance(report.coupling, SettledCoupling)
    assert report.coupling.stiffness < 50_000.0
    assert str(report.coupling.lowered).startswith("stiffness 5e+04 N/m lowered to")


def test_session_stiffness_scale_invariant(cells: ResidentCells, ball: PointShell) -> None:
    """The same path at the device presses S times as deep in the scene, with the same force."""
    hand = pressing(0.016)
    hand._knots[:, 1:4] /= 4.0
    report = felt(cells, ball, hand, handle=Handle(scale=4.0))
    assert report.peak_force == pytest.approx(4.0, abs=0.4)


def test_session_starts_inside_object_no_force(cells: ResidentCells, ball: PointShell) -> None:
    report = felt(cells, ball, still(SIZE * (HEIGHT - 32.0)), seconds=0.3)
    assert report.peak_force == 0.0
    assert report.inside_frames == report.loop.frames
    assert (report.first_inside_frame, report.ended_inside) == (0, True)
    assert (report.enclosing_objects, report.objects) == ((1,), ())


def test_session_comes_free_reported_and_recorded(
    cells: ResidentCells, ball: PointShell, tmp_path: Path
) -> None:
    inside = SIZE * (HEIGHT - 32.0)
    low = inside + ONSET + RADIUS - 0.004
    path = Player(
        np.array([0.0, 0.2, 0.4, 1.4, 1.6]),
        [at(0.0, 0.0, z) for z in (inside, 0.03, low, low, 0.03)],
        clock=Steady(),
    )
    hand = Beckoned(path, tmp_path / "come")
    with Session(
        cells, ball, hand, rate=RATE, staleness=NEVER_STALE, record=tmp_path / "s.hdbrec"
    ) as session:
        until(lambda: session.is_loose and session.enclosing_objects == (1,), session)
        hand.path.touch()
        report = session.wait(TIMEOUT)
        assert not session.is_loose
    assert report is not None
    frames = recorded(tmp_path / "s.hdbrec")
    is_loose = frames["state"] & State.IN_OBJECT > 0
    assert report.inside_frames == np.count_nonzero(is_loose) > 0
    assert is_loose[: report.inside_frames].all()
    assert not frames["applied"][is_loose].any()
    assert (report.first_inside_frame, report.ended_inside) == (0, False)
    assert (report.enclosing_objects, report.objects) == ((1,), (1,))
    assert report.peak_force == pytest.approx(4.0, abs=0.4)


def test_session_incompatible_law_and_coupling(
    cells: ResidentCells, ball: PointShell, tmp_path: Path
) -> None:
    with pytest.raises(UsageError, match="does not go with the rendering direct"):
        Session(cells, ball, still(0.03), law="plane", coupling=Coupling(stiffness=100.0))
    with pytest.raises(UsageError, match="the rendering coupled needs the law distance"):
        Session(cells, ball, still(0.03), law="plane", rendering="coupled")
    with pytest.raises(UsageError, match="rendering 'soft': choose one of coupled, direct"):
        Session(cells, ball, still(0.03), rendering="soft")  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="law 'hard': choose one of plane, distance"):
        Session(cells, ball, still(0.03), law="hard")  # type: ignore[arg-type]
    with floored(make(tmp_path, bits=5)) as without:
        with pytest.raises(UsageError, match="has no distances to its surface"):
            Session(without.url, ball, still(0.03), law="distance")
        with pytest.raises(UsageError, match=r"import with distances .* --law plane$"):
            Session(without.url, ball, still(0.03))
        with (
            ResidentCells(without.url, budget_bytes=1 << 20) as plain,
            pytest.raises(UsageError, match="the law distance needs cells with distances"),
        ):
            Session(plain, ball, still(0.03), law=DistanceField())
