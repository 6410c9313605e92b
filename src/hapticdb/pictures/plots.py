"""Plots of results for notebooks: forces along poses, gaps along a path."""

from typing import TYPE_CHECKING

import numpy as np

from hapticdb.batches.result import TouchBatch
from hapticdb.errors import UsageError
from hapticdb.query.touches import Touch
from hapticdb.sweeps.result import Swept

if TYPE_CHECKING:
    from matplotlib.axes import Axes


def plot(result: TouchBatch | Touch | Swept, axes: "Axes | None" = None) -> "Axes":
    """Draw a result with matplotlib; a notebook shows it.

    Of touches, force and torque of each pose; of one touch, how deep each of its contacts is; of a
    sweep, the gap along its path (``profile=True``) and where it hits.

    axes : to draw into; new ones unless given. UsageError for a result that has no plot.
    """
    if not isinstance(result, TouchBatch | Touch | Swept):
        raise UsageError(f"no plot of {type(result).__name__}: give touches or a sweep")
    import matplotlib.pyplot as plt  # noqa: PLC0415 - a second, which only plots need

    if isinstance(result, Swept) and result.profile is None and not result.hits:
        raise UsageError("a sweep without a profile and hits has no plot: sweep(..., profile=True)")
    shown = plt.subplots()[1] if axes is None else axes
    if isinstance(result, TouchBatch):
        shown.plot(np.linalg.norm(result.forces, axis=1), label="force, N")
        shown.plot(np.linalg.norm(result.torques, axis=1), label="torque, N m")
        shown.set_xlabel("pose")
        shown.legend()
    elif isinstance(result, Touch):
        shown.stem(result.contacts, 1e3 * result.contact_depths)
        shown.set(xlabel="point of the shell", ylabel="depth, mm", title=repr(result))
    else:
        if result.profile is not None:
            shown.plot(100 * result.profile.fractions, 1e3 * result.profile.gaps)
        for place in result.hits:
            shown.axvline(100 * place.fraction, color="tab:red")
            shown.annotate(place.object.name, (100 * place.fraction, 0), rotation=90)
        shown.set(xlabel="way, %", ylabel="gap, mm", title=result.verdict)
    return shown
