"""The verbs feel and replay as a newcomer uses them, with mistakes and Ctrl-C."""

import json
import os
import re
import resource
import signal
from pathlib import Path

import numpy as np
import pytest

import hapticdb
from children import TIMEOUT, child, descendants, named, until
from command_line import Run, command, on_terminal, refused, succeeded
from hapticdb.cli.session_report import note_cost
from hapticdb.cli.values import size_of
from hapticdb.errors import UsageError
from hapticdb.recording.file import Frames, Recording
from hapticdb.resident.table import is_alive
from hapticdb.session import coupling
from hapticdb.session.processes import fork_server
from hapticdb.transfer import copy_environment
from postgres_servers import serving
from servers import FOUND, SETTINGS

ABOVE = "0,0,0.3"
RANDOM = ("--device", "random", "--at", ABOVE, "--no-baseline")
LEXICOGRAPHIC = ("--curve", "lexicographic", "--layout", "voxel")
PLAY = ("--device", "path.csv", "--rate", 500, "--no-baseline")
OPENED = "hapticdb: felt.hdbrec names scene.db, which is opened\n"
LIMITED = (*PLAY, "--record", "felt.hdbrec", "--record-limit")


def processes() -> set[int]:
    """The processes of sessions that run now."""
    found = filter(is_alive, descendants(os.getpid()))
    return {pid for pid in found if named(pid).startswith("hdb-")}


def feel(*args: object) -> tuple[object, ...]:
    return ("feel", "scene.db", "--tool", "tool.npz", *args)


@pytest.mark.usefixtures("scene")
def test_feel_path_without_times_speed(run: Run) -> None:
    request = feel("--device", "path.csv", "--seconds", 0.2, "--no-baseline")
    out = succeeded(run(*request))
    assert re.search(r"^ *played at +0\.1 m/s: the path has no times", out, re.MULTILINE)
    assert json.loads(run(*request, "--json")[1])["path_speed"] == 0.1
    assert json.loads(run(*request, "--json", "--speed", 0.2)[1])["path_speed"] is None


def test_feel_recorded_then_replayed(run: Run, scene: Path) -> None:
    """A replay reports a difference once an object has moved."""
    out = succeeded(run(*feel(*PLAY, "--speed", 0.5, "--record", "felt.hdbrec")))
    lines = [line.strip() for line in out.splitlines()]
    rows = dict(re.split(r"  +", line, maxsplit=1) for line in lines if "  " in line)
    recording = Recording(scene.with_name("felt.hdbrec"))
    n_frames = len(recording)
    assert rows["frames"].split()[0] == f"{n_frames:,}"
    assert rows["recorded"] == f"{n_frames:,} frames in felt.hdbrec"
    # it starts too near to box0 to feel it; whether it does when it comes free depends on its way
    assert re.fullmatch(r"(1 touched: box1|2 touched: box0, box1)", rows["objects"])
    assert rows["resident"].endswith("in 256 MiB")
    assert "outages" not in rows
    assert max(map(len, out.splitlines())) <= 100
    assert processes() == set()

    code, out, err = run("replay", "felt.hdbrec")
    assert (code, err) == (0, OPENED)
    assert out.startswith("equal: ")
    code, out, _ = run("replay", "felt.hdbrec", "scene.db", "--json")
    replayed = json.loads(out)
    assert (code, replayed["differing"], replayed["parting"]) == (0, 0, None)
    assert replayed["frames"] == n_frames

    again = feel("--device", "felt.hdbrec", "--rate", 500, "--json", "--budget", 8, "--scale", 1.0)
    report = json.loads(succeeded(run(*again)))
    assert report["hit_frames"] > 0
    assert report["touched"]
    assert report["cache"]["budget_bytes"] <= 8 << 20
    loop, end = report["loop"], recording.poses()[0][-1]
    assert 0.9 * end <= loop["seconds"] <= 1.1 * end + loop["lateness"]["worst"]

    assert run("move", "scene.db", 1, "--translate", "0,0,0.05")[0] == 0
    code, out, err = run("replay", "felt.hdbrec")
    assert (code, err) == (1, OPENED)
    parted = re.match(r"parts at frame (\d+) \(\d+\.\d{3} s\)", out)
    assert parted
    code, out, _ = run("replay", "felt.hdbrec", "--json")
    again = json.loads(out)
    assert (code, again["parting"]["frame"]) == (1, int(parted[1]))
    assert again["parting"]["reason"].startswith("since the environment was edited: revision ")


