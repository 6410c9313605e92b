"""Contact proxies, through their bytes, against the coupling on this machine."""

from collections import deque
from contextlib import closing
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from children import until
from feel.couplings import SmoothHand, Terms, posed, straight
from feel.ground import Ground
from feel.scenes import convex_edge, plane, slope_axes
from feel.sliding import SPEED, way_round_edge
from feel.tools import ball
from hapticdb.client.proxy_force import ProxyForce
from hapticdb.hosting.contact_source import ContactSource
from hapticdb.pointshell.shell import PointShell
from hapticdb.protocol.contacts import (
    IS_LOOSE,
    IS_WAITING,
    HandState,
    ProxyState,
    ProxyWish,
    pack_proxy,
    unpack_proxy,
)
from hapticdb.realtime.resident_cells import ResidentCells
from realtime.sessions import in_z_order

Floats = NDArray[np.float64]
SIZE, RADIUS, DEPTH = 0.005, 4.0, 0.8
"""Voxel size, m; radius of the ball and depth of the hand below the onset, voxels."""
CAP = 7.0
"""Greatest force, N, that a server grants where a client asks for none."""
UPRIGHT = np.array([1.0, 0.0, 0.0, 0.0])


class Undamped(SmoothHand):
    """The coupling as the server grants it: its caps, and no damper, which is the client's."""

    def __init__(self, ground: Ground, place: Floats) -> None:
        super().__init__(ground, ball(RADIUS, SIZE, 300), posed(place), Terms())
        self.grant(CAP)


def round_the_edge(folder: Path) -> tuple[str, Floats, Floats]:
    """An environment, a hand's places round its edge and forces there (M, 3), one a millisecond."""
    scene = convex_edge(slope_axes(20.0))
    with Ground.of_scenes(folder, [scene], SIZE, distances=True) as ground:
        way, _ = way_round_edge((1.5 - DEPTH + RADIUS) * SIZE, 0.01)
        first = straight(way[0] + np.array([0.0, 0.0, 0.008]), way[0], SPEED)
        places = ground.origins[scene.name] + np.concatenate([first, way]) @ scene.axes.T
        hand = Undamped(ground, places[0])
        forces = np.array([hand.step(posed(place), np.zeros(6)) for place in places])
    (url,) = folder.glob("*.db")
    return str(url), places, forces


def first_proxy(source: ContactSource, place: Floats) -> ProxyState:
    """Proxy of a hand at rest (3,), as soon as the cells there are in memory."""
    hand = HandState(1, 0.0, place, UPRIGHT, np.zeros(6))
    until(lambda: not source.proxy(hand).flags & IS_WAITING)
    return source.proxy(hand)


def felt(source: ContactSource, places: Floats, delay: int) -> Floats:
    """Forces (M, 3) of proxies that arrive `delay` milliseconds after their hand."""
    force, near = ProxyForce(source.terms), np.zeros_like(places)
    first_proxy(source, places[0])
    rest = 100  # milliseconds at the first place: proxies blend in
    path = np.concatenate([np.repeat(places[:1], rest, axis=0), places])
    coming: deque[tuple[int, bytes]] = deque()
    for n, place in enumerate(path):
        if n % 10 == 0:
            hand = HandState(n + 1, n * 1e-3, place, UPRIGHT, np.zeros(6))
            coming.append((n + delay, pack_proxy(source.proxy(hand))))
        while coming and coming[0][0] <= n:
            assert force.take(unpack_proxy(coming.popleft()[1]), n * 1e-3)
        wrench = force.wrench(np.concatenate([place, UPRIGHT]), np.zeros(6), n * 1e-3)
        near[max(n - rest, 0)] = wrench[:3]
    return near


