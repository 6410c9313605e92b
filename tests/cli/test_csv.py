"""Results as CSV: all digits, stable headers, no partial files, nothing else on stdout."""

import csv
import errno
import io
from pathlib import Path

import numpy as np
import pytest

import hapticdb
from command_line import Run, refused, succeeded
from hapticdb.cli.verbs.feeling import FRAMES
from hapticdb.cli.verbs.touching import CONTACTS, TOUCHED
from hapticdb.recording.file import Header, Recording
from hapticdb.recording.frame import FRAME
from hapticdb.tabular.schema import COLUMNS
from hapticdb.tabular.tables import CsvWriter, text_cell
from recordings import write
from voxels import floor_voxels, write_voxels

TOUCH = ("touch", "scene.db", "--tool", "tool.npz", "--poses", "path.csv")


def table(text: str) -> tuple[list[str], list[list[str]]]:
    header, *rows = list(csv.reader(io.StringIO(text, newline="")))
    return header, rows


def columns(keys: tuple[str, ...]) -> list[str]:
    return [name for key in keys for name in COLUMNS.get(key, (key,))]


def touches(folder: Path) -> list[hapticdb.Touch]:
    with hapticdb.open(folder / "scene.db") as env:
        shell = hapticdb.PointShell.load(folder / "tool.npz")
        return [env.touch(shell, pose) for pose in hapticdb.read_poses(folder / "path.csv")]


def test_touch_csv_exact_digits(run: Run, scene: Path) -> None:
    out = succeeded(run(*TOUCH, "--csv", "felt.csv"))
    assert "peak force" in out
    header, rows = table(scene.with_name("felt.csv").read_text())
    assert header == columns(TOUCHED)
    found = touches(scene.parent)
    assert len(rows) == len(found)
    for n, (row, one) in enumerate(zip(rows, found, strict=True)):
        assert row[0] == str(n)
        assert list(map(float, row[1:7])) == [*one.force.tolist(), *one.torque.tolist()]
        assert row[7:9] == [str(len(one.hits)), str(len(one.contacts))]
        assert float(row[9]) == one.depths.max(initial=0.0)
        assert row[10] == " ".join(str(obj.id) for obj in one.objects)
        assert row[11] == "; ".join(obj.name for obj in one.objects)
    code, out, err = run(*TOUCH, "--csv", "-")
    assert (code, err, out) == (0, "", scene.with_name("felt.csv").read_text())
    assert not list(scene.parent.glob(".*"))


def test_touch_contacts_csv_objects(run: Run, scene: Path) -> None:
    out = succeeded(run(*TOUCH, "--contacts-csv", "-"))
    header, rows = table(out)
    assert header == columns(CONTACTS)
    poses = hapticdb.read_poses(scene.with_name("path.csv"))
    shell = hapticdb.PointShell.load(scene.with_name("tool.npz"))
    expected = []
    for n, one in enumerate(touches(scene.parent)):
        depths = dict(zip(one.contacts.tolist(), one.contact_depths.tolist(), strict=True))
        expected += [(n, point, depths[point], i) for point, i in one.contact_pairs.tolist()]
    assert expected
    assert [(int(r[0]), int(r[1]), float(r[5]), int(r[6])) for r in rows] == expected
    for row in rows:
        pose, point = poses[int(row[0])], shell.points[int(row[1])]
        np.testing.assert_allclose(
            list(map(float, row[2:5])), pose[:3, :3] @ point + pose[:3, 3], atol=1e-12
        )


def test_csv_names_escaped(run: Run, scene: Path) -> None:
    names = [
        '=HYPERLINK("x")',
        "+1",
        "-1+2",
        "@SUM(A1)",
        "\tx",
        "a,b",
        'q"q',
        "\x1b[2J",
        "two\nlines",
    ]
    with hapticdb.open(scene) as env:
        for obj in env.objects():
            env.remove(obj.id)
        for name in names:
            write_voxels(env.store, floor_voxels(env.grid), name)
        center = np.array(env.grid.origin) + env.grid.voxel_size * env.grid.side / 2
    x, y, z = center.tolist()
    scene.with_name("path.csv").write_text(f"x,y,z,qw,qx,qy,qz\n{x},{y},{z},1,0,0,0\n")
    out = succeeded(run(*TOUCH, "--contacts-csv", "-"))
    assert "\x1b" not in out
    _, rows = table(out)
    shown = [
        *('\'=HYPERLINK("x")', "'+1", "'-1+2", "'@SUM(A1)", "\\tx", "a,b", 'q"q'),
        *("\\x1b[2J", "two\\nlines"),
    ]
    assert {row[7] for row in rows} == set(shown)
    assert min(float(row[2]) for row in rows) < 0 or x > 0.02  # numbers are not escaped
    assert text_cell("-1") == "'-1"


