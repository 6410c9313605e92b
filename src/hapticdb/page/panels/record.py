"""Tab Record: recording of the session, and replay on a time slider."""

import time
from datetime import UTC, datetime
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from viser import GuiApi, GuiEvent

from hapticdb.errors import FileError, UsageError
from hapticdb.page import checks, colours
from hapticdb.page.browser import Browser, put
from hapticdb.page.drawing import add_arrow, put_at
from hapticdb.page.site import checked_file
from hapticdb.page.wording import note_html, rows_html
from hapticdb.recording.file import Recording

Floats = NDArray[np.float64]

SUFFIX = ".hdbrec"
MOST_LISTED = 200
"""Greatest number of listed recordings, the newest."""
LONGEST_REPLAY = 1_000_000
"""Greatest length of a replay, frames: 17 minutes at 1 kHz. Larger: more memory."""
NOTHING = "(none)"


class Replay(NamedTuple):
    """Frames of a replay: times (M,), s; tools (M, 7); wrenches (M, 6), N and N m."""

    times: Floats
    tools: Floats
    wrenches: Floats

    @property
    def end(self) -> float:
        """Time of the last frame, seconds."""
        return float(self.times[-1])


class RecordPanel:
    """Recording of this browser's session into the operator's folder, and replay from it."""

    def __init__(self, browser: Browser, gui: GuiApi) -> None:
        self._browser = browser
        self._replay: Replay | None = None
        self._drawn: list[Any] = []
        self._played_from: tuple[float, float] | None = None
        self._is_recording = False
        guard = browser.guarded
        has_folder = browser.site.recordings is not None
        may_touch = browser.visitor.may("toucher")
        self._record = gui.add_button("Record", visible=has_folder and may_touch, color="red")
        self._record.on_click(guard("toucher", self._record_or_stop))
        self._state = gui.add_html(
            "" if has_folder else note_html("The operator gave no folder for recordings.")
        )
        with gui.add_folder("Replay", visible=has_folder):
            self._list = gui.add_dropdown("Recording", (NOTHING, *self._names()))
            self._list.on_update(guard("viewer", self._choose))
            self._time = gui.add_slider("Time, s", 0.0, 1.0, 0.01, 0.0, visible=False)
            self._time.on_update(guard("viewer", self._slide))
            self._play = gui.add_button("Play", visible=False)
            self._play.on_click(guard("viewer", self._play_or_pause))
            self._said = gui.add_html("")

    def _names(self) -> list[str]:
        """Names of the recordings in the folder, the newest first."""
        folder = self._browser.site.recordings
        if folder is None:
            return []
        try:
            found = [path for path in folder.iterdir() if path.suffix == SUFFIX and path.is_file()]
            found.sort(key=lambda path: path.stat().st_mtime, reverse=True)
            return [path.name for path in found[:MOST_LISTED]]
        except OSError:
            return []

    def _record_or_stop(self, _: object) -> None:
        browser = self._browser
        session = browser.session
        if session is None:
            raise UsageError("there is no tool to record yet: wait a moment")
        if self._is_recording:
            self._stopped(f"Recorded {session.stop_recording():,} frames.")
            return
        at = datetime.now(UTC).strftime("%Y-%m-%d_%H-%M-%S")
        path = checked_file(browser.site.recordings, f"{at}_{browser.number}{SUFFIX}")
        session.record(path)
        self._is_recording = True
        self._record.label = "Stop"
        self._state.content = note_html(f"Records {path.name}")

    def session_ended(self) -> None:
        """Report the end of a recording by the end of its session."""
        if self._is_recording:
            self._stopped("The recording ended: the session began anew.")

    def _stopped(self, said: str) -> None:
        self._is_recording = False
        self._record.label = "Record"
        self._state.content = note_html(said)
        self._list.options = (NOTHING, *self._names())

    def _choose(self, event: GuiEvent[Any]) -> None:
        name = checks.choice_of(event.target.value, (NOTHING, *self._names()), "a recording")
        for node in self._drawn:
            node.remove()
        self._drawn, self._replay, self._played_from = [], None, None
        is_chosen = name != NOTHING
        self._time.visible = self._play.visible = is_chosen
        self._said.content = ""
        if not is_chosen:
            return
        recording = Recording(checked_file(self._browser.site.recordings, name))
        if not 0 < len(recording) <= LONGEST_REPLAY:
            raise FileError(f"{name}: {len(recording):,} frames; 1 to {LONGEST_REPLAY:,} are shown")
        frames = recording.frames()
        times, poses, wrenches = (np.array(frames[x]) for x in ("time", "tool", "applied"))
        self._replay = Replay(times - times[0], poses, wrenches)
        self._draw(recording)
        put(self._time, 0.0)
        self._time.max = max(round(self._replay.end, 2), 0.01)
        self._show_at(0.0)

    def _draw(self, recording: Recording) -> None:
        scene, size = self._browser.client.scene, self._browser.site.facts.diagonal
        middle = self._browser.drawing.middle
        shell = recording.header.shell
        assert self._replay is not None  # noqa: S101 - just read
        track = self._replay.tools[:: max(1, len(self._replay.tools) // 500), :3]
        cloud = scene.add_point_cloud(
            "/replay", shell.outline, colours.TORQUE, point_size=0.004 * size,
            point_shape="circle", precision="float32",
        )  # fmt: skip
        self._drawn = [cloud, add_arrow(scene, "/replay_force", colours.FORCE, 0.01 * size, middle)]
        if len(track) > 1:
            segments = np.stack([track[:-1], track[1:]], axis=1) - middle
            way = scene.add_line_segments(
                "/replay_way", segments, colours.TORQUE, thickness=2.0, thickness_units="screen",
                position=middle,
            )  # fmt: skip
            self._drawn.append(way)

    def _slide(self, event: GuiEvent[Any]) -> None:
        if event.client is None or self._replay is None:
            return
        at = checks.number_of(event.target.value, 0.0, self._replay.end + 0.01, "a time")
        self._pause()
        self._show_at(at)

    def _pause(self) -> None:
        self._played_from = None
        self._play.label = "Play"

    def _play_or_pause(self, _: object) -> None:
        if self._played_from is not None:
            self._pause()
            return
        at = float(self._time.value)
        if self._replay is not None and at >= self._replay.end - 0.02:
            at = 0.0
        self._played_from = (time.monotonic(), at)
        self._play.label = "Pause"

    def tick(self, now: float) -> None:
        """Advance the replay; called by the page's clock."""
        if self._played_from is None or self._replay is None:
            return
        begun, at = self._played_from
        at = min(at + now - begun, self._replay.end)
        if at == self._replay.end:
            self._pause()
        put(self._time, round(at, 2))
        self._show_at(at)

    def _show_at(self, at: float) -> None:
        replay = self._replay
        if replay is None or not self._drawn:
            return
        n = min(int(np.searchsorted(replay.times, at)), len(replay.times) - 1)
        tool, wrench = replay.tools[n], replay.wrenches[n]
        cloud, arrow = self._drawn[:2]
        put_at(cloud, tool)
        drawing = self._browser.drawing
        drawing.point(arrow, tool[:3], wrench[:3])
        force = float(np.linalg.norm(wrench[:3]))
        self._said.content = rows_html(
            (("Time", f"{replay.times[n]:.2f} s"), ("Force", f"{force:.2f} N"))
        )
