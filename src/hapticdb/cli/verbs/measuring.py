"""The verb distance."""

from functools import partial
from typing import TYPE_CHECKING

from hapticdb.cli import render
from hapticdb.cli.emit import Output
from hapticdb.cli.selection import as_named
from hapticdb.units import length_text, place_text

if TYPE_CHECKING:
    from hapticdb.batches.exact import Distance


def distance(url: str, a: str, b: str, *, output: Output) -> None:
    """Measure how far two objects are apart.

    The nearest points of their surfaces are printed. If A or B are several objects, the two nearest
    ones are measured. If surfaces meet, 'hapticdb clashes --of A --against B' measures the depth.

    Example: hapticdb distance car.db body/hood body/windscreen
    """
    import hapticdb

    with hapticdb.open(url, read_only=True) as env:
        found = env.distance(*as_named(env, [a], "A"), *as_named(env, [b], "B"))
    output.emit(found, partial(_show, found))


def _show(found: "Distance") -> None:
    length = length_text(found.at_most)
    least = f"meet, or are {length} apart at most" if found.at_most else "meet"
    apart = f"are {length} apart" if found.at_least else least
    render.say(f"{found.a.name} and {found.b.name} {apart}")
    facts = [
        (f"on {obj.name}", f"{place_text(place.tolist(), 1e-6)} m")
        for obj, place in ((found.a, found.on_a), (found.b, found.on_b))
    ]
    if found.at_most - found.at_least > 1e-3 * found.at_most:
        facts.append(("at least", f"{length_text(found.at_least)}, by chord errors"))
    render.facts(facts)
