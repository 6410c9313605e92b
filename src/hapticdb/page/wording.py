"""Texts of the page: numbers with few decimals, names that fit, and everything escaped in HTML.

Errors name files and addresses of the server's machine; `error_text` takes them out.
"""

import html
import re
from collections.abc import Iterable

from hapticdb.errors import HapticDBError
from hapticdb.store.base import Object
from hapticdb.store.urls import redact
from hapticdb.units import length_text

LONGEST_NAME = 34
"""Letters of a name on a button or in a line. Larger: more of a name is seen, and buttons wrap."""
MOST_SAID = 6
"""Names in one list of what is touched. Larger: the panel grows and jumps while a tool slides."""

FAULT = "the page failed at this; the operator's log says why"
"""All that a browser gets of an error that nobody has foreseen."""
ENVIRONMENT = "the environment"
"""What stands for its address."""
ADDRESS = re.compile(r"\b[a-zA-Z][\w+.-]*://[^\s'\"]*")
"""A URL, to its end."""
FOLDERS = re.compile(r"""(?<![^\s'"`(\[<=:,;])/(?=[^\s/])(?:[^/\n:'",;]+/)*""")
"""All of an absolute path but its last name. Names may have spaces."""


def error_text(error: BaseException, addresses: Iterable[str], folders: Iterable[str] = ()) -> str:
    """Words of an error as any browser may read them: without addresses and folders.

    An absolute path in another folder than the known ones is found by its form. Files keep their
    names.
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
    """Return a name on one line: letters that cannot be printed become a question mark."""
    return "".join(letter if letter.isprintable() else "?" for letter in name) or "(no name)"


def short_name(name: str, longest: int = LONGEST_NAME) -> str:
    """Shorten a name to `longest` letters: its path's last part, then the middle is left out."""
    shown = plain_name(name)
    if len(shown) > longest:
        shown = shown.rsplit("/", 1)[-1] or shown
    if len(shown) > longest:
        head = (longest - 1) * 2 // 3
        shown = f"{shown[:head]}…{shown[len(shown) - (longest - 1 - head) :]}"
    return shown


def escaped(text: str) -> str:
    """Text as HTML shows it; nothing in it is read as a tag or an entity."""
    return html.escape(plain_name(text), quote=True)


def force_text(newtons: float) -> str:
    """Force with two decimals: ``1.25 N``."""
    return f"{newtons:.2f} N"


def torque_text(newton_metres: float) -> str:
    """Torque with three decimals: ``0.031 N m``."""
    return f"{newton_metres:.3f} N m"


def size_text(obj: Object) -> str:
    """Sides of an object's box, in metres or millimetres: ``1.2 m x 40 mm x 3 mm``."""
    return " × ".join(length_text(float(side)) for side in obj.bounds[1] - obj.bounds[0])  # noqa: RUF001 - the sign of sizes


def swatch(colour: tuple[int, int, int]) -> str:
    """Return a small square of a colour, as HTML."""
    red, green, blue = (int(channel) for channel in colour)
    return (
        '<span style="display:inline-block;width:0.7em;height:0.7em;border-radius:2px;'
        f'margin-right:0.4em;background:rgb({red},{green},{blue})"></span>'
    )


def rows_html(rows: Iterable[tuple[str, str]]) -> str:
    """Return a table of two columns, both escaped."""
    cells = "".join(
        '<tr><td style="opacity:0.6;padding:1px 10px 1px 0;vertical-align:top;white-space:nowrap">'
        f'{escaped(word)}</td><td style="word-break:break-word">{escaped(text)}</td></tr>'
        for word, text in rows
    )
    return f'<table style="font-size:0.82em;margin:2px 12px;border-spacing:0">{cells}</table>'


def note_html(text: str) -> str:
    """Return a small grey line, escaped."""
    return f'<div style="font-size:0.8em;opacity:0.7;margin:2px 12px">{escaped(text)}</div>'
