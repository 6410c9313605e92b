"""The verbs view and serve."""

import signal
import webbrowser
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from hapticdb.cli import render
from hapticdb.cli.options import RenderingName, UrlArgument
from hapticdb.cli.root import TERMINATED, Interrupted, ended_by_signals
from hapticdb.errors import MissingExtraError, UsageError, pip_line

if TYPE_CHECKING:
    from hapticdb.server.access import Role
    from hapticdb.server.served import Serving


ToolsOption = Annotated[
    list[str] | None,
    typer.Option(
        "--tool",
        metavar="FILE",
        help="Mesh of a tool to choose from, beside a ball and a peg. Give it again for more.",
    ),
]
RenderingOption = Annotated[
    RenderingName | None,
    typer.Option(
        help="coupled: a spring between hand and tool, which stays outside of surfaces; needs "
        "distances. direct: the wrench of each frame, capped.",
        show_default="coupled where there are distances",
    ),
]
RecordingsOption = Annotated[
    str | None,
    typer.Option(metavar="FOLDER", help="Folder in which people's sessions may be recorded."),
]
SecondsOption = Annotated[
    float | None,
    typer.Option(metavar="S", help="End that long after the start.", show_default="Ctrl-C"),
]
NoBrowserOption = Annotated[
    bool, typer.Option("--no-browser", help="Print the address, and open no browser.")
]
TokenOption = Annotated[
    bool,
    typer.Option(
        "--token", help="Ask for a token. One is made for each role, and printed at the start."
    ),
]
TokenFileOption = Annotated[
    str | None,
    typer.Option(
        metavar="FILE",
        help="Tokens of yours, 16 characters or more: a file with ROLE=TOKEN on each line. Roles: "
        "viewer, toucher, editor.",
    ),
]
RoleUrlOption = Annotated[
    list[str] | None,
    typer.Option(
        metavar="ROLE=URL",
        help="Address of the environment for a role, with the rights of a user of the database.",
    ),
]
HostOption = Annotated[
    str, typer.Option(metavar="ADDRESS", help="Address to listen on; 0.0.0.0 is all of them.")
]
PortOption = Annotated[int, typer.Option(metavar="N", help="Port to listen on; 0 is a free one.")]
PrefixOption = Annotated[
    str, typer.Option(metavar="/PATH", help="Path under which a proxy hands requests on.")
]
HostNameOption = Annotated[
    list[str] | None,
    typer.Option(metavar="NAME", help="Name of this server for browsers, such as that of a proxy."),
]
CertificateOption = Annotated[
    str | None, typer.Option("--tls-cert", metavar="FILE", help="Certificate of TLS, PEM.")
]
KeyOption = Annotated[
    str | None, typer.Option("--tls-key", metavar="FILE", help="Key of the certificate, PEM.")
]
LogJsonOption = Annotated[
    bool, typer.Option("--log-json", help="Write the log as JSON, an object a line.")
]


def view(
    url: UrlArgument,
    *,
    tool: ToolsOption = None,
    rendering: RenderingOption = None,
    recordings: RecordingsOption = None,
    seconds: SecondsOption = None,
    no_browser: NoBrowserOption = False,
) -> None:
    """See and feel an environment in a browser on this machine.

    Example: hapticdb view car.db --tool wrench.stl
    """
    _check_extra()
    from hapticdb.server.access import Role, make_token

    token = make_token()
    serving = _serving(url, tool, {token: Role.EDITOR}, None, recordings, rendering)

    def ready(port: int) -> None:
        address = serving.address(port, token)
        print(address, flush=True)
        if not no_browser:
            webbrowser.open(address)

    _run(serving, ready, seconds, log_json=False, is_quiet=True)


def serve(
    url: UrlArgument,
    *,
    tool: ToolsOption = None,
    token: TokenOption = False,
    token_file: TokenFileOption = None,
    role_url: RoleUrlOption = None,
    host: HostOption = "127.0.0.1",
    port: PortOption = 0,
    prefix: PrefixOption = "",
    host_name: HostNameOption = None,
    rendering: RenderingOption = None,
    recordings: RecordingsOption = None,
    tls_cert: CertificateOption = None,
    tls_key: KeyOption = None,
    log_json: LogJsonOption = False,
    seconds: SecondsOption = None,
) -> None:
    """Let others see and feel an environment in browsers.

    Example: hapticdb serve car.db --tool wrench.stl --token
    """
    _check_extra()
    from dataclasses import replace

    tokens = _tokens(token_file, are_made=token)
    serving = replace(
        _serving(url, tool, tokens, role_url, recordings, rendering),
        host=host, port=port, prefix=prefix.rstrip("/"), host_names=tuple(host_name or ()),
        certificate=tls_cert, key=tls_key,
    )  # fmt: skip

    def ready(port: int) -> None:
        for made, role in tokens.items() if token else ():
            print(f"{role.word:<8}{serving.address(port, made)}", flush=True)
        if token:
            render.note(
                "give each person one of these addresses: a viewer sees, a toucher also feels, an "
                "editor also moves, adds and removes parts"
            )
        else:
            print(serving.address(port), flush=True)
        if not tokens:
            render.note("every program on this machine may edit; --token asks for a token")

    _run(serving, ready, seconds, log_json=log_json)


