"""Edits beside readers on several servers that are killed, for as long as one likes.

    python benchmarks/shards_endurance.py --seconds 600

A coordinator and three shards run as private servers in a temporary folder. Two processes write
objects, each its own ones; eight processes read. At random moments a shard, the coordinator or a
writer is killed as by a crash, and started again. Rows of an object tell which version they are of
(`labelled`), so every read shows a torn object by itself. A writer knows what it was told to be
written, and looks before each edit that it is there. At the end the environment is checked and
swept. The script prints one JSON object, and fails where anything was torn or lost.
"""

import argparse
import contextlib
import json
import multiprocessing
import os
import random
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from multiprocessing.connection import Connection
from multiprocessing.context import ForkProcess
from pathlib import Path
from typing import NamedTuple

import psycopg
from psycopg import sql

from hapticdb import BusyError, ConnectionLostError, OutdatedError
from hapticdb.check import check_environment
from hapticdb.store.connect import open_store
from hapticdb.store.postgres.address import parse
from hapticdb.store.postgres.private_server import PrivateServer
from hapticdb.store.postgres.shards.store import ShardedStore
from hapticdb.testing.scenes import EVERYWHERE

TESTS = Path(__file__).parent.parent / "tests"
sys.path.insert(0, str(TESTS))

from children import received  # noqa: E402 - of the tests' folder
from labelled import GRID, TornError, contents_of, labelled_object, labelled_rows, labels_of  # noqa: E402 - of the tests' folder
from sharded import N_SHARDS, SHARD_SETTINGS, ShardedServers  # noqa: E402 - of the tests' folder

N_WRITERS, N_READERS, N_OBJECTS = 2, 8, 10
"""Processes, and objects of each writer."""
APART, AWAY = (0.5, 3.0), (0.0, 2.0)
"""Ranges in seconds: between two kills, and for which a server stays away."""
REMOVED, SWEPT = 0.2, 0.02
"""Shares of a writer's steps: removals of objects, and sweeps of all shards."""
PATIENCE_S = 60.0
"""Seconds that a process may take to end when it is told to."""
LONGEST_S = 86400.0
"""Seconds after which a process ends although nobody has told it to."""
FORK = multiprocessing.get_context("fork")


class Frames(NamedTuple):
    """What one reader has seen."""

    frames: int
    outdated: int
    away: int
    torn: list[str]


def read(url: str, stop: Path, seed: int, said: Connection) -> None:
    """Read until the file `stop` is there; send `Frames`."""
    rng = random.Random(seed)  # noqa: S311 - no secret
    frames = outdated = away = 0
    torn: list[str] = []
    store = None
    ends = time.monotonic() + LONGEST_S
    while not stop.exists() and time.monotonic() < ends:
        try:
            if store is None:
                store = open_store(url, read_only=True)
            if rng.random() < 0.5:
                contents_of(store)
            else:
                labels_of(store.scan(*EVERYWHERE))
            frames += 1
        except OutdatedError:
            outdated += 1
        except TornError as error:
            torn.append(str(error))
        except ConnectionLostError:
            away += 1
            time.sleep(0.05)
    said.send(Frames(frames, outdated, away, torn))


class Book:
    """A writer's file of what it tried and what was done; it outlives the writer.

    known : for each object the labels that it may have now; 0 where it may be away.
    """

    def __init__(self, path: Path, ids: range) -> None:
        self.known: dict[int, set[int]] = {i: {0} for i in ids}
        self.n_done = self.last = 0
        if path.exists():
            for line in path.read_text().splitlines():
                word, object_id, label = line.split()
                self._note(word, int(object_id), int(label))
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT)

    def write(self, word: str, object_id: int, label: int) -> None:
        """Note that an edit is tried (`try`), done (`done`), or what was found (`seen`)."""
        os.write(self._file, f"{word} {object_id} {label}\n".encode())
        self._note(word, object_id, label)

    def _note(self, word: str, object_id: int, label: int) -> None:
        if word == "try":
            self.known[object_id].add(label)
            self.last = max(self.last, label)
        else:
            self.known[object_id] = {label}
        self.n_done += word == "done"


