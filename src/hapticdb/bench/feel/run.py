"""All measures of both laws, one after another."""

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hapticdb.bench import records
from hapticdb.bench.feel import passing, sliding, stability, touching
from hapticdb.bench.feel.couplings import SIDES, Side
from hapticdb.bench.feel.ground import Ground
from hapticdb.bench.feel.page import write_feel_page
from hapticdb.bench.feel.person import DEVICE_DAMPING, DEVICE_KG, FIRM, LIGHT
from hapticdb.bench.feel.plots import draw_feel, draw_walk
from hapticdb.bench.feel.scenes import N_RANDOM, plate, slope_axes
from hapticdb.bench.feel.walking import PLACES, walk_over
from hapticdb.errors import UsageError
from hapticdb.grid import GridOptions
from hapticdb.ingest.files import ImportOptions, import_files
from hapticdb.sample import write_sample
from hapticdb.warm import warm_up

NAME = "feel"
"""Name of the result, of its page and of the folder of its plots."""
Say = Callable[[str], None]
"""Called with a line that says what is measured next."""
Found = dict[str, dict[str, Any]]
"""Cells of one law by their measure, without measure and law."""


@dataclass(frozen=True)
class Effort:
    """How much is measured. Larger numbers find the worst case more surely and take longer.

    n_random : planes turned at random; n_throws : throws at sheets, and at plates, for each voxel
    size; tries : halvings of the range of stiffness; rates, delays : of the stiffest wall, Hz and
    s; periods : that are timed; places : of the walk; n_astride : starts astride a sheet;
    clearances : of pegs, voxels.
    """

    n_random: int = N_RANDOM
    n_throws: int = 500
    tries: int = stability.TRIES
    rates: Sequence[float] = stability.RATES
    delays: Sequence[float] = stability.DELAYS
    periods: int = 20_000
    places: int = PLACES
    n_astride: int = passing.N_ASTRIDE
    clearances: Sequence[float] = passing.CLEARANCES


QUICK_EFFORT = Effort(2, 10, 5, (1000.0,), (0.0, 0.002), 2000, 200, 4, (0.0, 0.2, 1.1, 1.8))
"""A first look, a minute."""


def feel(
    folder: Path,
    *,
    url: str | None = None,
    quick: bool = False,
    sides: Sequence[Side] = SIDES,
    say: Say = lambda _: None,
) -> tuple[Path, dict[str, Any]]:
    """Measure how good the forces of both laws feel; write JSON, plots and one page.

    Parameters
    ----------
    folder : Path
        For `feel.json`, `feel.md` and the plots; made where it is missing.
    url : str, optional
        Environment of the walk; the sample car unless given. It is only read.
    quick : bool
        Fewer cases, a minute: for a first look.
    say : callable, optional
        Called with a line that says what is measured next.

    Returns
    -------
    page, result : Path and dict
        The page's file, and the result as its file holds it.
    """
    effort = QUICK_EFFORT if quick else Effort()
    warm_up()
    records.make_folder(folder)
    cells: list[dict[str, Any]] = []
    curves: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="hapticdb-feel-") as temporary:
        place = Path(temporary)
        sides = [side for side in sides if can_measure(side, place, say)]
        for side in sides:
            found, drawn = measured(side, place, effort, say)
            cells += [{"measure": key, "law": side.law} | cell for key, cell in found.items()]
            curves += [curve | {"law": side.law} for curve in drawn]
        say("computing time")
        times = sliding.time_of_periods(sides, place, effort.periods)
        cells += [{"measure": "period", "law": law} | cell for law, cell in times.items()]
        say("a walk over a model")
        walk = walk_over(tuple(sides), url or sample_car(place), effort.places)
        cells += [{"measure": "walk", "law": law} | cell for law, cell in walk["cells"].items()]
        curves += walk["curves"]
        say("plots and page")
        plots = folder / NAME
        draw_walk(walk["walk"], url or place / "car.db", plots)
    result = records.result(NAME, cells, inputs=inputs_of(url, effort)) | {"curves": curves}
    records.write(folder, {NAME: result})
    draw_feel(result, plots)
    page = folder / f"{NAME}.md"
    write_feel_page(result, page, NAME)
    return page, result


def can_measure(side: Side, place: Path, say: Say) -> bool:
    """Whether imported scenes have the distances that a law needs; says so where they have none."""
    scene = plate("plate", 1.0, slope_axes(20.0), 4.0)
    try:
        Ground.of_scenes(place, [scene], sliding.SIZE, distances=side.distances).close()
    except UsageError as error:
        say(f"{side.law}: left out: {error}")
        return False
    return True


def measured(
    side: Side, place: Path, effort: Effort, say: Say
) -> tuple[Found, list[dict[str, Any]]]:
    """All measures of one law but those that compare laws in one go; curves for plots."""
    found: Found = {}
    curves: list[dict[str, Any]] = []

    def curve(name: str, drawn: Sequence[dict[str, Any]]) -> None:
        curves.extend({"curve": name} | each for each in drawn)

    say(f"{side.law}: touch on planes")
    slides = touching.slides_of_touch(side, place, effort.n_random)
    curve("slide", [slides.pop("curve")])
    found |= slides
    curve("depth", touching.depth_curves(side, place))
    say(f"{side.law}: touch on shapes")
    found |= touching.shapes_of_touch(side, place)
    say(f"{side.law}: sessions on planes")
    found["session_ripple"] = sliding.ripple_of_sessions(side, place, effort.n_random)
    found["session_force"], drawn = sliding.force_of_sessions(side, place)
    curve("press", drawn)
    found["session_enter"] = sliding.step_on_entering(side, place, effort.n_random)
    say(f"{side.law}: sessions round an edge, at scales, lifted, pressed")
    edges, drawn = sliding.edge_of_sessions(side, place)
    found |= edges
    curve("edge", drawn)
    found["session_scale"] = sliding.scales_of_sessions(side, place)
    found["session_lift"], found["session_energy"] = sliding.lift_and_press(side, place)
    say(f"{side.law}: taps and stiff walls")
    found["tap"], tapped = stability.tap(side, place)
    curve("tap", [tapped])
    found["z_width"] = stability.z_width(side, place, effort.rates, effort.delays, effort.tries)
    say(f"{side.law}: sheets, plates, pegs")
    found["sheets"] = passing.sheets_of_sessions(side, place, effort.n_throws)
    found["astride"] = passing.starts_astride(side, place, effort.n_astride)
    found["peg"] = passing.clearances_of_pegs(side, place, effort.clearances)
    return found, curves


def sample_car(place: Path) -> Path:
    """The sample car imported into an environment in that folder."""
    url = place / "car.db"
    (place / "sample").mkdir()
    car = write_sample(place / "sample").car
    (report,) = import_files(url, [car], ImportOptions(grid=GridOptions(bits=11)))
    if report.error is not None:
        raise report.error
    return url


def inputs_of(url: str | None, effort: Effort) -> dict[str, Any]:
    """What was measured on, in words."""
    grips = "; ".join(
        f"{grip.name}: {grip.stiffness:g} N/m, {grip.damping:.3g} N s/m" for grip in (LIGHT, FIRM)
    )
    return {
        "scenes": "closed forms as triangles, imported, their cells in memory",
        "person": f"{DEVICE_KG:g} kg and {DEVICE_DAMPING:g} N s/m of the device; {grips}",
        "planes": f"0, 5, 20 and 45 degrees, {effort.n_random} turned at random",
        "throws": f"{effort.n_throws} at sheets and as many at plates, for each voxel size",
        "walk": "an environment of one's own" if url else "the sample car, 11 bits",
    }
