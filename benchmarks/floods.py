"""How late a healthy session is while others flood the server with malformed messages.

    python benchmarks/floods.py                     # the sample car; 100,000 messages a flood
    python benchmarks/floods.py --url car.db --busy

The server is `hapticdb serve` in a process of its own. The healthy session is a device of that
one: it mirrors cells and runs its loop at 1 kHz here. Its frames are counted undisturbed, while
the relay of browsers is flooded, and while the endpoint of devices is. A flood is sent by a
process of its own, in connections of many messages: some are well formed and make no sense,
others are noise. The server ends a connection of either kind before its last message, and a
client that is ended connects again. All processes share this machine's processors.
"""

import argparse
import asyncio
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

import hapticdb
from awake import awake
from hapticdb import PointShell, Session
from hapticdb.bench import records
from hapticdb.bench.workload import slide_poses
from hapticdb.devices.scripted import Player
from hapticdb.protocol.cells import pack_numbers
from hapticdb.protocol.header import LAYOUT, MAGIC, VERSION, Kind, MessageHeader
from hapticdb.sample import write_sample
from report.floods_page import flood_table
from served import TOKENS, ServedProcess, car_or_sample

Line = dict[str, Any]
MESSAGES = 100_000
EACH = 200
"""Messages of one connection. Larger: fewer connections, and more of what follows the message that
ends one."""
AT_ONCE = 4
"""Connections of a flood at once."""
SECONDS = 20.0
"""Length of the undisturbed line."""
MOST_SECONDS = 60.0
"""Longest time of a flood. What was not sent by then is not sent, and the figures say so."""
SETTLING = 2.0
"""Seconds before frames count."""
POINTS = 300
N_POSES = 2000
"""Poses of the way over the car."""
SPEED = 0.1
"""Speed of the hand along its way, m/s."""
LEAST_STEP = 1e-7
"""Metres that a pose counts at least, so that times grow."""
BITS = 9
"""Bits an axis of the car's grid."""
SEED = 7


