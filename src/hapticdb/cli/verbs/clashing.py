"""The verb clashes."""

from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hapticdb.cli import render
from hapticdb.cli.csv_files import STDOUT, new_file, open_csv, text_cell
from hapticdb.cli.options import CsvOption, JsonOption, UrlArgument
from hapticdb.cli.verbs.sweeping import MM
from hapticdb.errors import ReadOnlyError, UsageError
from hapticdb.units import length_text

if TYPE_CHECKING:
    from hapticdb.clashes.result import Clash, Clashes
    from hapticdb.environment import Environment
    from hapticdb.store.pairs import Kind

MOST_ROWS = 20
"""Rows of the table; further pairs are counted below it."""
NOT_DECIDED = 3
"""Exit code where nothing was found, but not all pairs were looked at."""
COLUMNS = (
    "a_id", "a_name", "b_id", "b_name", "kind", "at_least_m", "at_most_m", "a_x_m", "a_y_m",
    "a_z_m", "b_x_m", "b_y_m", "b_z_m", "status", "because",
)  # fmt: skip
"""Columns of `clashes --csv`: a row for each pair, the gravest first."""

WithinOption = Annotated[
    float, typer.Option(metavar="MM", help="Millimetres: pairs that are so near are told.")
]
ContactOption = Annotated[
    float,
    typer.Option(
        metavar="MM", help="Millimetres: surfaces so near, or so little one in the other, touch."
    ),
]
OfOption = Annotated[
    list[str] | None,
    typer.Option(metavar="WORDS", help="One of each pair; chosen as for 'hapticdb objects'."),
]
AgainstOption = Annotated[
    list[str] | None, typer.Option(metavar="WORDS", help="The other one of each pair, likewise.")
]
KindOption = Annotated[
    list[str] | None,
    typer.Option(
        "--kind",
        metavar="KIND",
        help="Kinds that are told, and that exit code 1 stands for. Give it again for more.",
        show_default="all are told, overlapping gives exit code 1",
    ),
]
SecondsOption = Annotated[
    float | None,
    typer.Option(metavar="S", help="Time of the search; the next call goes on.",
                 show_default="no limit"),
]  # fmt: skip
BudgetOption = Annotated[float, typer.Option(metavar="MIB", help="Memory for shapes.")]
AcceptOption = Annotated[
    tuple[str, str] | None,
    typer.Option(
        "--accept", metavar="A B", help="Accept the known pairs of these objects, with --because."
    ),
]
BecauseOption = Annotated[
    str | None, typer.Option(metavar="TEXT", help="Why --accept accepts; '' takes it back.")
]
HtmlOption = Annotated[
    str | None,
    typer.Option(
        metavar="FILE", help="Write a page with pictures, a matrix and the table to a new file."
    ),
]

HELP = """Say which parts meet, how deep, and which are near: every pair of an assembly.

Apart: farther than --contact. Touching: within --contact, or freed by a motion of
so much. Overlapping: deeper. Inside: one lies in a closed body of the other. Not
known: point clouds, which have no surface. The triangles decide.

The database keeps what is found. The next call measures only pairs of objects
that were added, moved or replaced since, and says what is new, changed, gone or the
same. --accept marks pairs as intended, until either part changes its shape.

Ctrl-C and --seconds lose nothing: the next call goes on. What was not looked
at is told as that.

The exit code is 1 when a pair of a --kind was found that nobody has accepted, 3 when
there is none but not all pairs were looked at, and else 0.

Example: hapticdb clashes car.db --of 'wheel*' --within 2
"""
"""The verb's help text: longer than a function of this house may be."""


