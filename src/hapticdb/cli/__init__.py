"""Command line: parse, call, print.

Results go to standard output, progress and errors to standard error. A user's error prints one line
and exits with 2, any other exception one line and exits with 1; ``--debug`` adds the traceback.
"""

import contextlib
import os
import re
import sys
import traceback
from collections.abc import Sequence
from itertools import takewhile

from hapticdb import interrupting
from hapticdb.cli import render
from hapticdb.cli.options import command
from hapticdb.cli.root import Interrupted, PipeClosedError, app, leaving_in_order
from hapticdb.cli.verbs.clashing import clashes
from hapticdb.cli.verbs.copying import copy, diff
from hapticdb.cli.verbs.editing import move, remove
from hapticdb.cli.verbs.extracting import extract
from hapticdb.cli.verbs.feeling import feel, replay
from hapticdb.cli.verbs.importing import import_
from hapticdb.cli.verbs.listing import info, objects
from hapticdb.cli.verbs.maintenance import backup, check, grant
from hapticdb.cli.verbs.measuring import distance, reach
from hapticdb.cli.verbs.sampling import demo, sample
from hapticdb.cli.verbs.serving import serve, view
from hapticdb.cli.verbs.sweeping import sweep
from hapticdb.cli.verbs.touching import touch
from hapticdb.errors import HapticDBError
from hapticdb.tabular.tables import printable

__all__ = ["app", "main"]

USER_ERROR = 2

VERBS = (
    import_, info, objects, touch, feel, view, serve, replay, sweep, reach, clashes, distance,
    extract, move, remove, copy, diff, check, backup, grant, demo, sample,
)  # fmt: skip
"""Verbs, as listed; their docstrings are their help texts."""
for verb in VERBS:
    app.command(verb.__name__.rstrip("_"))(command(verb))


def main(argv: Sequence[str] | None = None) -> int:
    """Run a command line, by default the process's own, and return its exit code."""
    args = list(sys.argv[1:] if argv is None else argv)
    is_debugging = "--debug" in takewhile(lambda arg: arg.startswith("-"), args)
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):  # escapes for characters outside the encoding
            stream.reconfigure(errors="as_ascii")
    try:
        with leaving_in_order(), render.noting_warnings():
            code = app(args, standalone_mode=False, prog_name="hapticdb")
        sys.stdout.flush()
    except (BrokenPipeError, PipeClosedError):
        with contextlib.suppress(OSError, ValueError):  # its reader, as `| head`, has closed it
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 141
    except (KeyboardInterrupt, Interrupted) as error:
        interrupting.leave()  # a further Ctrl-C would print another line
        return _fail(str(error) or "interrupted", interrupting.EXIT_CODE)
    except HapticDBError as error:
        return _fail(str(error), USER_ERROR, show_trace=is_debugging)
    except Exception as error:  # noqa: BLE001 - a user sees one line, whatever happened
        if hasattr(error, "format_message"):  # typer's own, under the name of each version
            return _fail(_usage(error), USER_ERROR, show_trace=is_debugging)
        cause = str(error).partition("\n")[0] or "no message"
        hint = "" if is_debugging else "; 'hapticdb --debug ...' shows where"
        message = f"{type(error).__name__}: {cause}{hint}"
        return _fail(message, 1, show_trace=is_debugging)
    return code if isinstance(code, int) else 0


def _fail(message: str, code: int, *, show_trace: bool = False) -> int:
    if show_trace:
        sys.stderr.write(printable(traceback.format_exc()))
    with contextlib.suppress(BrokenPipeError):
        render.note(message)
    return code


def _usage(error: Exception) -> str:
    """Typer's message as one line, with the verb's ``--help``."""
    text = str(error.format_message()).replace("Value error, ", "").rstrip(".")  # type: ignore[attr-defined]
    text = re.sub(r" \(Possible options: (.*)\)", r"; did you mean \1?", text)
    context = getattr(error, "ctx", None)
    command = getattr(context, "command_path", "hapticdb")
    return f"{text[:1].lower()}{text[1:]}; see '{command} --help'"
