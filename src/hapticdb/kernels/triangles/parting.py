"""Pieces into which a surface is parted by another one, and how far each gets from it.

A surface is points, and edges between them. Places on some of its edges are where it goes through
the other surface; `sweeps.cut` says what a depth is.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels._jit import (
    BOOLS,
    FLOAT,
    FLOATS,
    FLOATS2,
    INTS,
    INTS2,
    entry,
    fields_of,
    leaf,
)
from hapticdb.kernels.rigid import moved, transform_of
from hapticdb.kernels.surfaces.nearest import distance_at
from hapticdb.kernels.surfaces.sides import STACK, TREE, TriangleTree
from hapticdb.kernels.triangles.nearest import largest
from hapticdb.kernels.triangles.piercing import ASIDE

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Flags = NDArray[np.bool_]

SAMPLES = 4
"""Steps in which a part of an edge is measured. More: deeper cuts of curved surfaces."""
FEW = 16
"""One of so many points is measured first: mostly one of them is far enough, and ends its piece."""
SPOTS = 3
"""Places that each place in a triangle is paired with, to find a spot between them. More: deeper
cuts of curved surfaces."""


@leaf
def _root(parents, node):
    """Root of a node; the path to it is halved."""
    while parents[node] != node:
        parents[node] = parents[parents[node]]
        node = parents[node]
    return node


@leaf
def _join(parents, one, other):
    """Make two nodes one component, whose root is its least node."""
    one, other = _root(parents, one), _root(parents, other)
    if one < other:
        parents[other] = one
    elif other < one:
        parents[one] = other


@entry(INTS2, INTS)
def components_kernel(links, parents):
    """Find the least node, parents (V,), of the component of each node that links (N, 2) connect.

    parents begins as 0 .. V - 1.
    """
    for n in range(links.shape[0]):
        _join(parents, links[n, 0], links[n, 1])
    for node in range(parents.shape[0]):
        parents[node] = _root(parents, node)


class Parted(NamedTuple):
    """A surface, its places on another one, and how far from that it is measured.

    points (V, 3), edges (E, 2): the surface; order (V,): of points, near ones one after another;
    cuts (P,), shares (P,): edge of each place and share of the edge, ascending by both; asked (P,):
    where it is asked, the same for all places of an edge; pose (4, 4) leads into the frame of the
    other one's tree; floor, most: distances between which it is measured; waiting, squares
    (STACK,): scratch.
    """

    points: Floats
    order: Ints
    edges: Ints
    cuts: Ints
    shares: Floats
    asked: Flags
    tree: TriangleTree
    pose: Floats
    floor: float
    most: float
    waiting: Ints
    squares: Floats


PARTED = fields_of(
    Parted, FLOATS2, INTS, INTS2, INTS, FLOATS, BOOLS, TREE, FLOATS2, FLOAT, FLOAT, INTS, FLOATS
)


@leaf
def _far(parted, x, y, z, enough, hint):
    """Distance of a place from the other surface, and of which triangle.

    Up to `most`; where it is `enough` or less, it is that of some triangle. hint : number of a
    triangle that may be near, or -1.
    """
    x, y, z = moved(transform_of(parted.pose), x, y, z)
    return distance_at(
        parted.tree, x, y, z, enough, parted.most, hint, parted.waiting, parted.squares
    )


@leaf
def _part_far(parted, edge, begin, end, known, slack):
    """Greatest distance on a part of an edge, from share to share; `known` if none is greater.

    Where the edge goes through the other surface, the distance is `slack` at most, so no place is
    farther than from there.
    """
    points, a, b = parted.points, parted.edges[edge, 0], parted.edges[edge, 1]
    ux, uy = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1]
    uz = points[b, 2] - points[a, 2]
    length = math.sqrt(ux * ux + uy * uy + uz * uz)
    found, hint = known, np.int64(-1)
    for k in range(0 if begin == 0.0 else 1, SAMPLES + 1 if end == 1.0 else SAMPLES):
        share = begin + (end - begin) * k / SAMPLES
        away = math.inf
        if begin > 0.0:
            away = share - begin
        if end < 1.0:
            away = min(away, end - share)
        if away * length + slack <= found:
            continue
        x, y = points[a, 0] + share * ux, points[a, 1] + share * uy
        far, near = _far(parted, x, y, points[a, 2] + share * uz, found, hint)
        found = max(found, far)
        hint = near if near >= 0 else hint
    return found


@leaf
def _measure_parts(parted, slack, pieces, parts, far, piece_far):
    """Measure the parts of edges between places, and note the piece of each, parts (2 P,).

    Where both parts of an edge are of one piece, they count by themselves, far (2 P,). Else a part
    is passed over if its piece is known to get far enough.
    """
    edges, cuts, shares = parted.edges, parted.cuts, parted.shares
    n_points, n_places, n_parts = parted.points.shape[0], cuts.shape[0], 0
    for p in range(n_places):
        edge = cuts[p]
        one, other = pieces[edges[edge, 0]], pieces[edges[edge, 1]]
        is_first = p == 0 or cuts[p - 1] != edge
        is_last = p + 1 == n_places or cuts[p + 1] != edge
        is_one = one == other and is_first and is_last
        for k in range(0 if is_first else 1, 2):
            if k == 0:
                begin, end, part = 0.0, shares[p], one
            elif is_last:
                begin, end, part = shares[p], 1.0, other
            else:
                begin, end, part = shares[p], shares[p + 1], n_points + n_parts
            parts[n_parts] = part
            far[n_parts] = parted.floor if is_one else max(piece_far[part], parted.floor)
            if parted.asked[p] and far[n_parts] < parted.most:
                far[n_parts] = _part_far(parted, edge, begin, end, far[n_parts], slack)
            piece_far[part] = max(piece_far[part], far[n_parts])
            n_parts += 1
    return n_parts


@leaf
def _measure_pieces(parted, pieces, piece_far):
    """Measure the points of pieces whose piece_far is 0 or more, until each gets far enough.

    Neighbours in `order` are mostly near the same triangle, so that is asked first.
    """
    points, order = parted.points, parted.order
    n_points, hint = points.shape[0], np.int64(-1)
    for n in range(n_points + n_points // FEW):  # a few points spread over all come first
        v = order[n * FEW if n < n_points // FEW else n - n_points // FEW]
        known = piece_far[pieces[v]]
        if 0.0 <= known < parted.most:
            found, near = _far(parted, points[v, 0], points[v, 1], points[v, 2], known, hint)
            piece_far[pieces[v]] = max(known, found)
            hint = near if near >= 0 else hint


@leaf
def _through(parts, far, piece_far, at, k, n_parts):
    """How far the surface gets through at the place after part at + k of an edge of n_parts."""
    before, after = parts[at + k], parts[at + k + 1]
    beside = min(piece_far[before], piece_far[after])
    if before == after:
        beside = min(far[at + k], far[at + k + 1])
    left, right = before, after  # the farthest pieces on both sides
    for n in range(at + k - 1, at - 1, -1):
        if piece_far[parts[n]] >= piece_far[left]:
            left = parts[n]
    for n in range(at + k + 2, at + n_parts):
        if piece_far[parts[n]] >= piece_far[right]:
            right = parts[n]
    if left == right:
        return beside
    return max(beside, min(piece_far[left], piece_far[right]))


@entry(PARTED, INTS, FLOATS)
def depths_kernel(parted, parents, out):
    """Find how far out (P,) a surface gets through another one at each place, `floor` to `most`.

    parents (V,) begins as 0 .. V - 1; afterwards the piece of each point.
    """
    edges, cuts, asked = parted.edges, parted.cuts, parted.asked
    n_points, n_places = parted.points.shape[0], cuts.shape[0]
    p = 0
    for e in range(edges.shape[0]):
        while p < n_places and cuts[p] < e:
            p += 1
        if p == n_places or cuts[p] != e:
            _join(parents, edges[e, 0], edges[e, 1])
    for v in range(n_points):
        parents[v] = _root(parents, v)
    parts, far = np.empty(2 * n_places, dtype=np.int64), np.empty(2 * n_places)
    piece_far = np.full(n_points + 2 * n_places, -1.0)
    for p in range(n_places):
        if asked[p]:
            piece_far[parents[edges[cuts[p], 0]]] = parted.floor
            piece_far[parents[edges[cuts[p], 1]]] = parted.floor
    slack = ASIDE * largest(parted.tree.boxes)
    _measure_pieces(parted, parents, piece_far)
    _measure_parts(parted, slack, parents, parts, far, piece_far)
    first, at = 0, 0
    while first < n_places:
        last = first
        while last + 1 < n_places and cuts[last + 1] == cuts[first]:
            last += 1
        for k in range(last - first + 1):
            out[first + k] = _through(parts, far, piece_far, at, k, last - first + 2)
        at += last - first + 2
        first = last + 1


def depths_of(
    points: Floats, order: Ints, edges: Ints, cuts: Ints, shares: Floats, asked: Flags,
    tree: TriangleTree, pose: Floats, floor: float, most: float,
) -> Floats:  # fmt: skip
    """How far (P,) a surface gets through at each place, as `Parted` and `depths_kernel` say."""
    out, contiguous = np.empty(len(cuts)), np.ascontiguousarray
    parted = Parted(
        contiguous(points), order, contiguous(edges), cuts, shares, asked, tree, contiguous(pose),
        float(floor), float(most), np.empty(STACK, dtype=np.int64), np.empty(STACK),
    )  # fmt: skip
    depths_kernel(parted, np.arange(len(points)), out)
    return out


@leaf
def _step(count, k):
    """How many places after another one its k-th partner is, of `count`."""
    return (k + 1) * count // (SPOTS + 1)


@leaf
def _was_tried(n, m, count, k):
    """Whether places n and m of a group have been a pair before: m is the k-th partner of n."""
    if _step(count, k) == _step(count, k - 1) and k > 0:
        return True
    for other in range(SPOTS):
        if m < n and (m + _step(count, other)) % count == n:
            return True
    return False


@entry(TREE, FLOATS2, INTS, FLOAT, FLOATS2)
def spots_kernel(tree, places, starts, slack, spots):
    """Find the spot (G, 3) of each group of places that is farthest from a surface.

    places (N, 3), on the surface but for `slack` metres: group g is starts[g] .. starts[g + 1] - 1
    of them, at least one. Spots are tried in the middle between a place and `SPOTS` others, so none
    is farther from the surface than from these.
    """
    waiting, squares = np.empty(STACK, dtype=np.int64), np.empty(STACK)
    hint, spot = np.int64(-1), np.empty(3)
    for g in range(spots.shape[0]):
        first, count, known = starts[g], starts[g + 1] - starts[g], -1.0
        for n in range(count):
            for k in range(SPOTS):
                m = (n + _step(count, k)) % count
                if _was_tried(n, m, count, k):
                    continue
                square = 0.0
                for axis in range(3):
                    a, b = places[first + n, axis], places[first + m, axis]
                    spot[axis] = 0.5 * (a + b)
                    square += (a - b) ** 2
                if count == 1:
                    found = 0.0  # there is no other one
                elif 0.5 * math.sqrt(square) + slack <= known:
                    continue
                else:
                    found, near = distance_at(
                        tree, spot[0], spot[1], spot[2], max(known, 0.0), math.inf, hint, waiting,
                        squares,
                    )  # fmt: skip
                    hint = near if near >= 0 else hint
                if found > known:
                    known = found
                    for axis in range(3):
                        spots[g, axis] = spot[axis]


def components(links: Ints, count: int) -> Ints:
    """Component (count,) of each node that links (N, 2) connect, named by its least node."""
    parents = np.arange(count)
    components_kernel(np.ascontiguousarray(links), parents)
    return parents


def spots_of(tree: TriangleTree, places: Floats, starts: Ints, slack: float) -> Floats:
    """Spots (G, 3) between places (N, 3) of each group, as `spots_kernel` says."""
    spots = np.empty((len(starts) - 1, 3))
    spots_kernel(tree, np.ascontiguousarray(places), starts, slack, spots)
    return spots
