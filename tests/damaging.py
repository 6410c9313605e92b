"""Damages copies of small environments and compares what they answer.

Each case takes one environment, damages a copy, and asks the copy everything that a user asks:
open, grid and size, objects, touches by every strategy, and `check`.
"""

import json
import resource
import shutil
import traceback
from collections.abc import Callable, Iterator
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

import hapticdb
from hapticdb import Grid, PointShell
from hapticdb.grid import CurveName
from hapticdb.query.frame import STRATEGIES, Strategy
from hapticdb.store.base import Layout
from hapticdb.store.sqlite.pages import PAGE_BYTES
from hapticdb.testing import KINDS, write_voxels

PLACES: tuple[tuple[tuple[float, float, float], tuple[Strategy, ...]], ...] = (
    ((0.03, 0.03, 0.03), STRATEGIES),
    ((0.045, 0.02, 0.04), ("array", "cbgroup")),
    ((0.015, 0.04, 0.045), ("maxgap",)),
)
"""Positions of the tool in metres, and the strategies that are asked there."""
LIMIT_S = 30
MEMORY_BYTES = 4 << 30
"""Bytes of address space of a child. A process with numba takes most of it before it begins."""
Content = dict[str, bytes]
"""Contents of files by their suffix after the environment's path: "" and "-wal"."""


class Sample(NamedTuple):
    """An environment to damage: its files, its answers now, and its answers one commit earlier."""

    name: str
    content: Content
    other: bytes
    truths: list[str]


class Outcome(NamedTuple):
    """Result of a case, for reading and for `check`: right, told, silent or worse."""

    damage: str
    sample: str
    read: str
    check: str
    words: str


# -- what is asked -------------------------------------------------------------------------------


def answers(path: Path) -> str:
    """Everything that a user sees of an environment, as text; raises what a user is told."""
    shell = PointShell.sphere(0.012, 60)
    with hapticdb.open(path, read_only=True) as env:
        told: list[Any] = [env.layout, env.grid.describe(), env.size().rows]
        told += [(o.id, o.name, o.voxels, o.bounds.tolist(), o.revision) for o in env.objects()]
        for place, strategies in PLACES:
            pose = np.eye(4)
            pose[:3, 3] = place
            for strategy in strategies:
                touch = env.touch(shell, pose, strategy)
                told.append((touch.force.tolist(), touch.torque.tolist(), touch.pairs.tolist()))
        for obj in env.objects():
            told.append(int(env.voxels(obj.id).sum()))
    return json.dumps(told)


def made(folder: Path, layout: Layout, curve: CurveName, *, in_log: bool) -> Sample:
    """An environment of three objects: all in its file, or the last ones still in its log."""
    grid = Grid(0.001, (0, 0, 0), 6, curve)
    path = folder / f"{layout}-{curve}-{'log' if in_log else 'file'}.db"
    other = folder / f"other-{path.name}"
    with hapticdb.create(other, grid, layout=layout) as env:
        for name in "abc":
            write_voxels(env.store, _lump(ord(name)), name)
    truths: list[str] = []
    with hapticdb.create(path, grid, layout=layout) as env:
        write_voxels(env.store, _lump(1), "a")
        write_voxels(env.store, _lump(2), "b")
        env.analyze()
        env.calibrate()
    truths.append(answers(path))
    env = hapticdb.open(path)
    for number, name in ((3, "c"), (4, "d")):
        write_voxels(env.store, _lump(number), name)
        truths.append(answers(path))
    content = _files(path) if in_log else {}
    env.close()
    return Sample(path.stem, content or _files(path), other.read_bytes(), truths)


def _lump(seed: int) -> NDArray[np.int64]:
    rng = np.random.default_rng(seed)
    low = rng.integers(0, 30, 3)
    ijk = np.argwhere(np.ones((24, 24, 24), bool)) + low
    return ijk[rng.random(len(ijk)) < 0.4]


def _files(path: Path) -> Content:
    log = Path(f"{path}-wal")
    return {"": path.read_bytes()} | ({"-wal": log.read_bytes()} if log.exists() else {})


# -- how it is damaged ---------------------------------------------------------------------------


def _pages(content: bytes | bytearray) -> int:
    return len(content) // PAGE_BYTES


def _page(number: int) -> slice:
    return slice(number * PAGE_BYTES, (number + 1) * PAGE_BYTES)


def _bit(data: bytearray, _: Sample, rng: np.random.Generator) -> None:
    data[rng.integers(len(data))] ^= 1 << rng.integers(8)


def _run(data: bytearray, _: Sample, rng: np.random.Generator) -> None:
    start, length = int(rng.integers(len(data))), int(rng.integers(1, 600))
    part = data[start : start + length]
    data[start : start + length] = rng.bytes(len(part))


def _zeroed_run(data: bytearray, _: Sample, rng: np.random.Generator) -> None:
    start, length = int(rng.integers(len(data))), int(rng.integers(1, 600))
    part = data[start : start + length]
    data[start : start + length] = bytes(len(part))


def _zeroed_page(data: bytearray, _: Sample, rng: np.random.Generator) -> None:
    data[_page(int(rng.integers(_pages(data))))] = bytes(PAGE_BYTES)


def _swapped(data: bytearray, _: Sample, rng: np.random.Generator) -> None:
    a, b = rng.choice(np.arange(1, _pages(data)), 2, replace=False).tolist()
    data[_page(a)], data[_page(b)] = data[_page(b)], data[_page(a)]


