"""The verbs view and serve."""

import webbrowser
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from hapticdb.cli import render
from hapticdb.cli.options import RenderingName, UnitName
from hapticdb.cli.root import ended_by_signals, exit_by
from hapticdb.cli.values import pose_of
from hapticdb.cli.verbs.sweeping import MachineOptions
from hapticdb.errors import MissingExtraError, UsageError, pip_line

if TYPE_CHECKING:
    from hapticdb.page.connection import MachineFiles
    from hapticdb.server.access import Role
    from hapticdb.server.served import Serving


@dataclass(frozen=True)
class PageOptions:
    """Options of a page's contents and duration."""

    tool: list[str] | None = None
    tool_unit: UnitName | None = None
    rendering: RenderingName | None = None
    recordings: str | None = None
    seconds: float | None = None

    def serving(
        self, url: str, tokens: "dict[str, Role]", machine: MachineOptions,
        role_urls: Sequence[str] = (),
    ) -> "Serving":  # fmt: skip
        """Settings of the server; UsageError for missing files, or a coupling without distances."""
        from contextlib import closing

        from hapticdb.server.access import Role
        from hapticdb.server.served import Serving
        from hapticdb.store.connect import open_store
        from hapticdb.store.urls import redact

        urls = dict.fromkeys(Role, url) | dict(_pair(text, "--role-url") for text in role_urls)
        for other in dict.fromkeys(urls.values()):
            with closing(open_store(other, read_only=True)) as store:
                if self.rendering == "coupled" and not store.wants_distances:
                    from hapticdb.session.prefetch.resident_cells import without_distances

                    raise UsageError(without_distances(store.url, "leave out --rendering coupled"))
        for tool in self.tool or ():
            if not Path(tool).is_file():
                raise UsageError(f"--tool {tool}: no such file")
        folder = self.recordings
        if folder is not None and not Path(folder).is_dir():
            raise UsageError(f"--recordings {folder}: no such folder")
        return Serving(
            urls=urls, tools=tuple(self.tool or ()), tool_unit=self.tool_unit, tokens=tokens,
            open_role=None if tokens else Role.EDITOR, rendering=self.rendering,
            title=f"{Path(redact(url).partition('?')[0]).stem} - hapticdb",
            recordings=None if folder is None else str(Path(folder).resolve()),
            machine=_machine_files(machine),
        )  # fmt: skip


def _machine_files(given: MachineOptions) -> "MachineFiles | None":
    import numpy as np

    from hapticdb.page.connection import MachineFiles

    if given.machine is None:
        if given != MachineOptions():
            raise UsageError("--joints, --srdf and --at belong to --machine: give it, too")
        return None
    for name, file in vars(given).items():
        if name != "at" and file is not None and not Path(file).is_file():
            raise UsageError(f"--{name} {file}: no such file")
    at = np.eye(4) if given.at is None else pose_of(given.at, "--at")
    return MachineFiles(given.machine, given.srdf, given.joints, at)


@dataclass(frozen=True)
class ReachOptions:
    """Options of a server's address, proxy and certificate."""

    host: str = "127.0.0.1"
    port: int = 0
    prefix: str = ""
    host_name: list[str] | None = None
    tls_cert: str | None = None
    tls_key: str | None = None


def view(url: str, *, page: PageOptions, machine: MachineOptions, no_browser: bool = False) -> None:
    """See and feel in a browser.

    Example: hapticdb view car.db --tool spanner.stl
    """
    _check_extra()
    from hapticdb.server.access import Role, make_token

    token = make_token()
    serving = page.serving(url, {token: Role.EDITOR}, machine)

    def ready(port: int) -> None:
        address = serving.address(port, token)
        print(address, flush=True)
        if not no_browser:
            webbrowser.open(address)

    _run(serving, ready, page.seconds, log_json=False, is_quiet=True)


def serve(
    url: str,
    *,
    page: PageOptions,
    machine: MachineOptions,
    token: bool = False,
    token_file: str | None = None,
    role_url: list[str] | None = None,
    reach: ReachOptions,
    log_json: bool = False,
) -> None:
    """Let others see and feel, in browsers and with devices.

    Example: hapticdb serve car.db --tool spanner.stl --token
    """
    _check_extra()
    tokens = _tokens(token_file, are_made=token)
    serving = replace(
        page.serving(url, tokens, machine, role_url or ()), host=reach.host, port=reach.port,
        prefix=reach.prefix.rstrip("/"), host_names=tuple(reach.host_name or ()),
        certificate=reach.tls_cert, key=reach.tls_key,
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

    _run(serving, ready, page.seconds, log_json=log_json)


def _check_extra() -> None:
    from importlib.util import find_spec

    missing = [name for name in ("viser", "embreex", "starlette", "uvicorn", "prometheus_client")
               if find_spec(name) is None]  # fmt: skip
    if missing:
        raise MissingExtraError(f"the browser view needs {', '.join(missing)}: {pip_line('view')}")


def _tokens(file: str | None, *, are_made: bool) -> "dict[str, Role]":
    """Tokens of a file, and new ones, with the role of each."""
    from hapticdb.server.access import Role, check_token, make_token

    tokens = {make_token(): role for role in Role} if are_made else {}
    if file is not None:
        try:
            lines = Path(file).read_text("utf-8-sig").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise UsageError(f"--token-file {file}: cannot be read: {error}") from None
        for n, line in enumerate(map(str.strip, lines), start=1):
            if not line or line.startswith("#"):
                continue
            where = f"--token-file {file}, line {n}"
            role, token = _pair(line, where)
            try:
                check_token(token)
            except UsageError as error:
                raise UsageError(f"{where}: {error}") from None
            tokens[token] = role
    return tokens


def _pair(text: str, option: str) -> "tuple[Role, str]":
    from hapticdb.server.access import Role

    word, mark, rest = text.partition("=")
    if not mark or not rest:
        raise UsageError(f"{option}: write ROLE=..., such as editor=...")
    return Role.of(word), rest


def _run(
    serving: "Serving", ready: Callable[[int], None], seconds: float | None, *, log_json: bool,
    is_quiet: bool = False,
) -> None:  # fmt: skip
    import asyncio
    import logging

    from hapticdb.server import served
    from hapticdb.session.processes.fork_server import prepare

    if seconds is not None and not seconds > 0.0:
        raise UsageError(f"--seconds {seconds:g}: give a time above 0")
    served.check(serving)
    prepare(served.PAGE, with_kernels=False)  # loads while this process loads the server
    from hapticdb.server import lifecycle, logs

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
            await lifecycle.run(serving, begun, stop)
        return signals

    level = logging.WARNING if is_quiet else logging.INFO
    with logs.written("json" if log_json else "plain", level):
        signals = asyncio.run(work())
    exit_by(signals)
