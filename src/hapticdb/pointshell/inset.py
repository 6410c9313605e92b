"""Points drawn inward from a tool's surface, for the distance law.

Under the distance law contact begins a fixed distance before the surface; points drawn inward by
this distance make it begin at the surface. The points are images of samples, moved along their
inward normals. An image is valid if no part of the surface is nearer to it than its own sample. So
points vanish along convex edges, and these touch late by d (1 / sin(a / 2) - 1) for an inset d and
an edge of angle a. Walls thinner than two insets, and wedges below 60 degrees, keep all their
points at the greatest possible inset, half the thickness. So do details that would touch late by
more than one inset.
"""

import numpy as np
from numpy.typing import NDArray

from hapticdb.kernels.surfaces import blue_noise
from hapticdb.pointshell.coverage import spacing_of
from hapticdb.pointshell.inscribed import SLACK, InscribedBalls
from hapticdb.pointshell.orientation import Surface

SAMPLES = 5
"""Initial samples for each requested point."""
ENOUGH = 3
"""Images for each requested point below which more samples are drawn. Larger: more even, slower."""
MOST_SAMPLES = 10
"""Most samples for each requested point. Larger: slower for tools with few valid images."""
SHARP = -0.5
"""Cosine between the inward normals of two faces below which they form a thin wall or a sharp
wedge, of less than 60 degrees. A larger value keeps points of wider wedges, which touch early."""
LATEST = 2.0
"""Distance from a sample to the nearest image, in insets, above which the sample's own image stays:
no position touches late by more than one inset. Larger: more corners without points."""

Floats = NDArray[np.float64]


def sample_inset(
    surface: Surface, n_points: int, inset: float, rng: np.random.Generator
) -> tuple[Floats, NDArray[np.int32], Floats]:
    """Points spread evenly over the surface and drawn inward by `inset` metres; see the module.

    Points of open surfaces without matter behind them stay on the surface. Returns points (N, 3),
    faces (N,) of their samples, and distances (N,), metres, to these.
    """
    balls = InscribedBalls(surface, inset)
    per_point = SAMPLES
    while True:
        samples, faces = blue_noise.sample_surface(
            surface.triangles, surface.areas, surface.normals, per_point * n_points, rng
        )
        radius, facing = balls.touching(samples, faces, inset)
        images = samples + radius[:, None] * surface.normals[faces]
        is_kept = (radius >= (1.0 - SLACK) * inset) | (facing < SHARP) | (radius == 0.0)
        if not is_kept.any():
            is_kept = radius >= (1.0 - SLACK) * radius.max()
        spacing = spacing_of(float(surface.areas.sum()), len(samples))
        is_kept |= _is_late(samples, images[is_kept], LATEST * inset + 2.0 * spacing)
        n_kept = int(is_kept.sum())
        if n_kept >= ENOUGH * n_points or per_point >= MOST_SAMPLES:
            break
        per_point = min(MOST_SAMPLES, 1 + per_point * ENOUGH * n_points // n_kept)
    if n_kept < n_points:  # fill up with the deepest of the others
        others = np.flatnonzero(~is_kept)
        deepest = np.argsort(-radius[others], kind="stable")
        is_kept[others[deepest[: n_points - n_kept]]] = True
    kept = np.flatnonzero(is_kept)
    share = len(kept) / len(samples)
    chosen = kept[_spread(samples[kept], images[kept], faces[kept], surface, n_points, share)]
    return images[chosen], faces[chosen], radius[chosen]


def _is_late(samples: Floats, images: Floats, latest: float) -> NDArray[np.bool_]:
    """Whether each sample (Q, 3) has no image within `latest` metres."""
    from scipy.spatial import cKDTree  # noqa: PLC0415 - a third of a second, for insets alone

    distance, _ = cKDTree(images).query(samples, distance_upper_bound=latest, workers=-1)
    return np.asarray(~np.isfinite(distance))


def _spread(
    samples: Floats,
    images: Floats,
    faces: NDArray[np.int32],
    surface: Surface,
    n_points: int,
    share: float,
) -> NDArray[np.intp]:
    """Choose `n_points` images (M, 3), as far apart as sample elimination makes them.

    share : number of the images, as a share of all samples; an estimate of their area. Images of a
    small ball or rod coincide, so each is moved back slightly towards its sample.
    """
    places = images + 1e-3 * (samples - images)
    spacing = spacing_of(share * float(surface.areas.sum()), n_points)
    return blue_noise.spread_points(places, faces, surface.normals, n_points, spacing)