def _duplicated(data: bytearray, _: Sample, rng: np.random.Generator) -> None:
    a, b = rng.choice(np.arange(1, _pages(data)), 2, replace=False).tolist()
    data[_page(a)] = data[_page(b)]


def _foreign(data: bytearray, sample: Sample, rng: np.random.Generator) -> None:
    number = int(rng.integers(1, min(_pages(data), _pages(sample.other))))
    data[_page(number)] = sample.other[_page(number)]


def _truncated(data: bytearray, _: Sample, rng: np.random.Generator) -> None:
    del data[int(rng.integers(len(data))) :]


def _missing_pages(data: bytearray, _: Sample, rng: np.random.Generator) -> None:
    del data[int(rng.integers(1, _pages(data))) * PAGE_BYTES :]


DAMAGES: dict[str, Callable[[bytearray, Sample, np.random.Generator], None]] = {
    "flipped bit": _bit,
    "noise": _run,
    "zeroed bytes": _zeroed_run,
    "zeroed page": _zeroed_page,
    "swapped pages": _swapped,
    "duplicated page": _duplicated,
    "page of another environment": _foreign,
    "cut at a byte": _truncated,
    "cut at a page": _missing_pages,
}
OF_LOGS = ("flipped bit", "noise", "zeroed bytes", "cut at a byte")


def damage(sample: Sample, path: Path, rng: np.random.Generator) -> str:
    """Write a damaged copy; returns what was done to it."""
    content = dict(sample.content)
    part = "-wal" if "-wal" in content and rng.random() < 0.5 else ""
    kinds = OF_LOGS if part else tuple(DAMAGES)
    kind = kinds[rng.integers(len(kinds))]
    data = bytearray(content[part])
    while data == content[part]:
        DAMAGES[kind](data, sample, rng)
    content[part] = bytes(data)
    for suffix in ("", "-wal", "-shm"):
        Path(f"{path}{suffix}").unlink(missing_ok=True)
    for suffix, written in content.items():
        Path(f"{path}{suffix}").write_bytes(written)
    return f"{kind}{' of the log' if part else ''}"


# -- what the copy answers -----------------------------------------------------------------


def _reading(sample: Sample, path: Path) -> tuple[str, str]:
    try:
        answer = answers(path)
    except hapticdb.HapticDBError as error:
        return ("told", "") if "\n" not in str(error) else ("traceback", str(error))
    except Exception:  # noqa: BLE001 - that is what is looked for
        return "traceback", traceback.format_exc()
    if answer == sample.truths[-1]:
        return "right", ""
    return ("earlier" if answer in sample.truths else "silent"), ""


def _work(samples: list[Sample], folder: str, pipe: Connection) -> None:
    """Child process: damage and judge case after case."""
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY_BYTES, MEMORY_BYTES))
    path = Path(folder) / "e.db"
    pipe.send(None)
    while (case := pipe.recv()) is not None:
        rng = np.random.default_rng(case)
        sample = samples[int(rng.integers(len(samples)))]
        kind = damage(sample, path, rng)
        # `check` runs before the copy is opened, as for a user who mistrusts the file
        copy = Path(folder) / "checked.db"
        for suffix in ("", "-wal", "-shm"):
            Path(f"{copy}{suffix}").unlink(missing_ok=True)
            if Path(f"{path}{suffix}").exists():
                shutil.copyfile(f"{path}{suffix}", f"{copy}{suffix}")
        pipe.send((kind, sample.name))
        read, words = _reading(sample, path)
        check, more = _checked(copy)
        pipe.send(Outcome(kind, sample.name, read, check, words or more))


def _checked(path: Path) -> tuple[str, str]:
    try:
        report = hapticdb.check_environment(path)
    except hapticdb.HapticDBError:
        return "found", ""
    except Exception:  # noqa: BLE001 - that is what is looked for
        return "traceback", traceback.format_exc()
    return ("sound" if report.is_sound else "found"), ""


def samples_in(folder: Path) -> list[Sample]:
    """Environments of both layouts on all their curves, each without and with a log."""
    return [
        made(folder, layout, curve, in_log=in_log)
        for layout, curve in KINDS
        for in_log in (False, True)
    ]


def outcomes(samples: list[Sample], folder: Path, cases: range, seed: int) -> Iterator[Outcome]:
    """One outcome for each case. After a child that hangs or dies a new child goes on."""
    context = get_context("forkserver")
    left = list(cases)
    while left:
        ours, theirs = context.Pipe()
        child = context.Process(target=_work, args=(samples, str(folder), theirs))
        child.start()
        theirs.close()
        kind = name = ""
        try:
            _received(ours)
            while left:
                ours.send([seed, left[0]])
                kind, name = _received(ours)
                yield _received(ours)
                left.pop(0)
            ours.send(None)
        except TimeoutError:
            yield Outcome(kind, name, "hang", "hang", f"case {left.pop(0)}")
        except EOFError:
            yield Outcome(kind, name, "crash", "crash", f"case {left.pop(0)}")
        finally:
            child.join(5)
            child.kill()
            child.join(5)


def _received(pipe: Connection) -> Any:  # noqa: ANN401 - what the child sent
    if not pipe.poll(LIMIT_S):
        raise TimeoutError
    return pipe.recv()


WRONG = ("silent", "traceback", "hang", "crash")


def is_missed(found: Outcome) -> bool:
    """Whether `check` missed damage. Damage to unused ends of files does not count."""
    may_end = found.damage.startswith("cut") or found.damage.endswith("of the log")
    harmless = found.read == "right" or (found.read == "earlier" and may_end)
    return found.check == "sound" and not (may_end and harmless)
