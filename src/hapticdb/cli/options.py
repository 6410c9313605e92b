"""Arguments and options of the verbs that more than one verb takes, each declared once."""

from collections.abc import Callable
from typing import Annotated, Any, Literal

import typer

from hapticdb.units import NAMES, length_of

StrategyName = Literal["auto", "statement", "array", "points", "maxgap", "cbgroup"]
CurveName = Literal["z", "hilbert", "lexicographic"]
LayoutName = Literal["brick", "voxel"]
LawName = Literal["plane", "distance"]
RenderingName = Literal["coupled", "direct"]
FramesOn = Literal["cpu", "cuda"]
UnitName = Literal["um", "mm", "cm", "m", "km", "in", "ft", "us-ft", "yd"]

_TOOL = typer.Option(metavar="FILE", help="Mesh of the tool, or a shell saved as .npz.")
_LAYOUT = "Index table of a new environment."
_CURVE = "Order of the keys of a new environment."


def length_option(
    text: str,
    default: str | None = None,
    *,
    unit: str = "mm",
    parse: Callable[[str, str], object] = length_of,
) -> Any:  # noqa: ANN401 - as typer's own
    """Option of a length, or three by `point_of`; metres in the verb, in `unit` if bare.

    default : what the help shows; that of the verb is in metres.
    """

    def metres(given: object) -> object:
        return parse(given, unit) if isinstance(given, str) else given

    metavar, example = ("LENGTH", "0.2in") if parse is length_of else ("X,Y,Z", "0,5,0.2in")
    start = f"{NAMES[unit].capitalize()}, or such as {example}"
    return typer.Option(
        metavar=metavar, help=f"{start}: {text}", show_default=default or True, parser=metres
    )


UrlArgument = Annotated[
    str,
    typer.Argument(
        metavar="URL", help="The environment: a path, sqlite:///path, postgresql://host/database."
    ),
]
LayoutOption = Annotated[LayoutName | None, typer.Option(help=_LAYOUT, show_default="brick")]
CurveOption = Annotated[CurveName | None, typer.Option(help=_CURVE, show_default="z")]
SameLayoutOption = Annotated[
    LayoutName | None, typer.Option(help=_LAYOUT, show_default="that of SRC")
]
SameCurveOption = Annotated[CurveName | None, typer.Option(help=_CURVE, show_default="that of SRC")]

ClusterOption = Annotated[
    str | None,
    typer.Option(
        "--on",
        metavar="ADDRESS",
        help="Have workers of dask.distributed do it: its scheduler, tcp://host:8786.",
    ),
]

_WORDS = "7 or 3,4, 'wheel*', attribute=value"

ObjectsArgument = Annotated[
    list[str],
    typer.Argument(metavar="WORDS...", help=f"As 'hapticdb objects' lists them: {_WORDS}."),
]
WhereOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="WORDS",
        help=f"Only these objects are felt: {_WORDS}. Give it again for more.",
    ),
]
ExcludeOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="WORDS",
        help=f"Objects that are not felt: {_WORDS}. Give it again for more.",
    ),
]

ToolOption = Annotated[str, _TOOL]
OptionalToolOption = Annotated[str | None, _TOOL]
ToolUnitOption = Annotated[
    UnitName | None,
    typer.Option(help="Unit of a tool whose file names no unit; metres unless given."),
]
PathUnitOption = Annotated[
    UnitName | None,
    typer.Option(help="Unit of the positions of the poses.", show_default="m"),
]
PointsOption = Annotated[
    int | None, typer.Option(metavar="N", help="Points of the shell.", show_default="300")
]
SeedOption = Annotated[
    int | None, typer.Option(metavar="N", help="Seed of the points' places.", show_default="0")
]
StiffnessOption = Annotated[float, typer.Option(metavar="N/M", help="Stiffness of the force law.")]
LawOption = Annotated[
    LawName | None,
    typer.Option(
        "--law",
        help="Force law of a frame: the tangent plane of a voxel, or a penalty on the distance to "
        "surfaces; distance unless given where every object has distances.",
    ),
]
ConservativeOption = Annotated[
    bool,
    typer.Option(
        "--conservative",
        help="Leave the tool's points on its surface, so that clearance is kept: with distances "
        "contact begins 1.5 voxels before the surface. Otherwise points are drawn inward by "
        "1.5 voxels, and it begins at the surface.",
    ),
]
BudgetOption = Annotated[float, typer.Option(metavar="MIB", help="Memory for resident cells.")]

CsvOption = Annotated[
    str | None,
    typer.Option(
        "--csv", metavar="FILE", help="Write the result as CSV to a new file; - is standard output."
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON, an object a line.")]
