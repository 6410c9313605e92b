"""The verb grant."""

from typing import Annotated, Literal

import typer

from hapticdb.cli import render
from hapticdb.cli.options import JsonOption, UrlArgument

RightName = Literal["viewer", "toucher", "editor", "nobody"]
MEANINGS: dict[RightName, str] = {
    "viewer": "may read and touch",
    "toucher": "may read and touch, and keep what 'hapticdb info --calibrate' measures",
    "editor": "may import, move and remove objects",
    "nobody": "has no right here any more",
}


def grant(
    url: UrlArgument,
    role: Annotated[str, typer.Argument(metavar="ROLE", help="A role of the server.")],
    *,
    right: Annotated[
        RightName,
        typer.Option("--as", help="What ROLE may do from now on, instead of what it may do now."),
    ],
    json: JsonOption = False,
) -> None:
    """Say what a role may do with an environment on PostgreSQL; the server holds it to that.

    A viewer reads and touches; a toucher also keeps cost figures; an editor
    also imports, moves and removes objects; nobody has no right. The grid
    and the rights belong to the owner, who made the environment.

    Example: hapticdb grant postgresql://me@host/plant anna --as editor
    """
    from hapticdb.store.connect import grant as grant_right
    from hapticdb.store.connect import redact

    grant_right(url, role, right)
    if json:
        render.say_json({"environment": redact(url), "role": role, "right": right})
    else:
        render.say(f"{redact(url)}: {role} {MEANINGS[right]}")