@pytest.mark.parametrize(
    ("n_points", "rate", "has_distances", "told"),
    [
        (300, 1000.0, True, ""),
        (20_000, 1000.0, True, "20,000 points near a surface takes about 12 ms"),
        (300, 20_000.0, False, ""),
        (20_000, 5000.0, False, "takes about 1 ms, and 5,000 Hz leave 0.2 ms"),
    ],
)
def test_note_cost_large_tool(
    n_points: int, rate: float, has_distances: bool, told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    note_cost(n_points, rate, reads_distances=has_distances)
    said = capsys.readouterr().err
    assert told in said
    assert len(said.splitlines()) == bool(told)


@pytest.mark.usefixtures("scene")
def test_feel_terminal_shows_progress() -> None:
    request = feel("--device", "path.csv", "--rate", 200, "--seconds", 0.6)
    shown = on_terminal(*request)
    for doing in ("loading", "sampling the tool", "measuring an empty loop", "feeling; Ctrl-C"):
        assert doing in shown
    assert re.search(r"^ *took +[\d.]+ s in all\r?$", shown, re.MULTILINE)


@pytest.mark.usefixtures("scene")
def test_feel_simulated_device(run: Run) -> None:
    args = ("--device", "random", "--at", "0,0,0.05", "--seconds", 0.5, "--simulate", "--seed", 2)
    report = json.loads(succeeded(run(*feel(*args, "--rate", 200, "--no-baseline", "--json"))))
    assert report["unknown_frames"] == 0
    assert report["held_frames"] == report["stale_frames"]


@pytest.mark.usefixtures("scene")
@pytest.mark.parametrize(
    ("args", "words"),
    [
        (["--device", "joystick"], ["--device 'joystick'", ".csv", "random"]),
        (["--device", "nowhere.csv"], ["nowhere.csv"]),
        (["--device", "nowhere.hdbrec"], ["no recording at nowhere.hdbrec"]),
        (["--device", "random"], ["give --at"]),
        (
            ["--device", "random", "--at", "here"],
            ["'--at': 'here'", "metres, or such as 0,5,0.2in"],
        ),
        (["--device", "path.csv", "--speed", 0], ["speed", "positive"]),
        (["--device", "haply", "--speed", 1], ["--speed", "with --device haply"]),
        (["--device", "felt.hdbrec", "--speed", 1], ["--speed", "with --device felt.hdbrec"]),
        (["--device", "random", "--at", ABOVE, "--loop"], ["--loop", "with --device random"]),
        ([*PLAY, "--processor", 10**30], ["processor 1e+30 is not granted", "may run on"]),
        ([*PLAY, "--rate", 5], ["a rate of 5.0 Hz: give 10 to 20,000"]),
        ([*PLAY, "--seconds", -1], ["-1.0 seconds"]),
        ([*PLAY, "--scale", 0], ["a scale of 0.0"]),
        (["--device", "random", "--at", ABOVE, "--seed", -1], ["--seed -1: give 0 or more"]),
        ([*PLAY, "--clutch", 40], ["button 40", "0 to 30"]),
        ([*PLAY, "--budget", 0.5], ["--budget", "'0.5': give MiB"]),
        ([*PLAY, "--stiffness", 1e300], ["stiffness of 1e+300 N/m", "above 0, up to 1e+09"]),
        ([*PLAY, "--law", "plane", "--rendering", "coupled"], ["coupled needs the law distance"]),
        ([*PLAY, "--rendering", "direct", "--delay", 5], ["--delay", "with --rendering direct"]),
        ([*PLAY, "--exclude", "nobody"], ["--exclude", "nobody"]),
        ([*PLAY, "--record", "nowhere/felt.hdbrec"], ["nowhere/felt.hdbrec"]),
        ([*PLAY, "--record", "tool.npz"], ["tool.npz is there already", "--replace"]),
        ([*PLAY, "--record", "tool.npz", "--replace"], ["tool.npz is no recording"]),
        ([*PLAY, "--replace"], ["--replace", "without --record"]),
        ([*LIMITED, "0"], ["--record-limit", "'0': give MiB, 1 to a million, or such as 4GiB"]),
        ([*LIMITED, "nan"], ["--record-limit", "'nan': give MiB"]),
        ([*LIMITED, "4 parsecs"], ["--record-limit", "'4 parsecs': give MiB"]),
    ],
)
def test_feel_bad_arguments_leave_no_process(
    run: Run, args: list[object], words: list[str]
) -> None:
    refused(run(*feel(*args)), *words)
    assert processes() == set()


def test_feel_starts_fork_server_first(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    done: list[str] = []

    def refuse(*_: object) -> None:
        done.append("options")
        raise UsageError("enough is seen")

    monkeypatch.setattr(fork_server, "prepare", lambda work, **_: done.append(work))
    monkeypatch.setattr(coupling, "rendering_of", refuse)
    refused(run(*feel(*PLAY)), "enough is seen")
    assert done == [
        "hapticdb.session.worker:work", "hapticdb.session.prefetch.fetching:fetch", "options"
    ]  # fmt: skip


def test_feel_missing_environment_or_tool(run: Run, scene: Path) -> None:
    path = scene.with_name("path.csv")
    missing = run("feel", "nowhere.db", "--tool", "tool.npz", *PLAY)
    refused(missing, "nowhere.db", "hapticdb import")
    refused(run("feel", "scene.db", "--tool", "path.csv", *PLAY), "path.csv")
    refused(run("feel", "scene.db", "--tool", "nowhere.stl", *PLAY), "nowhere.stl")
    refused(run("feel", path, "--tool", "tool.npz", *PLAY), "path.csv")
    assert run("copy", "scene.db", "lexical.db", *LEXICOGRAPHIC)[0] == 0
    refused(run("feel", "lexical.db", "--tool", "tool.npz", *PLAY), "lexicographic", "--curve z")


def test_feel_record_replace(run: Run, scene: Path) -> None:
    path = scene.with_name("felt.hdbrec")
    args = (*feel(*PLAY, "--seconds", 0.2), "--record", path)
    assert run(*args)[0] == 0
    first = recorded(path)
    refused(run(*args), "is there already", "--replace")
    refused(run(*args, "--replace", "--processor", 4095), "processor 4095")
    assert recorded(path).tobytes() == first.tobytes()
    assert run(*args, "--replace")[0] == 0
    assert recorded(path)[:1].tobytes() != first[:1].tobytes()


def test_feel_reports_lost_database(
    scene: Path,
) -> None:
    args = feel(*RANDOM, "--seconds", 2, "--record", "s.hdbrec", "--json")
    with child(command(*args), cwd=scene.parent) as process:
        until(lambda: frames_in(scene.with_name("s.hdbrec")))
        scene.unlink()
        assert process.stderr is not None
        line = process.stderr.readline()
        assert process.poll() is None
        out, err = process.communicate(timeout=TIMEOUT)
    lost = json.loads(out)["database_lost"]
    assert (process.returncode, err) == (1, "")
    assert lost.startswith("scene.db cannot be reached any more ")
    silent = "scene.db does not answer"  # on a busy machine, before the reason is known
    assert line in {f"hapticdb: {text}; until then no force is felt\n" for text in (lost, silent)}


@pytest.mark.long
def test_feel_hanging_server_ends_session(scene: Path, tmp_path: Path) -> None:
    """The server is stopped with a session's connection open, until the session has ended."""
    with serving(tmp_path / "pg", FOUND[0], SETTINGS) as server:
        url = server.conninfo() + "&environment=scene"
        copy_environment(str(scene), url)
        device = (*RANDOM, "--seconds", 4, "--record", "s.hdbrec")
        words = ("feel", url, "--tool", "tool.npz", *device, "--json")
        with child(command(*words), cwd=scene.parent) as process:
            until(lambda: frames_in(scene.with_name("s.hdbrec")))
            family = [server.pid, *descendants(server.pid)]
            for member in family:
                os.kill(member, signal.SIGSTOP)
            try:
                out, err = process.communicate(timeout=TIMEOUT)
            finally:
                for member in family:
                    os.kill(member, signal.SIGCONT)
    report = json.loads(out)
    assert process.returncode == 1
    assert "did not answer a new client" in report["database_lost"]
    assert 0 < report["stale_frames"] <= report["held_frames"] < report["loop"]["frames"]
    assert err == f"hapticdb: {report['database_lost']}; until then no force is felt\n"


@pytest.mark.long
def test_feel_continues_without_recording_on_disk_error(scene: Path) -> None:
    args = feel(*RANDOM, "--rate", 5000, "--record", "cut.hdbrec")
    path = scene.with_name("cut.hdbrec")
    with child(command(*args, "--json"), cwd=scene.parent) as process:
        until(lambda: frames_in(path))
        most = path.stat().st_size + 100_000
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (most, most))
        assert process.stderr is not None
        told = process.stderr.readline()
        process.send_signal(signal.SIGTERM)
        out, _ = process.communicate(timeout=TIMEOUT)
    report = json.loads(out)
    n_frames = len(recorded(path))
    assert report["recording_ended"] == (
        f"cannot write cut.hdbrec: File too large; its first {n_frames} frames are whole"
    )
    assert told == f"hapticdb: {report['recording_ended']}; the session goes on without it\n"
    assert 0 < n_frames == report["recorded_frames"] < report["loop"]["frames"]


@pytest.mark.parametrize(
    ("text", "n_bytes"), [("1", 1 << 20), ("1.5 GiB", 3 << 29), ("4g", 4 << 30)]
)
def test_size_of_units(text: str, n_bytes: int) -> None:
    assert size_of(text) == n_bytes


def recorded(path: Path) -> Frames:
    return np.array(Recording(path).frames())


def frames_in(path: Path) -> bool:
    """Whether a recording has at least one frame."""
    try:
        return len(Recording(path)) > 0
    except hapticdb.errors.HapticDBError:
        return False


@pytest.mark.parametrize(
    ("number", "code", "words"), [(signal.SIGINT, 130, "Ctrl-C"), (signal.SIGTERM, 143, "SIGTERM")]
)
def test_feel_signal_ends_with_report(
    scene: Path, number: signal.Signals, code: int, words: str
) -> None:
    """Its recording then has every frame."""
    args = feel(*RANDOM, "--rate", 5000, "--record", "cut.hdbrec")
    with child(command(*args, "--json"), cwd=scene.parent) as process:

        def is_recording() -> bool:
            assert process.poll() is None
            return frames_in(scene.with_name("cut.hdbrec"))

        until(is_recording, every=0.05)
        started = descendants(process.pid)
        process.send_signal(number)
        out, err = process.communicate(timeout=TIMEOUT)
    assert process.returncode == code
    assert re.fullmatch(rf"hapticdb: ended by {words} after [\d.]+ s\n", err)
    report = json.loads(out)
    frames = recorded(scene.with_name("cut.hdbrec"))
    assert len(frames) == report["loop"]["frames"] == report["recorded_frames"]
    np.testing.assert_allclose(np.diff(frames["time"]), frames["dt"][1:], atol=1e-9)
    assert len(started) == 3  # the fork server, the loop, and what fetches for it
    assert not any(map(is_alive, started))


def test_feel_ctrl_c_before_first_frame(scene: Path) -> None:
    args = feel(*RANDOM)
    with child(command(*args), cwd=scene.parent) as process:
        until(lambda: descendants(process.pid), every=0.002)
        started = descendants(process.pid)
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=TIMEOUT)
    assert process.returncode == 130
    if out:  # it was quicker than the signal
        assert "hapticdb: ended by Ctrl-C" in err
    else:
        assert "hapticdb: interrupted" in err.splitlines()
    until(lambda: not any(map(is_alive, started)))


def test_feel_sigterm_before_first_frame(scene: Path) -> None:
    args = feel(*RANDOM, "--record", "never.hdbrec")
    path = scene.with_name("never.hdbrec")
    with child(command(*args), cwd=scene.parent) as process:
        until(path.exists, every=0.002)
        process.send_signal(signal.SIGTERM)
        out, err = process.communicate(timeout=TIMEOUT)
    assert process.returncode == 143
    if out:  # it was quicker than the signal
        assert len(recorded(path))
    else:
        assert (err, path.exists()) == ("", False)