def write(url: str, stop: Path, path: Path, number: int, said: Connection) -> None:
    """Edit until the file `stop` is there; send what was lost, in a line each."""
    rng = random.Random(os.getpid())  # noqa: S311 - no secret
    ids = range(1 + number * N_OBJECTS, 1 + (number + 1) * N_OBJECTS)
    book = Book(path, ids)
    store, lost = None, []
    ends = time.monotonic() + LONGEST_S
    while not stop.exists() and time.monotonic() < ends:
        try:
            if store is None:
                store = ShardedStore.open(url)
            object_id = rng.choice(ids)
            found = {obj.id: int(obj.digest) for obj in store.objects()}.get(object_id, 0)
            if found not in book.known[object_id]:
                lost.append(f"object {object_id} has {found}, not {book.known[object_id]}")
            book.write("seen", object_id, found)
            if rng.random() < SWEPT:
                store.sweep()
            edit(store, book, rng, object_id, found, number)
        except BusyError:
            continue
        except ConnectionLostError:
            time.sleep(0.05)
    said.send(lost)


def edit(
    store: ShardedStore, book: Book, rng: random.Random, object_id: int, found: int, number: int
) -> None:
    """Write one object anew, remove it, or put it back."""
    new = book.last + N_WRITERS if book.last else 1 + number
    if found and rng.random() < REMOVED:
        book.write("try", object_id, 0)
        store.remove(object_id, lambda _: [])
        new = 0
    elif found:
        book.write("try", object_id, new)
        store.replace(
            labelled_object(new, object_id, f"{object_id}"), labelled_rows(new), lambda _: []
        )
    else:
        book.write("try", object_id, new)
        made = store.add(labelled_object(new, object_id, f"{object_id}"), labelled_rows(new))
        assert made == object_id
    book.write("done", object_id, new)


class Ordeal:
    """The processes, and what happens to them."""

    def __init__(self, servers: ShardedServers, folder: Path, seed: int) -> None:
        self.servers, self.folder = servers, folder
        self.url = servers.url_of("endurance")
        self.stop = folder / "stop"
        self.rng = random.Random(seed)  # noqa: S311 - no secret
        self.kills = {"shard": 0, "coordinator": 0, "writer": 0}
        self.writers: dict[int, tuple[ForkProcess, Connection]] = {}
        self.readers: list[tuple[ForkProcess, Connection]] = []

    def begin(self) -> None:
        """Make the environment and start all processes."""
        labelled_rows(1)  # compiled once, before the processes are forked
        with closing(ShardedStore.create(self.url, GRID, "brick", distances=True)) as store:
            for object_id in range(1, 1 + N_WRITERS * N_OBJECTS):
                made = store.add(labelled_object(3, 0, f"{object_id}"), labelled_rows(3))
                assert made == object_id
                if object_id % 2:
                    store.remove(object_id, lambda _: [])
                else:
                    (self.folder / f"book{(object_id - 1) // N_OBJECTS}").open("a").write(
                        f"seen {object_id} 3\n"
                    )
        for number in range(N_WRITERS):
            self._start_writer(number)
        for number in range(N_READERS):
            self.readers.append(self._process(read, number))

    def _process(self, target: object, *rest: object) -> tuple[ForkProcess, Connection]:
        here, there = FORK.Pipe(duplex=False)
        made = FORK.Process(target=target, args=(self.url, self.stop, *rest, there))  # type: ignore[arg-type]
        made.start()
        there.close()
        return made, here

    def _start_writer(self, number: int) -> None:
        self.writers[number] = self._process(write, self.folder / f"book{number}", number)

    def kill(self) -> None:
        """Kill something, and start it again later."""
        kind = self.rng.choice(list(self.kills))
        self.kills[kind] += 1
        if kind == "writer":
            number = self.rng.randrange(N_WRITERS)
            process, _ = self.writers[number]
            assert process.is_alive(), f"writer {number} has ended with {process.exitcode}"
            process.kill()
            process.join(PATIENCE_S)
            self._start_writer(number)
            return
        is_shard = kind == "shard"
        victim = self.rng.choice(self.servers.shards) if is_shard else self.servers.coordinator
        victim.kill()
        time.sleep(self.rng.uniform(*AWAY))
        victim.start()

    def end(self) -> dict[str, object]:
        """End all processes; figures of the run, and what is wrong."""
        self.stop.touch()
        lost: list[str] = []
        for process, said in self.writers.values():
            lost += received(said) if said.poll(PATIENCE_S) else ["a writer has ended"]
            process.join(PATIENCE_S)
        seen = []
        for process, said in self.readers:
            assert said.poll(PATIENCE_S), "a reader has ended"
            seen.append(received(said))
            process.join(PATIENCE_S)
        books = [
            Book(self.folder / f"book{n}", range(1 + n * N_OBJECTS, 1 + (n + 1) * N_OBJECTS))
            for n in range(N_WRITERS)
        ]
        with closing(ShardedStore.open(self.url)) as store:
            found = contents_of(store)
            store.sweep()
            revision = store.revision()
        for book in books:
            for object_id, labels in book.known.items():
                if found.get(object_id, 0) not in labels:
                    lost.append(f"object {object_id} has {found.get(object_id, 0)}, not {labels}")
        return {
            "frames": sum(one.frames for one in seen),
            "edits": sum(book.n_done for book in books),
            "revision": revision,
            "kills": self.kills,
            "outdated": sum(one.outdated for one in seen),
            "away": sum(one.away for one in seen),
            "torn": [words for one in seen for words in one.torn][:10],
            "lost": lost[:10],
            "dead_rows": dead_rows(self.servers, self.url),
            "findings": check_environment(self.url).findings[:10],
        }

    def kill_all(self) -> None:
        """End all processes at once."""
        for process, _ in [*self.writers.values(), *self.readers]:
            process.kill()


