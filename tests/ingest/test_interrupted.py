"""An import interrupted at any moment leaves a valid database, and can be run again."""

import os
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from subprocess import Popen

import numpy as np
import pytest

import hapticdb
from assemblies import Mesh, Rows, ball, left_behind, rows_of, small_options, write_obj
from children import TIMEOUT, child, until
from hapticdb import GridOptions, ImportOptions
from hapticdb.ingest.files import ImportProgress
from hapticdb.resident.table import is_alive
from hapticdb.store.sqlite.tables.file_tables import FileTables

N_PARTS = 60

IMPORT = """
import sys, time
import hapticdb
from hapticdb import GridOptions, ImportOptions

database, file, jobs = sys.argv[1:]
options = ImportOptions(grid=GridOptions(bits=8), layout="voxel", jobs=int(jobs))

def say(progress):
    print(progress.parts_done, flush=True)
    if progress.parts_done == progress.parts_total - 1:
        time.sleep(600)

print(0, flush=True)
hapticdb.import_files(database, [file], options, say)
"""


def big_options(jobs: int) -> ImportOptions:
    """Options of the child's import."""
    return ImportOptions(grid=GridOptions(bits=8), layout="voxel", jobs=jobs)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A file of sixty balls, each of about 4,000 voxels, and an undisturbed import of it."""
    made = tmp_path_factory.mktemp("undisturbed")
    rng = np.random.default_rng(3)
    parts: dict[str, Mesh] = {}
    for n in range(N_PARTS):
        parts[f"ball {n}"] = ball(rng.uniform(-0.3, 0.3, 3), 0.07, 16)
    file = write_obj(made / "balls.obj", parts)
    hapticdb.import_files(made / "whole.db", [file], big_options(2))
    return made


@pytest.fixture(scope="module")
def undisturbed(folder: Path) -> Rows:
    return rows_of(folder / "whole.db")


@contextmanager
def importing(database: Path, file: Path, jobs: int = 2) -> Iterator["Popen[str]"]:
    """A process that imports; it is ended after the test."""
    with child([sys.executable, "-c", IMPORT, str(database), str(file), str(jobs)]) as process:
        yield process
        process.kill()


def wait_for(process: "Popen[str]", n_parts: int) -> None:
    """Wait until that many parts are committed."""
    assert process.stdout is not None
    for line in process.stdout:
        if int(line) >= n_parts:
            return
    assert process.stderr is not None
    pytest.fail(f"the import ended before {n_parts} parts: {process.stderr.read()}")


def assert_finishes(database: Path, file: Path, undisturbed: Rows, jobs: int = 1) -> None:
    (report,) = hapticdb.import_files(database, [file], big_options(jobs))
    assert report.present + len(report.added) == N_PARTS
    assert left_behind(database.parent) == ["e.db"]
    assert rows_of(database) == undisturbed


@pytest.mark.parametrize("is_there", [False, True])
def test_import_killed_before_first_object(
    folder: Path, undisturbed: Rows, tmp_path: Path, is_there: bool
) -> None:
    database = tmp_path / "e.db"
    with importing(database, folder / "balls.obj") as process:
        wait_for(process, 0)
        if is_there:
            until(lambda: left_behind(tmp_path), every=0.0005)
        process.kill()
        process.wait(TIMEOUT)
    if database.exists():
        assert len(rows_of(database, "object")["object"]) <= 3
    assert_finishes(database, folder / "balls.obj", undisturbed)


def test_import_interrupted_then_repeated_equals_undisturbed(
    folder: Path, undisturbed: Rows, tmp_path: Path
) -> None:
    """Ctrl-C: the process ends soon, by the signal, and folds the log into the file."""
    database = tmp_path / "e.db"
    with importing(database, folder / "balls.obj") as process:
        wait_for(process, 7)
        process.send_signal(signal.SIGINT)
        _, words = process.communicate(timeout=TIMEOUT)
        assert process.returncode == -signal.SIGINT
    assert words.strip().endswith("KeyboardInterrupt")
    assert left_behind(tmp_path) == ["e.db"]
    assert 7 <= len(rows_of(database, "object")["object"]) < N_PARTS
    assert_finishes(database, folder / "balls.obj", undisturbed)


def test_import_interrupted_while_parsing(folder: Path, tmp_path: Path) -> None:
    """The process that parses ends with the one that is interrupted."""
    with importing(tmp_path / "e.db", folder / "balls.obj") as process:
        wait_for(process, 0)
        parser = wait_for_parser(process.pid)
        process.send_signal(signal.SIGINT)
        process.communicate(timeout=TIMEOUT)
        assert process.returncode == -signal.SIGINT
    assert left_behind(tmp_path) == []
    until(lambda: not is_alive(parser))


ENDLESS = """
import os, sys, time
import hapticdb.kernels.surfaces.voxelize as voxelize
from hapticdb.__main__ import main