def test_proxies_go_round_a_convex_edge_as_the_coupling_does(tmp_path: Path) -> None:
    """RMS error as a share of the force; the hand goes 0.5 mm from one proxy to the next.

    The ball rolls over its points, so the force of the coupling itself jumps between them.
    """
    url, places, forces = round_the_edge(tmp_path)
    force = float(np.sqrt((forces**2).sum(axis=1).mean()))
    assert force > 1.0
    with ResidentCells(url, budget_bytes=64 << 20, distances=True) as cells:
        for delay, bound in ((0, 0.08), (10, 0.10), (50, 0.20)):
            with closing(ContactSource(cells, ball(RADIUS, SIZE, 300), ProxyWish())) as source:
                near = felt(source, places, delay)
                assert source.share == 1.0  # sliding is no shaking
            error = float(np.sqrt(((near - forces) ** 2).sum(axis=1).mean()))
            assert error < bound * force


def test_a_tip_in_a_narrow_gap_gets_proxies_that_its_client_reads(tmp_path: Path) -> None:
    """In the middle, nearer than the onset to both sheets, no gradient tells which is nearer."""
    gap = plane("gap", np.eye(3), layers=(-1.45, 1.45))
    with Ground.of_scenes(tmp_path, [gap], SIZE, distances=True) as ground:
        middle = ground.origins["gap"]
    (url,) = tmp_path.glob("*.db")
    tip = PointShell(np.zeros((1, 3)), np.eye(3)[2:], np.zeros(3), is_closed=False)
    with (
        ResidentCells(str(url), budget_bytes=64 << 20, distances=True) as cells,
        closing(ContactSource(cells, tip, ProxyWish())) as source,
    ):
        for height in np.linspace(0.0, 0.1, 10):
            place = middle + np.array([0.0, 0.0, height * SIZE])
            read = unpack_proxy(pack_proxy(first_proxy(source, place)))
    assert not read.flags & IS_LOOSE
    assert read.trust == 0.0
    assert len(read.planes) == 0


def proxies_of(source: ContactSource, places: Floats) -> list[ProxyState]:
    """Proxies at places (M, 3) of a hand, ten milliseconds apart."""
    first_proxy(source, places[0])
    return [
        source.proxy(HandState(n + 2, 0.01 * (n + 1), place, UPRIGHT, np.zeros(6)))
        for n, place in enumerate(places)
    ]


BROAD = in_z_order(128, 64)
"""Places of a flat tool's points, in the order of a curve: twice as many as are merged."""


def test_proxies_of_a_broad_tool_are_merged_and_push_as_the_spring_does(tmp_path: Path) -> None:
    """The tool comes down by 5 mm, 4 mm of them in contact, slides, and leaves."""
    floor = plane("floor", np.eye(3))
    with Ground.of_scenes(tmp_path, [floor], SIZE, distances=True) as ground:
        origin = ground.origins["floor"]
    (url,) = tmp_path.glob("*.db")
    points = np.column_stack([(BROAD - BROAD.mean(axis=0)) * [1e-3, 2e-3], np.zeros(len(BROAD))])
    tool = PointShell(
        points, np.tile((0.0, 0.0, 1.0), (len(BROAD), 1)), np.zeros(3), is_closed=False
    )
    high, low = 1.5 * SIZE + 0.03, 1.5 * SIZE - 0.004
    heights = np.concatenate(
        [np.linspace(high, low, 20), np.full(20, low), np.linspace(low, high, 20)]
    )
    aside = np.concatenate([np.zeros(20), np.linspace(0.0, 0.01, 20), np.full(20, 0.01)])
    places = origin + np.column_stack([aside, np.zeros(60), heights])
    with (
        ResidentCells(str(url), budget_bytes=64 << 20, distances=True) as cells,
        closing(ContactSource(cells, tool, ProxyWish())) as source,
    ):
        merged = proxies_of(source, places[:40])
        assert 1 < source._station.follower["merged"] <= 64
        merged += proxies_of(source, places[40:])
        assert source._station.follower["merged"] == 1
    ours = np.array([proxy.wrench for proxy in merged])
    assert ours[39, 2] == pytest.approx(4.0, rel=0.02, abs=1000.0 * SIZE * 2.75 / 508 + 0.03)
    assert not ours[-1].any()
