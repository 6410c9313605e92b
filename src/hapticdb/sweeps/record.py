"""A sweep's result for JSON: metres, fractions of the path, world frame."""

import math
from typing import Any

import numpy as np

from hapticdb.pointshell.shell import PointShell
from hapticdb.store.base import Object
from hapticdb.sweeps.result import ContactDepth, Decision, MetObject, Moment, Swept
from hapticdb.sweeps.verdict import verdict_line


def sweep_record(
    found: Swept, shell: PointShell, parts: list[int], excluded: list[int]
) -> dict[str, Any]:
    """Convert a sweep's result to numbers and strings, as `hapticdb sweep --json` prints it.

    shell : the tool; parts : ids of the objects that it was made of, empty for a tool from a file;
    excluded : ids of the objects that the sweep left out.
    """
    deepest, clearance, proof = found.deepest, found.clearance, found.proof
    return {
        "verdict": found.verdict,
        "comes_out": found.comes_out,
        "line": verdict_line(found, shell),
        "proof": {
            **proof._asdict(),
            "is_clear": proof.is_clear,
            "cover_needed": proof.cover_needed,
        },
        "poses": len(found.path.poses),
        "samples": found.samples,
        "hits": found.hits,
        "contacts": found.contacts,
        "first_hit": _moment(found.first_hit),
        "first_contact": _moment(found.first_contact),
        "deepest": deepest
        and {
            "depth": deepest.depth,
            "point": deepest.point.tolist(),
            "moment": _moment(deepest.moment),
        },
        "objects": [_met_object(one) for one in found.objects],
        "enclosed": [named(obj) for obj in found.enclosed],
        "hit_intervals": found.hit_intervals.tolist(),
        "contact_intervals": found.contact_intervals.tolist(),
        "clearance": clearance
        and {
            "distance": clearance.distance,
            "at_least": clearance.at_least,
            "at_most": None if clearance.is_beyond else clearance.at_most,
            "is_beyond": clearance.is_beyond,
            "point": None if clearance.point is None else clearance.point.tolist(),
            "voxel": None if clearance.voxel is None else clearance.voxel.tolist(),
            "moment": _moment(clearance.moment),
        },
        "tool": {
            "points": len(shell),
            "spacing": median_spacing(shell),
            "parts": parts,
            "excluded": excluded,
        },
        "revision": found.revision,
        "elapsed": found.elapsed,
        "cells": found.cells,
        "proportions": found.proportions.record(),
        "at_least": found.at_least,
        "looked": found.looked,
        "left_at_start": [named(obj) for obj in found.left_at_start],
        "decision": found.decision and _decision(found.decision),
        "depths": [depth_record(one) for one in found.depths],
    }


def depth_record(one: ContactDepth) -> dict[str, object]:
    """Convert bounds of a depth; one that is not known is None, since JSON has no infinity."""

    def known(depth: float) -> float | None:
        return depth if math.isfinite(depth) else None

    return {
        **named(one.object),
        "at_start": one.at_start,
        "at_start_most": known(one.at_start_most),
        "deepest": one.deepest,
        "deepest_most": known(one.deepest_most),
        "fraction": one.fraction,
        "allowed": one.allowed,
        "is_bounded": one.is_bounded,
        "is_cut": one.is_cut,
        "why": one.why,
    }


def _decision(decision: Decision) -> dict[str, object]:
    """Convert a decision; a distance that is not known is None, since JSON has no infinity."""
    within = decision.within if math.isfinite(decision.within) else None
    return {
        **decision._asdict(),
        "within": within,
        "near": _moment(decision.near),
        "is_near": decision.is_near,
    }


def _met_object(one: MetObject) -> dict[str, object]:
    return {
        **named(one.object),
        "first": one.first,
        "last": one.last,
        "intervals": one.intervals.tolist(),
        "first_contact": one.first_contact and one.first_contact.fraction,
        "length": one.length,
        "samples": one.samples,
        "contacts": one.contacts,
        "points": one.points,
        "deepest": one.deepest,
    }


def named(obj: Object) -> dict[str, object]:
    """Convert an object to its id and name."""
    return {"id": obj.id, "name": obj.name}


def _moment(moment: Moment | None) -> dict[str, object] | None:
    return moment and {
        "sample": moment.sample,
        "fraction": moment.fraction,
        "segment": moment.segment,
        "pose": moment.pose.tolist(),
        "objects": [named(obj) for obj in moment.objects],
    }


def median_spacing(shell: PointShell) -> float:
    """Median distance from a point to its nearest neighbour, metres; 0 for a single point.

    Computed from about a thousand of the shell's points, spread evenly by index.
    """
    from scipy.spatial import cKDTree  # noqa: PLC0415 - a third of a second

    if len(shell) < 2:
        return 0.0
    some = shell.points[:: max(1, len(shell) // 1000)]
    distances, _ = cKDTree(shell.points).query(some, k=2)
    return float(np.median(np.asarray(distances)[:, 1]))
