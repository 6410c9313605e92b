"""The typer application, its global options, and its end by signals."""

import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Annotated, Any

import typer
import typer.core

from hapticdb import interrupting
from hapticdb.cli.render import note


class Interrupted(Exception):  # noqa: N818 - no error: the user pressed Ctrl-C
    """Ctrl-C, with a message on the state of the data."""


@contextmanager
def left_at(state: str) -> Iterator[None]:
    """Add the state of the data to the message if Ctrl-C ends the block."""
    try:
        yield
    except KeyboardInterrupt:
        raise Interrupted(f"interrupted; {state}") from None


class PipeClosedError(Exception):
    """Standard output closed by its reader, as by ``| head``."""


class Verbs(typer.core.TyperGroup):
    """The verbs; Ctrl-C and closed pipes pass through to `main`."""

    def invoke(self, ctx: Any) -> Any:  # noqa: ANN401, D102 - typer's types move between versions
        interrupting.work()
        try:
            return super().invoke(ctx)
        except KeyboardInterrupt:
            raise Interrupted("interrupted") from None
        except BrokenPipeError as error:  # typer would end the process
            raise PipeClosedError from error


app = typer.Typer(
    cls=Verbs,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,  # plain: rich would take half of the time of a help text
    context_settings={"help_option_names": ["-h", "--help"]},
)


@contextmanager
def leaving_in_order() -> Iterator[None]:
    """Let SIGTERM end the program with all clean-up: servers are stopped, devices released."""
    is_ours = threading.current_thread() is threading.main_thread()
    if not is_ours or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield  # another handler stays
        return
    signal.signal(signal.SIGTERM, leave)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def leave(number: int, _: object) -> None:
    """Signal handler: end the program with the signal's exit code."""
    raise SystemExit(128 + number)


def exit_by(signals: Sequence[int], after: str = "") -> None:
    """Exit with the code of the signal that ended a verb's work, if one did."""
    if signal.SIGTERM in signals:
        note(f"ended by SIGTERM{after}")
        leave(signal.SIGTERM, None)
    if signals:
        raise Interrupted(f"ended by Ctrl-C{after}")


@app.callback(invoke_without_command=True)
def root(
    context: typer.Context,
    *,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    debug: Annotated[bool, typer.Option("--debug", help="Show tracebacks of errors.")] = False,
) -> None:
    """What clashes, what comes out, and how it feels: scenes of CAD parts in an SQL database.

    First steps:

    \b
      hapticdb sample sample
      hapticdb import car.db sample/car.glb
      hapticdb clashes car.db
      hapticdb extract car.db body/trunk_lid
      hapticdb view car.db --tool sample/spanner.stl

    A URL instead of a path opens an environment on PostgreSQL:
    'postgresql://user@host/database?environment=NAME'.

    'hapticdb VERB --help' explains a verb and its options, with an example.
    """  # noqa: D301 - the help text's mark of lines that stay as they are
    del debug  # `main` reads it
    if version:
        from hapticdb import __version__

        print(f"hapticdb {__version__}")
        raise typer.Exit
    if context.invoked_subcommand is None:
        print(context.get_help())


@contextmanager
def ended_by_signals(stop: Callable[[], object]) -> Iterator[list[int]]:
    """Let the first Ctrl-C or SIGTERM call `stop`, a second one end all; yields the signals."""
    came: list[int] = []
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    before = {  # another's handler stays
        number: handler
        for number, handler in handlers.items()
        if handler in {signal.default_int_handler, interrupting.interrupt, leave}
    }

    def end(number: int, _: object) -> None:
        came.append(number)
        stop()
        signal.signal(number, before[signal.Signals(number)])

    for number in before:
        signal.signal(number, end)
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