def dead_rows(servers: ShardedServers, url: str) -> int:
    """Rows on shards that are of no live version."""
    schema = sql.SQL("SET search_path = {}").format(sql.Identifier(parse(url).environment))
    with psycopg.connect(servers.coordinator.conninfo(), autocommit=True) as client:
        client.execute(schema)
        live = client.execute("SELECT id, version FROM live WHERE version IS NOT NULL").fetchall()
    total = 0
    for shard in servers.shards:
        with psycopg.connect(shard.conninfo(), autocommit=True) as client:
            client.execute(schema)
            for table in ("brick", "band"):
                rows = client.execute(f"SELECT id, version FROM {table}").fetchall()
                total += sum(row not in set(live) for row in rows)
    return total


@contextlib.contextmanager
def servers_in(folder: Path):  # type: ignore[no-untyped-def] # noqa: ANN201 - a context
    """A coordinator and shards in a folder."""
    made = [PrivateServer.at(folder / "coordinator", None, SHARD_SETTINGS)]
    with ThreadPoolExecutor(N_SHARDS) as pool:
        places = [folder / f"{n}" for n in range(N_SHARDS)]
        made += pool.map(lambda place: PrivateServer.at(place, None, SHARD_SETTINGS), places)
        list(pool.map(PrivateServer.start, made))
    try:
        yield ShardedServers(made[0], tuple(made[1:]))
    finally:
        for server in made:
            server.stop()


def endure(folder: Path, seconds: float, seed: int) -> dict[str, object]:
    """Run for so many seconds; figures, and what is wrong."""
    with servers_in(folder) as servers:
        run = Ordeal(servers, folder, seed)
        try:
            run.begin()
            ends = time.monotonic() + seconds
            while time.monotonic() < ends:
                time.sleep(run.rng.uniform(*APART))
                run.kill()
            return {"seconds": seconds, **run.end(), "load": os.getloadavg()}
        finally:
            run.kill_all()


def check(figures: dict[str, object]) -> None:
    """Assert that nothing was torn or lost."""
    for name in ("torn", "lost", "findings", "dead_rows"):
        assert not figures[name], figures
    assert figures["frames"], figures
    assert figures["edits"], figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--seconds", type=float, default=600.0)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="hapticdb-endurance-") as name:
        figures = endure(Path(name), args.seconds, args.seed)
    print(json.dumps(figures))
    check(figures)


if __name__ == "__main__":
    main()
