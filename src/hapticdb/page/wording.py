"""Texts of the page: rounded numbers, shortened names, and HTML with everything escaped.

`error_text` removes the server's paths and addresses from errors.
"""

import html
import re
from collections.abc import Iterable

from hapticdb.errors import HapticDBError
from hapticdb.store.base import Object
from hapticdb.store.urls import redact
from hapticdb.units import length_text

LONGEST_NAME = 34
"""Characters of a name on a button or in a line. Larger: longer names, and buttons wrap."""
MOST_SAID = 6
"""Names in the list of touched objects. Larger: the panel's height varies more during a slide."""

FAULT = "the page failed at this; the operator's log says why"
"""Text of an unexpected error."""
ENVIRONMENT = "the environment"
ADDRESS = re.compile(r"\b[a-zA-Z][\w+.-]*://[^\s'\"]*")
"""A URL, to its end."""
FOLDERS = re.compile(r"""(?<![^\s'"`(\[<=:,;])/(?=[^\s/])(?:[^/\n:'",;]+/)*""")
"""The folders of an absolute path. Names may contain spaces."""


def error_text(error: BaseException, addresses: Iterable[str], folders: Iterable[str] = ()) -> str:
    """Text of an error without addresses and folders; files stay, by name.

    Other absolute paths than those of `folders` are recognised by their form.
    """
    if not isinstance(error, HapticDBError):
        return FAULT
    text = str(error)
    known = {shown for url in addresses for shown in (url, redact(url)) if shown}
    for shown in sorted(known, key=len, reverse=True):
        text = re.sub(rf"(?<!\w){re.escape(shown)}(?!\w)", ENVIRONMENT, text)
    for folder in sorted({one.rstrip("/") for one in folders} - {""}, key=len, reverse=True):
        text = re.sub(rf"(?<!\w){re.escape(folder)}/", "", text)
    return FOLDERS.sub("", ADDRESS.sub(ENVIRONMENT, text))


def plain_name(name: str) -> str:
    """A name on one line, with question marks for characters that cannot be printed."""
    return "".join(letter if letter.isprintable() else "?" for letter in name) or "(no name)"


def short_name(name: str, longest: int = LONGEST_NAME) -> str:
    """A name of at most `longest` characters: the path's last element, with its middle elided."""
    shown = plain_name(name)
    if len(shown) > longest:
        shown = shown.rsplit("/", 1)[-1] or shown
    if len(shown) > longest:
        head = (longest - 1) * 2 // 3
        shown = f"{shown[:head]}…{shown[len(shown) - (longest - 1 - head) :]}"
    return shown


def escaped(text: str) -> str:
    """Text escaped for HTML."""
    return html.escape(plain_name(text), quote=True)


def size_text(obj: Object) -> str:
    """Edges of an object's AABB, in metres or millimetres: ``1.2 m x 40 mm x 3 mm``."""
    return " × ".join(length_text(float(side)) for side in obj.bounds[1] - obj.bounds[0])  # noqa: RUF001 - the sign of sizes


def swatch(colour: tuple[int, int, int]) -> str:
    """A small square of a colour, as HTML."""
    red, green, blue = (int(channel) for channel in colour)
    return (
        '<span style="display:inline-block;width:0.7em;height:0.7em;border-radius:2px;'
        f'margin-right:0.4em;background:rgb({red},{green},{blue})"></span>'
    )


def rows_html(rows: Iterable[tuple[str, str]]) -> str:
    """A table of two columns, both escaped."""
    cells = "".join(
        '<tr><td style="opacity:0.6;padding:1px 10px 1px 0;vertical-align:top;white-space:nowrap">'
        f'{escaped(word)}</td><td style="word-break:break-word">{escaped(text)}</td></tr>'
        for word, text in rows
    )
    return f'<table style="font-size:0.82em;margin:2px 12px;border-spacing:0">{cells}</table>'


def note_html(text: str) -> str:
    """A small grey line, escaped."""
    return f'<div style="font-size:0.8em;opacity:0.7;margin:2px 12px">{escaped(text)}</div>'