def clashes(
    url: UrlArgument,
    *,
    within: WithinOption = 1.0,
    contact: ContactOption = 0.05,
    of: OfOption = None,
    against: AgainstOption = None,
    kind: KindOption = None,
    seconds: SecondsOption = None,
    budget: BudgetOption = 256.0,
    accept: AcceptOption = None,
    because: BecauseOption = None,
    csv: CsvOption = None,
    html: HtmlOption = None,
    json: JsonOption = False,
) -> None:
    """Find every pair of objects that are near; the help text is `HELP`."""
    if csv == STDOUT and json:
        raise UsageError("--csv - and --json: only one may be standard output")
    if (accept is None) != (because is None):
        raise UsageError("--accept A B and --because TEXT: give both, or neither")
    if accept is not None:
        _accept(url, accept, because or None, json=json)
        return
    render.compile_kernels("clashes")
    from hapticdb.clashes.run import find_clashes

    kinds = _checked(kind)
    with (
        open_csv(csv, "--csv", COLUMNS) as table,
        nullcontext() if html is None else new_file(Path(html), "--html") as page,
        _opened(url) as env,
        render.bar("measuring", "pairs", lambda *now: now) as progress,
    ):
        found = find_clashes(
                env, within=MM * within, contact=MM * contact, of=of or (), against=against or (),
                seconds=seconds, budget=int(budget * 2**20), progress=progress,
            )  # fmt: skip
        told = [one for one in found.pairs if not kinds or one.kind in kinds or one.is_left]
        if table:
            table.write(map(_row, told))
        if page is not None:
            from hapticdb.pictures.clashes import clashes_page

            page.write_text(clashes_page(env, found, told), encoding="utf-8")
    if json:
        for one in told:
            render.say_json(one.record())
    elif csv != STDOUT:
        _show(found, told)
    if not found.is_kept:
        render.note(f"{url} can only be read by this user: what was found is not kept")
    is_found = any(not one.is_left for one in (found.of(kinds) if kinds else found.of()))
    raise typer.Exit(1 if is_found else NOT_DECIDED if found.left else 0)


def _checked(names: list[str] | None) -> "tuple[Kind, ...]":
    """Kinds of the names given; UsageError."""
    from hapticdb.clashes.result import GRAVITY

    for name in names or ():
        if name not in GRAVITY:
            raise UsageError(f"--kind {name!r}: give one of {', '.join(sorted(GRAVITY))}")
    return tuple(kind for kind in GRAVITY if kind in (names or ()))


def _opened(url: str) -> "Environment":
    """Open to write, so that what is found is kept; to read where this user may do no more."""
    import hapticdb

    try:
        return hapticdb.open(url)
    except ReadOnlyError:
        return hapticdb.open(url, read_only=True)


def _accept(url: str, pair: tuple[str, str], because: str | None, *, json: bool) -> None:
    import hapticdb
    from hapticdb.clashes.run import accept_clash

    with hapticdb.open(url) as env:
        rows = accept_clash(env, [pair[0]], [pair[1]], because)
    if json:
        for row in rows:
            render.say_json({"a": row.a, "b": row.b, "because": because})
        return
    what = "no longer accepted" if because is None else "accepted until a part changes its shape"
    render.say(f"{render.counted(len(rows), 'pair')} {what}")


def _row(one: "Clash") -> list[object]:
    place = ("",) * 6 if one.place is None else one.place
    at_most = "" if one.at_most is None else one.at_most
    return [
        one.a, text_cell(one.a_name or ""), one.b, text_cell(one.b_name or ""), one.kind,
        one.at_least, at_most, *place, one.status, text_cell(one.because or ""),
    ]  # fmt: skip


def _show(found: "Clashes", told: "list[Clash]") -> None:
    """Print the gravest pairs, and how many there are of each kind and status."""
    rows = [
        (str(one.a), one.a_name or "(gone)", str(one.b), one.b_name or "(gone)", one.kind,
         one.length_text(), one.because or one.status)
        for one in told[:MOST_ROWS]
    ]  # fmt: skip
    if rows:
        render.table(("id>", "object", "id>", "and", "are", "by>", "status"), rows)
    if len(told) > MOST_ROWS:
        render.say(f"{len(told):,} pairs, {MOST_ROWS} of them shown; --csv writes all")
    counts = ", ".join(f"{n:,} {kind}" for kind, n in found.counts().items() if n)
    statuses = ", ".join(f"{n:,} {status}" for status, n in sorted(found.statuses().items()))
    facts = [(f"within {length_text(found.within)}", counts or "no pair")]
    if statuses:
        facts.append(("since the last call", statuses))
    facts.append(("measured", f"{found.measured:,} pairs, {found.kept:,} known before"))
    if found.left:
        facts.append(("not looked at", f"{found.left:,} pairs: call again to go on"))
    facts.append(("took", f"{found.elapsed:.2f} s"))
    render.facts(facts)