def endless(*given, real=voxelize.voxelize_pieces):
    _, *bricks = next(real(*given))
    os.write(1, b"begun\\n")  # whole lines, though two threads begin at once
    while True:
        time.sleep(0.001)
        yield 0.5, *bricks

voxelize.voxelize_pieces = endless
sys.exit(main())
"""
"""A program: the command line, where no part ever comes to its last piece."""


@pytest.mark.parametrize(
    ("number", "code", "words"),
    [
        (signal.SIGINT, 130, "hapticdb: interrupted; what went in is whole, and the same command"),
        (signal.SIGTERM, 143, ""),
    ],
)
def test_import_signal_inside_a_part(
    folder: Path, tmp_path: Path, number: signal.Signals, code: int, words: str
) -> None:
    command = [sys.executable, "-c", ENDLESS, "import", str(tmp_path / "e.db")]
    scratch = tmp_path / "scratch"
    scratch.mkdir()
    env = os.environ | {"TMPDIR": str(scratch)}
    with child([*command, str(folder / "balls.obj")], env=env) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "begun\n"
        process.send_signal(number)
        _, told = process.communicate(timeout=TIMEOUT)
    assert process.returncode == code
    assert told.count("\n") == bool(words)
    assert told.startswith(words)
    assert left_behind(tmp_path) == ["scratch"]
    assert left_behind(scratch) == []


def wait_for_parser(pid: int) -> int:
    """Process id of the child of a child, once it is there."""
    children = Path(f"/proc/{pid}/task/{pid}/children")
    until(children.read_text, every=0.001)
    return int(children.read_text().split()[0])


def test_import_files_error_in_progress_callback(folder: Path, tmp_path: Path) -> None:
    class StoppedError(Exception):
        pass

    def stop(progress: ImportProgress) -> None:
        if progress.parts_done == 4:
            raise StoppedError

    database = tmp_path / "e.db"
    with pytest.raises(StoppedError):
        hapticdb.import_files(database, [folder / "balls.obj"], big_options(2), stop)
    assert left_behind(tmp_path) == ["e.db"]
    assert len(rows_of(database, "object")["object"]) == 4


def test_import_files_interrupted_then_later_file(
    tmp_path: Path,
) -> None:
    files = [
        write_obj(tmp_path / f"{n}.obj", {f"ball {n}": ball((0, 0, 0.01 * n), 0.05)})
        for n in range(4)
    ]
    hapticdb.import_files(tmp_path / "whole.db", files, small_options())

    def stop(progress: ImportProgress) -> None:
        if progress.link.endswith("2.obj"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        hapticdb.import_files(tmp_path / "e.db", files, small_options(), stop)
    reports = hapticdb.import_files(tmp_path / "e.db", files, small_options())
    assert [r.status for r in reports] == ["complete", "complete", "complete", "imported"]
    assert rows_of(tmp_path / "e.db") == rows_of(tmp_path / "whole.db")


def test_import_files_interrupted_before_statistics(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Interrupted after the last object, before the quantile vector: run again, it writes it."""
    file = write_obj(tmp_path / "ball.obj", {"ball": ball((0, 0, 0), 0.1)})
    hapticdb.import_files(tmp_path / "whole.db", [file], small_options())

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(FileTables, "analyze", interrupted)
        with pytest.raises(KeyboardInterrupt):
            hapticdb.import_files(tmp_path / "e.db", [file], small_options())
    (report,) = hapticdb.import_files(tmp_path / "e.db", [file], small_options())
    assert report.status == "complete"
    assert rows_of(tmp_path / "e.db") == rows_of(tmp_path / "whole.db")
