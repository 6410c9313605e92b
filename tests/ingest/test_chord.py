"""Chord errors stay with the surfaces that they belong to, whatever becomes of the objects."""

from contextlib import closing
from pathlib import Path

import numpy as np
import pytest

import hapticdb
import step_files
from hapticdb import GridOptions, ImportOptions
from hapticdb.check import check_environment
from hapticdb.difference import diff_environments
from hapticdb.ingest.geometry import parts_of
from hapticdb.mesh import Part, parse_in_process
from hapticdb.store.connect import open_store
from servers import Place


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return step_files.cylinder(tmp_path / "a.step", 5.0, 10.0)


def imported(
    url: str | Path, file: Path, chord: float | None = None, *, replace: bool = False
) -> hapticdb.FileReport:
    options = ImportOptions(grid=GridOptions(bits=5), chord=chord, replace=replace)
    (report,) = hapticdb.import_files(url, [file], options)
    return report


def part_in(url: str | Path) -> Part:
    with hapticdb.open(url, read_only=True) as env:
        ((_, part),) = parts_of(env.store, env.objects())
        return part


def test_chord_error_stored_copied_checked(tmp_path: Path, file: Path, place: Place) -> None:
    url, there = tmp_path / "a.db", place()
    (read,) = parse_in_process(file).parts
    report = imported(url, file)
    assert report.chord == read.placed_chord == part_in(url).chord > 0.0
    hapticdb.copy_environment(url, there)
    assert part_in(there).chord == read.chord
    with hapticdb.open(there) as env:
        env.restore(env.remove(1))
        moved = np.diag([1.5, 1.0, 1.0, 1.0])
        moved[:3, 3] = env.object(1).transform[:3, 3]
        env.move(1, moved)
    part = part_in(there)
    assert part.chord == read.chord
    assert part.placed_chord == pytest.approx(1.5 * read.chord)
    assert check_environment(there).is_sound


def test_chord_error_finer_tessellation_replaces(tmp_path: Path, file: Path) -> None:
    url, other = tmp_path / "a.db", tmp_path / "b.db"
    imported(url, file, chord=1e-4)
    hapticdb.copy_environment(url, other)
    coarse = part_in(url)
    with pytest.raises(hapticdb.errors.GeometryChangedError):
        imported(url, file)
    assert part_in(url).chord == coarse.chord
    assert imported(url, file, replace=True).replaced == 1
    fine = part_in(url)
    assert fine.chord < 0.2 * coarse.chord
    assert len(diff_environments(url, other).surfaces) == 1
    with closing(open_store(url)) as store:
        assert store.surface_digests() == {fine.digest}
    assert imported(url, file).status == "complete"
    with hapticdb.open(other) as env:
        report = env.add(file, replace=True, chord=1e-4)
        assert (report.status, report.chord) == ("complete", coarse.chord)