def frames_of(n: int) -> np.ndarray[tuple[int], np.dtype[np.void]]:
    random = np.random.default_rng(3)
    frames = np.zeros(n, dtype=FRAME)
    for name in FRAME.names or ():
        values = random.normal(size=frames[name].shape) * 10.0 ** random.integers(-9, 9)
        frames[name] = values.astype(frames.dtype[name].base)
    frames["hand"][3, 0] = np.nan  # as when the hand has no valid pose
    return frames


@pytest.fixture
def recording(scene: Path) -> Path:
    path = scene.with_name("felt.hdbrec")
    with hapticdb.open(scene) as env:
        shell = hapticdb.PointShell.load(scene.with_name("tool.npz"))
        header = Header(env.url, env.grid, 1, shell, 1000.0, hapticdb.TangentPlane(), (), {})
    write(path, frames_of(5000), header)
    scene.unlink()  # an export needs no environment
    return path


def test_replay_csv_exact_digits(run: Run, recording: Path) -> None:
    code, out, err = run("replay", "felt.hdbrec", "--csv", "frames.csv")
    assert (code, out, err) == (0, "frames.csv: 5,000 frames\n", "")
    header, rows = table(recording.with_name("frames.csv").read_text())
    assert header == columns(FRAMES)
    at = 0
    for name in FRAMES:
        known = Recording(recording).frames()[name]
        kind = FRAME[name].base
        for column in known.reshape(5000, -1).T:
            read = np.array([row[at] for row in rows]).astype(kind)
            assert read.tobytes() == np.ascontiguousarray(column).tobytes(), header[at]
            at += 1
    assert at == len(header)
    code, out, err = run("replay", "felt.hdbrec", "--csv", "-")
    assert (code, err, out) == (0, "", recording.with_name("frames.csv").read_text())


def test_replay_csv_torn_last_frame(run: Run, recording: Path) -> None:
    recording.write_bytes(recording.read_bytes()[:-100])
    code, out, err = run("replay", "felt.hdbrec", "--csv", "cut.csv")
    assert (code, out) == (0, "cut.csv: 4,999 frames\n")
    assert err.endswith(
        "its last frame is torn, since the recorder was cut off; 236 bytes are left out\n"
    )
    assert len(err.splitlines()) == 1


def test_csv_disk_full_leaves_no_file(
    run: Run, scene: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(_: CsvWriter, __: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(CsvWriter, "write", full)
    refused(run(*TOUCH, "--csv", "felt.csv"), "--csv: cannot write felt.csv: No space left")
    assert not list(scene.parent.glob("*felt.csv*"))


@pytest.mark.parametrize(
    ("args", "words"),
    [
        ([*TOUCH, "--csv", "path.csv"], ["--csv 'path.csv'", "not there yet"]),
        ([*TOUCH, "--contacts-csv", "scene.db"], ["--contacts-csv 'scene.db'", "not there yet"]),
        ([*TOUCH, "--csv", ""], ["--csv", "not there yet"]),
        ([*TOUCH, "--csv", "nowhere/felt.csv"], ["nowhere/felt.csv", "No such file"]),
        (
            [*TOUCH, "--csv", "f.csv", "--contacts-csv", "f.csv"],
            ["--contacts-csv", "another option"],
        ),
        ([*TOUCH, "--csv", "-", "--json"], ["only one may be standard output"]),
        ([*TOUCH, "--csv", "-", "--contacts-csv", "-"], ["only one may be standard output"]),
        (["replay", "felt.hdbrec", "scene.db", "--csv", "-"], ["leave out URL, --json"]),
        (["replay", "felt.hdbrec", "--csv", "f.csv", "--json"], ["leave out URL, --json"]),
        (["touch", "none.db", *TOUCH[2:], "--csv", "-"], ["none.db"]),
    ],
)
def test_csv_bad_arguments_write_nothing(
    run: Run, scene: Path, args: list[str], words: list[str]
) -> None:
    before = {path.name: path.read_bytes() for path in scene.parent.iterdir()}
    result = run(*args)
    refused(result, *words)
    assert result[1] == ""
    assert {path.name: path.read_bytes() for path in scene.parent.iterdir()} == before