def device_messages(rng: np.random.Generator) -> list[bytes]:
    """Messages of one connection to `/device/cells`: nonsense in good form, then noise."""
    hello = MessageHeader(Kind.HELLO, 1).packed()
    nonsense = [
        LAYOUT.pack(MAGIC, VERSION, 200 + int(rng.integers(50)), n + 2, 0) + rng.bytes(8)
        for n in range(EACH // 20)
    ]
    nonsense += [
        MessageHeader(Kind.QUANTILES, n + 2).packed() + pack_numbers(int(rng.integers(2**40)))
        for n in range(EACH // 20)
    ]
    noise = [rng.bytes(int(rng.integers(80))) for _ in range(EACH - 1 - len(nonsense))]
    return [hello, *nonsense, *noise]


def browser_messages(rng: np.random.Generator) -> list[bytes]:
    """Messages of one connection to the relay: noise, and beginnings of what browsers send."""
    noise = [rng.bytes(int(rng.integers(80))) for _ in range(EACH // 2)]
    cut = [b"\x82\xa4type\xb1GuiUpdateMessage" + rng.bytes(9) for _ in range(EACH - len(noise))]
    return [*noise, *cut]


async def flood(kind: str, port: int, count: int) -> None:
    """Send so many messages; print how many connections took them, and how many were sent."""
    import viser  # noqa: PLC0415 - slow, and only the flood needs it
    from websockets.asyncio.client import connect  # noqa: PLC0415 - an extra
    from websockets.exceptions import WebSocketException  # noqa: PLC0415
    from websockets.typing import Subprotocol  # noqa: PLC0415

    rng = np.random.default_rng(SEED)
    sent = connections = refused = 0
    address = f"ws://127.0.0.1:{port}"
    headers = {"Authorization": f"Bearer {TOKENS['viewer' if kind == 'relay' else 'toucher']}"}
    protocols = None
    if kind == "device":
        address += "/device/cells"
    else:
        headers["Origin"] = f"http://127.0.0.1:{port}"
        protocols = [Subprotocol(f"viser-v{viser.__version__}")]
    until = time.monotonic() + MOST_SECONDS

    async def send_all() -> None:
        nonlocal sent, connections, refused
        while sent < count and time.monotonic() < until:
            some = device_messages(rng) if kind == "device" else browser_messages(rng)
            try:
                async with asyncio.timeout(20.0), connect(
                    address, additional_headers=headers, subprotocols=protocols, proxy=None,
                    compression=None, close_timeout=1.0,
                ) as client:  # fmt: skip
                    connections += 1
                    for message in some:
                        await client.send(message)
                        sent += 1
                    async for _ in client:  # until the server ends it
                        pass
            except (WebSocketException, OSError, TimeoutError):
                refused += 1
                await asyncio.sleep(0.02)

    await asyncio.gather(*(send_all() for _ in range(AT_ONCE)))
    print(json.dumps({"sent": sent, "connections": connections, "cut": refused}), flush=True)


class Flood:
    """A flood in a process of its own, of kind "relay" or "device"."""

    def __init__(self, kind: str, port: int, count: int) -> None:
        self._process = subprocess.Popen(
            [sys.executable, __file__, "--flood", kind, str(port), str(count)],
            stdout=subprocess.PIPE, text=True,
        )  # fmt: skip
        self._late = threading.Timer(MOST_SECONDS + 60.0, self._process.kill)
        self._late.start()

    @property
    def is_over(self) -> bool:
        return self._process.poll() is not None

    def close(self) -> Line:
        """What was sent."""
        out, _ = self._process.communicate(timeout=MOST_SECONDS + 60.0)
        self._late.cancel()
        found: Line = json.loads(out)
        return found


def line(kind: str, server: ServedProcess, shell: PointShell, hand: Player, count: int) -> Line:
    """Figures of the healthy session during one flood, or "undisturbed"."""
    before = server.memory()
    sent: Line = {}
    with Session(server.device_url(), shell, hand, has_baseline=False) as session:
        session.wait(SETTLING)
        if kind == "undisturbed":
            session.wait(SECONDS)
        else:
            flooding = Flood(kind, server.port, count)
            while not flooding.is_over:
                session.wait(0.1)
            sent = flooding.close()
        report = session.stop()
    loop = report.loop
    return {
        "kind": kind,
        "lateness": {
            "p50": loop.lateness.p50, "p99": loop.lateness.p99, "worst": loop.lateness.worst,
        },
        "frames": loop.frames,
        "in_time": loop.frames / (loop.frames + loop.missed),
        "unknown_frames": report.unknown_frames,
        "held_frames": report.held_frames,
        "stale_frames": report.stale_frames,
        "memory_before_mb": before,
        "memory_after_mb": server.memory(),
        **sent,
    }  # fmt: skip


def measure(folder: Path, given: argparse.Namespace) -> Line:
    """Measure all lines; a record for JSON."""
    sample = write_sample(folder / "sample")
    url = given.url or car_or_sample(folder, sample.car, BITS)
    with hapticdb.open(url, read_only=True) as env:
        shell = PointShell.sphere(12.0 * env.grid.voxel_size, POINTS)
        poses = slide_poses(env, shell, N_POSES)
    way = np.concatenate([poses, poses[::-1]])
    steps = np.linalg.norm(np.diff(way[:, :3, 3], axis=0), axis=1)
    times = np.cumsum(np.append(0.0, np.maximum(steps, LEAST_STEP))) / SPEED
    lines = []
    with ServedProcess(url, folder) as server:
        for kind in ("undisturbed", "relay", "device"):
            hand = Player(times, way, loops=True)
            lines.append(line(kind, server, shell, hand, given.messages))
            print(json.dumps(lines[-1]), file=sys.stderr, flush=True)
    log = server.log.read_text()
    return {
        **records.conditions(),
        "environment": Path(url).stem,
        "points": len(shell),
        "messages": given.messages,
        "is_busy": given.busy,
        "processors": os.cpu_count(),
        "tracebacks": log.count("Traceback"),
        "lines": lines,
    }


def main() -> None:
    """Measure, print a table, and write the figures to a file."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--url", help="of an environment; the car unless given")
    parser.add_argument("--messages", type=int, default=MESSAGES, help="of each flood")
    parser.add_argument("--busy", action="store_true", help="note that other work runs, too")
    parser.add_argument("--out", type=Path, default=Path("results/floods.json"))
    parser.add_argument("--flood", nargs=3, metavar=("KIND", "PORT", "COUNT"), help="send one")
    given = parser.parse_args()
    if given.flood:
        kind, port, count = given.flood
        asyncio.run(flood(kind, int(port), int(count)))
        return
    with awake(), tempfile.TemporaryDirectory(prefix="hapticdb-floods-") as folder:
        found = measure(Path(folder), given)
    print(flood_table(found))
    given.out.write_text(json.dumps(found, indent=1) + "\n")


if __name__ == "__main__":
    with contextlib.suppress(KeyboardInterrupt):
        main()