def _check_extra() -> None:
    from importlib.util import find_spec

    missing = [name for name in ("viser", "starlette", "uvicorn", "prometheus_client")
               if find_spec(name) is None]  # fmt: skip
    if missing:
        raise MissingExtraError(f"the browser view needs {', '.join(missing)}: {pip_line('view')}")


def _serving(
    url: str,
    tools: Sequence[str] | None,
    tokens: "dict[str, Role]",
    role_urls: Sequence[str] | None,
    recordings: str | None,
    rendering: RenderingName | None,
) -> "Serving":
    """What to serve; refuses what is not there, and a coupling where there are no distances."""
    from contextlib import closing

    from hapticdb.server.access import Role
    from hapticdb.server.served import Serving
    from hapticdb.store.connect import open_store

    urls = dict.fromkeys(Role, url)
    for text in role_urls or ():
        role, other = _pair(text, "--role-url")
        urls[role] = other
    for other in dict.fromkeys(urls.values()):
        with closing(open_store(other, read_only=True)) as store:
            if rendering == "coupled" and not store.wants_distances:
                from hapticdb.session.prefetch.resident_cells import without_distances

                raise UsageError(without_distances(store.url, "leave out --rendering coupled"))
    for tool in tools or ():
        if not Path(tool).is_file():
            raise UsageError(f"--tool {tool}: no such file")
    if recordings is not None and not Path(recordings).is_dir():
        raise UsageError(f"--recordings {recordings}: no such folder")
    return Serving(
        urls=urls, tools=tuple(tools or ()), tokens=tokens,
        open_role=None if tokens else Role.EDITOR,
        title=_title(url), rendering=rendering,
        recordings=None if recordings is None else str(Path(recordings).resolve()),
    )  # fmt: skip


def _title(url: str) -> str:
    """Title of the page: the file's name, or the environment's place without secrets."""
    from hapticdb.store.urls import redact

    return f"{Path(redact(url).partition('?')[0]).stem} - hapticdb"


def _tokens(file: str | None, *, are_made: bool) -> "dict[str, Role]":
    """Collect the tokens of a file, and those that are made, with the role of each."""
    from hapticdb.server.access import Role, check_token, make_token

    tokens = {make_token(): role for role in Role} if are_made else {}
    if file is not None:
        try:
            lines = Path(file).read_text("utf-8-sig").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise UsageError(f"--token-file {file}: cannot be read: {error}") from None
        for line in map(str.strip, lines):
            if not line or line.startswith("#"):
                continue
            role, token = _pair(line, "--token-file")
            check_token(token)
            tokens[token] = role
    return tokens


def _pair(text: str, option: str) -> "tuple[Role, str]":
    from hapticdb.server.access import Role

    word, mark, rest = text.partition("=")
    if not mark or not rest:
        raise UsageError(f"{option}: write ROLE=..., such as editor=...")
    return Role.of(word), rest


def _run(
    serving: "Serving",
    ready: Callable[[int], None],
    seconds: float | None,
    *,
    log_json: bool,
    is_quiet: bool = False,
) -> None:
    import asyncio
    import logging

    from hapticdb.server import served
    from hapticdb.session.processes.fork_server import prepare

    if seconds is not None and not seconds > 0.0:
        raise UsageError(f"--seconds {seconds:g}: give a time above 0")
    served.check(serving)
    prepare(served.PAGE, with_kernels=False)  # loads while the server does here
    from hapticdb.server import logs, running

    if not served.is_near(serving.host) and serving.certificate is None:
        render.note(
            "tokens and forces cross the network unencrypted; give --tls-cert and --tls-key, or "
            "put a proxy with TLS in front"
        )

    render.note(f"preparing {serving.title.partition(' - ')[0]}")

    async def work() -> list[int]:
        stop = asyncio.Event()
        loop = asyncio.get_running_loop()

        def begun(port: int) -> None:
            ready(port)
            if seconds is not None:
                loop.call_later(seconds, stop.set)

        with ended_by_signals(lambda: loop.call_soon_threadsafe(stop.set)) as signals:
            await running.run(serving, begun, stop)
        return signals

    level = logging.WARNING if is_quiet else logging.INFO
    with logs.written("json" if log_json else "plain", level):
        signals = asyncio.run(work())
    if signal.SIGTERM in signals:
        render.note("ended by SIGTERM")
        raise typer.Exit(TERMINATED)
    if signals:
        raise Interrupted("ended by Ctrl-C")
