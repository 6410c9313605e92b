"""Groups of pairs: copies of one pair, one part against many others, duplicates at one place.

A group is one finding. Its id depends on shapes and placements, so it is the same in later
searches. Acceptances are those of its pairs.
"""

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from heapq import heapify, heappop, heappush
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hapticdb.clashes.clash_results import Clash, gravity
from hapticdb.exact.shape_cache import relative_poses
from hapticdb.store.base import Object, Store
from hapticdb.units import length_text, volume_text
from hapticdb.verdicts import Kind

STEP = 1e-6
"""Rounding of relative placements, metres, and share of one in a rotation. Coarser: more pairs
count as copies."""
UNEVEN = 0.2718
"""Share of a step by which rounding is off a half, where lengths in inches fall."""
MANY = 3
"""Least number of others in the group of one part."""


class Group(NamedTuple):
    """Pairs of one finding.

    id : the same in later searches; part : name of the one part against many others, or None;
    pairs : open ones first, then the gravest.
    """

    id: str
    kind: Kind
    part: str | None
    pairs: tuple[Clash, ...]

    @property
    def is_open(self) -> bool:
        """Whether a pair is neither accepted nor meant."""
        return any(one.is_open for one in self.pairs)

    @property
    def n_parts(self) -> int:
        """Number of objects."""
        return len({i for one in self.pairs for i in one[:2]})

    def title(self) -> str:
        """Names of the first pair, and the number of others."""
        worst, more = self.pairs[0], len(self.pairs) - 1
        a, b = (name or "(gone)" for name in (worst.a_name, worst.b_name))
        if self.kind == Kind.DUPLICATE and more:
            return f"{a}, {self.n_parts} at one place"
        if self.part is not None:
            partner = b if worst.a_name == self.part else a
            return f"{self.part}, {partner} and {self.n_parts - 2} others"
        return f"{a}, {b}" + (f" and {more} alike" if more else "")

    def length_text(self) -> str:
        """Gap or depth, from the least to the greatest of several, and the sum of the volumes."""
        known = [one.at_least for one in self.pairs if one.at_least or one.kind != Kind.OVERLAPPING]
        if len(self.pairs) == 1 or not known:
            return self.pairs[0].length_text()
        ends = dict.fromkeys(map(length_text, (min(known), max(known))))
        words = " ... ".join(ends) + ("" if len(known) == len(self.pairs) else ", or not known")
        volumes = [one.volume for one in self.pairs if one.volume is not None]
        return words + (f", {volume_text(sum(volumes))} in all" if volumes else "")

    def status(self) -> str:
        """Reason of a closed group; else the numbers of settled pairs, or their statuses."""
        if not self.is_open:
            return self.pairs[0].because or ""
        counts, n_pairs = Counter[str](one.status for one in self.pairs), len(self.pairs)
        settled = {word: counts[word] for word in ("accepted", "meant") if counts[word]}
        return ", ".join(
            word if n == n_pairs else f"{n:,} of {n_pairs:,} {word}"
            for word, n in (settled or counts).items()
        )


def groups_of(store: Store, pairs: Sequence[Clash]) -> list[Group]:
    """Groups of present, measured pairs: open ones first, then the gravest.

    First copies: pairs of equal shapes in equal relative placement, of one kind. Of the rest, the
    object with most others in one kind takes its pairs, down to `MANY`. Each other pair is a group.
    Duplicates at one place are a group. pairs : the gravest first.
    """
    there = [one for one in pairs if one.status != "gone" and not one.is_unmeasured]
    objects = {obj.id: obj for obj in store.objects({i for one in there for i in one[:2]})}
    there = [one for one in there if one.a in objects and one.b in objects]
    alike: dict[str, list[Clash]] = {}
    for one, key in zip(there, _keys(there, objects), strict=True):
        alike.setdefault(key, []).append(one)
    found: dict[str, tuple[str | None, list[Clash]]] = {
        key: (None, members) for key, members in alike.items()
    }
    alone = {
        members[0]: key
        for key, members in alike.items()
        if len(members) == 1 and members[0].kind != Kind.DUPLICATE
    }
    for part, members in _one_against_many([*alone], objects):
        for one in members:
            del found[alone[one]]
        obj = objects[part]
        key = _id(members[0].kind, obj.digest, obj.name)
        found.setdefault(key, (obj.name, []))[1].extend(members)
    groups = [
        Group(key, members[0].kind, part, tuple(sorted(members, key=lambda one: not one.is_open)))
        for key, (part, members) in found.items()
    ]
    return sorted(groups, key=lambda group: (not group.is_open, gravity(group.pairs[0])))


def _one_against_many(
    pairs: Sequence[Clash], objects: Mapping[int, Object]
) -> Iterator[tuple[int, list[Clash]]]:
    """Objects with `MANY` others in one kind, the one with most first, and these pairs.

    Of equally many the one first by its shape and name, whatever the ids.
    """
    shapes = sorted(objects.values(), key=lambda obj: (obj.digest, obj.name, obj.id))
    rank = {obj.id: n for n, obj in enumerate(shapes)}
    partners: dict[tuple[Kind, int], dict[int, Clash]] = {}
    for one in pairs:
        partners.setdefault((one.kind, one.a), {})[one.b] = one
        partners.setdefault((one.kind, one.b), {})[one.a] = one
    most = [(-len(others), rank[key[1]], key) for key, others in partners.items()]
    heapify(most)
    while most:
        n, rank_of, key = heappop(most)
        others = partners[key]
        if len(others) < MANY:
            continue
        if len(others) < -n:  # others have taken pairs since
            heappush(most, (-len(others), rank_of, key))
            continue
        for other in others:
            del partners[key[0], other][key[1]]
        yield key[1], list(others.values())


def _keys(pairs: Sequence[Clash], objects: Mapping[int, Object]) -> Iterator[str]:
    """Ids of pairs, equal for copies, and for duplicates at one place."""
    placed = {i: _parted(obj.transform) for i, obj in objects.items()}
    shapes = {
        i: f"{objects[i].digest} {_rounded(linear).tobytes().hex()}"
        for i, (linear, _) in placed.items()
    }
    ends = zip(*((one.a, one.b) for one in pairs), strict=True) if pairs else ((), ())
    poses = [np.array([placed[i][1] for i in end]).reshape(-1, 4, 4) for end in ends]
    there, back = (_rounded(relative_poses(*way)) for way in (poses, poses[::-1]))
    first: dict[int, int] = {}  # duplicates, by the least id of their place
    for n, one in enumerate(pairs):
        if one.kind == Kind.DUPLICATE:
            at = first.setdefault(one.b, first.get(one.a, one.a))
            yield _id(one.kind, shapes[at], _rounded(placed[at][1]).tobytes().hex())
            continue
        a, b = shapes[one.a], shapes[one.b]
        ways = (a, b, there[n].tobytes().hex()), (b, a, back[n].tobytes().hex())
        yield _id(one.kind, *min(ways))


def _parted(transform: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Stretch (3, 3) and rigid placement (4, 4): a turn of the world leaves the stretch."""
    left, sizes, right = np.linalg.svd(transform[:3, :3])
    sign, pose = np.sign(np.linalg.det(left @ right)), np.eye(4)
    pose[:3, :3], pose[:3, 3] = sign * (left @ right), transform[:3, 3]
    return sign * (right.T * sizes) @ right, pose


def _rounded(values: NDArray[np.float64]) -> NDArray[np.int64]:
    return np.floor(values / STEP + UNEVEN).astype("<i8")


def _id(*parts: str) -> str:
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:10]
