"""Session: one device in an environment, with processes of its own."""

import os
import time
from contextlib import ExitStack, suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from hapticdb.closing import Closes
from hapticdb.devices.handle import Handle
from hapticdb.devices.profiles import profile_of
from hapticdb.devices.protocol import Device, check_device
from hapticdb.errors import DeviceError, HapticDBError, UsageError
from hapticdb.pointshell.shell import PointShell
from hapticdb.query.law import DISTANCE, ForceLaw, LawName, as_law, reads_distances
from hapticdb.recording.file import DEFAULT_LIMIT, Recorder
from hapticdb.recording.frame import Frames, State
from hapticdb.session.coupling import Coupling, Rendering, radius_of, rendering_of
from hapticdb.session.device_loop import DeviceRequest
from hapticdb.session.prefetch.resident_cells import ResidentCells, without_distances
from hapticdb.session.report import LoopAnswer, Report, counts_of
from hapticdb.session.running import Running
from hapticdb.session.shared_table import SharedTable
from hapticdb.session.states import FOREVER
from hapticdb.session.supervisor import POLL_EVERY, Supervisor
from hapticdb.session.timing import Timing
from hapticdb.session.worker import WorkerProcess, WorkerRequest

if TYPE_CHECKING:
    from hapticdb.batches.batch_tool import BatchDevice

RING_SECONDS = 4.0
"""Seconds of frames in the ring until they are recorded. Larger: longer pauses of this process lose
no frame, at more memory."""
LEAST_RING = 1024
"""Least number of frames in the ring, however low the rate."""
END_TIMEOUT = 10.0
"""Seconds from a request until the report must have come; normally one frame."""
DEFAULT_STALENESS = 1.0
"""Default of `staleness`, seconds without an answer of the database."""


class Session(Closes):
    """A hand in an environment, in real time.

    The loop and the fetching of its cells run in two separate processes. This object starts and
    supervises them, records, and reports. Also a context manager.

    Parameters
    ----------
    cells : ResidentCells or str
        The environment: its resident cells, shared by several sessions, or its URL. With a
        URL all objects are felt, and cells take the default budget.
    shell : PointShell
        The tool.
    device : Device
        The device; it is sent to the worker process, so its class must be importable there.
    rate : float
        Frames a second, 10 to 20,000.
    seconds : float or None
        Duration; None: until the device's script ends or `stop` is called.
    law : {"plane", "distance"}, ForceLaw or None
        Force law of a frame. None: ``distance``, which needs distances to surfaces.
    rendering : {"coupled", "direct"} or None
        ``coupled``: a virtual coupling with contact constraints, which needs distances. ``direct``:
        the tool is at the hand, and the wrench of each frame goes to the device, up to its caps.
        None: coupled under the law ``distance``, direct under every other one.
    coupling : Coupling or None
        Coupling between hand and tool. Its stiffness is lowered to what the device holds: see
        `coupling.lowered`. Rendered directly, it gives caps alone.
    handle : Handle or None
        Mapping of the hand to the scene: scale and clutch.
    staleness : float
        Seconds without an answer of the database after which all frames act as if all cells were
        unknown.
    frames_on : {"cpu", "cuda"}
        What finds the tool's points near surfaces in each period: a processor, or a GPU of NVIDIA
        for tools of millions of points (docs/realtime.md, Large tools).
    record : path or None
        A file for the recording; see `hapticdb.recording.file.Recorder`.
    replace_recording : bool
        Replace an existing recording when the first frame is recorded.
    record_limit_bytes : int or None
        Greatest size of the recording, 4 GiB unless given; None: no limit of its own. 64 MiB of the
        disk always stay free. At the limit, or if the disk fails, the recording ends and stays
        whole, and the session continues: see `recording_ended`.
    processor : int or None
        Number of the processor that the loop is bound to.
    has_baseline : bool
        Run an empty loop at the same rate before the first frame, for 2 s at most, to report the
        machine's own lateness; if False, `Report.empty` is None.

    Raises
    ------
    UsageError
        If a number is out of its range, options contradict one another, or `device` is no device.
    DeviceError
        If the device fails, or its reading is of the wrong kind; here or in `wait`.
    DatabaseError
        If the environment cannot be opened.
    """

    _pid = 0
    """Id of the process of this object. In a forked copy `close` does nothing."""

    def __init__(
        self,
        cells: ResidentCells | str,
        shell: PointShell,
        device: Device,
        *,
        rate: float = 1000.0,
        seconds: float | None = None,
        law: ForceLaw | LawName | None = None,
        rendering: Rendering | None = None,
        coupling: Coupling | None = None,
        handle: Handle | None = None,
        staleness: float = DEFAULT_STALENESS,
        frames_on: "BatchDevice" = "cpu",
        record: str | os.PathLike[str] | None = None,
        replace_recording: bool = False,
        record_limit_bytes: int | None = DEFAULT_LIMIT,
        processor: int | None = None,
        has_baseline: bool = True,
    ) -> None:
        check_device(device)
        self._device = device
        _check_choices(seconds, staleness)
        self._has_baseline = has_baseline
        self.shell, self.handle = shell, handle or Handle()
        self.law = as_law(law) or DISTANCE
        self.rendering = rendering_of(rendering, self.law)
        self.frames_on = _checked_frames(frames_on, self.rendering)
        self.timing = Timing(rate, processor)
        self._owns_cells = isinstance(cells, str)
        if isinstance(cells, str):
            cells = ResidentCells(cells, distances=None if law is None else reads_distances(law))
        elif cells.is_closed:
            raise UsageError("these cells are closed: make others")
        self.cells = cells
        self._check_distances(law)
        self.coupling = (coupling or Coupling()).of_session(
            self.rendering, profile_of(device), rate, self.handle.scale,
            radius_of(shell, cells.grid.voxel_size),
        )  # fmt: skip
        # from here on `close` ends what was begun
        self._pid = os.getpid()
        self._supervisor: Supervisor | None = None
        self._running: _DeviceSession | None = None
        self._report: Report | None = None
        self._recording: Recorder | None = None
        if record is not None:
            self._recording = Recorder(
                record, limit_bytes=record_limit_bytes, replace=replace_recording
            )
        try:
            self._begin(device, staleness, seconds)
        except BaseException:
            try:
                if self._recording is not None:
                    self._recording.discard()
            finally:  # even if a second signal interrupts that
                self.close()
            raise

    def _check_distances(self, requested: ForceLaw | LawName | None) -> None:
        if not reads_distances(self.law) or self.cells.has_distances:
            return
        if requested is None:
            instead = "feel tangent planes directly with --law plane"
            raise UsageError(without_distances(self.cells.url, instead))
        raise UsageError(
            "the law distance needs cells with distances to surfaces, and these have none: make "
            "ResidentCells(..., distances=True), or give law='plane'"
        )

    def _begin(self, device: Device, staleness: float, seconds: float | None) -> None:
        if self._recording is not None:
            # first: an existing file is refused before the worker starts
            self._recording.open()
        shared = SharedTable.create(1, max(int(RING_SECONDS * self.timing.rate), LEAST_RING))
        cells = self.cells
        self._supervisor = Supervisor(shared, lambda: [cells])  # not `self`: it is dropped
        self._running = running = _DeviceSession(1, shared, cells, self.shell, self.coupling)
        alone = DeviceRequest(
            slot_request=running.request,
            table=self.cells.table,
            device=device,
            handle=self.handle,
            seconds=FOREVER if seconds is None else seconds,
            staleness=staleness,
            has_baseline=self._has_baseline,
            is_on_gpu=self.frames_on == "cuda",
        )
        request = WorkerRequest(shared, self.timing, self.law, self.rendering, alone)
        worker = running.worker = WorkerProcess(request)
        if self._recording is not None:
            running.begin_recording(self._recording, 0, worker.ready, self.frames_on)
        # last: supervised once its worker and recording exist
        self._supervisor.sessions[1] = running

    def __del__(self) -> None:
        with suppress(Exception):
            self.close()

    @property
    def n_frames(self) -> int:
        """Number of frames so far."""
        return self._open.n_frames

    @property
    def pid(self) -> int:
        """Process id of the loop."""
        return self._open.worker.pid

    @property
    def _open(self) -> "_DeviceSession":
        if self._running is None or self._running.shared.descriptor < 0:
            raise UsageError("the session is closed: begin another")
        return self._running

    @property
    def objects(self) -> tuple[int, ...]:
        """Ids of the objects touched so far; sampled a hundred times a second."""
        return tuple(sorted(self._running.objects if self._running else ()))

    @property
    def is_loose(self) -> bool:
        """Whether the tool lies in an object now and feels nothing; only with distances."""
        last = self.last()
        return last is not None and bool(last["state"][0] & State.IN_OBJECT)

    @property
    def enclosing_objects(self) -> tuple[int, ...]:
        """Ids of objects around the tool so far; sampled a hundred times a second."""
        return tuple(sorted(self._running.enclosing_objects if self._running else ()))

    @property
    def recording_ended(self) -> str | None:
        """One line: why the recording has ended before the session; None while it continues."""
        return None if self._recording is None else self._recording.ended

    @property
    def database_lost(self) -> str | None:
        """One line: why the database cannot be read now; None while it can."""
        return self.cells.database_lost

    def last(self) -> Frames | None:
        """Latest frame, (1,) of `FRAME`; None before the first."""
        return self._open.shared.last_frame(0)

    def wait(self, seconds: float | None = None) -> Report | None:
        """Wait for the session's end; returns its report, or None after `seconds`."""
        running, until = self._open, time.monotonic() + (FOREVER if seconds is None else seconds)
        process = running.worker
        while self._report is None:
            if self._supervisor is not None and self._supervisor.failure is not None:
                raise self._supervisor.failure
            is_alive = process.is_alive  # read first: the last message may come with the end
            left = until - time.monotonic()
            message = process.receive(min(POLL_EVERY, max(left, 0.0)))
            if message is not None:
                self._report = self._reported(message.content)
            elif not is_alive:
                raise HapticDBError(
                    "the worker process was ended from outside: begin the session again"
                )
            elif left <= 0.0:
                return None
        return self._report

    def request_end(self) -> None:
        """Make the loop end after its next frame. `wait` then returns the report."""
        self._open.request_end()

    def stop(self) -> Report:
        """End the session; returns its report."""
        self.request_end()
        report = self.wait(END_TIMEOUT)
        if report is None:
            device = type(self._device).__name__
            raise DeviceError(
                f"{device}: a call of read() or apply() takes longer than {END_TIMEOUT:g} s; "
                "check its connection and its driver"
            )
        return report

    def _reported(self, answer: LoopAnswer) -> Report:
        recorded = self._open.stop_recording()
        conditions = {"points": str(len(self.shell))}
        if self.timing.processor is not None:
            conditions["processor"] = f"bound to processor {self.timing.processor}"
        if answer.card is not None:
            conditions["frames on"] = answer.card
        return Report(
            rate=self.timing.rate,
            loop=answer.loop,
            empty=answer.empty,
            bad_reading=answer.bad_reading,
            conditions=conditions,
            is_warm=answer.is_warm,
            cache=self.cells.figures(),
            objects=self.objects,
            enclosing_objects=self.enclosing_objects,
            recorded_frames=recorded.frames,
            recording_ended=self.recording_ended,
            database_lost=self.database_lost,
            lost_records=recorded.lost,
            law=getattr(self.law, "name", type(self.law).__name__),
            rendering=self.rendering,
            coupling=self.coupling,
            **counts_of(self._open.shared.slots[0]),
        )

    def close(self) -> None:
        """End the processes and close the recording; its file stays.

        Does nothing in a forked copy, because the session belongs to the parent process.
        """
        if os.getpid() != self._pid:
            return
        # the last callback runs first, and each one runs even if another raises
        with ExitStack() as ends:
            if self._owns_cells:
                ends.callback(self.cells.close)
            if self._recording is not None:
                ends.callback(self._recording.close)
            if self._supervisor is not None:
                ends.callback(self._supervisor.close)
            if self._running is not None:
                ends.callback(self._running.end)
                ends.callback(self._running.end_process)


class _DeviceSession(Running):
    """A running session with a device, and the ids of objects met so far."""

    def __init__(self, *given: Any) -> None:  # noqa: ANN401 - as of `Running`
        super().__init__(*given)
        self.objects: set[int] = set()
        self.enclosing_objects: set[int] = set()
        self._n_seen, self._has_touched = 0, False  # touched since it last lay in something

    def take_frames(self) -> None:
        """Add the touched objects to the lists, and record the new frames."""
        with self._taking:
            self._list_objects()
        super().take_frames()

    def _list_objects(self) -> None:
        done, ring = self.n_frames, self.shared.rings[self.slot]
        answers = self.cells.table.queue.requests[self.request.reader]
        named = set(answers["objects"][: int(answers["n_objects"])].tolist())
        # frames since the last call, as far as the ring still has them
        frames = ring[np.arange(max(self._n_seen, done - len(ring)), done) % len(ring)]
        self._n_seen = done
        last = self.shared.last_frame(self.slot)
        if last is not None and last["state"][0] & State.IN_OBJECT:
            self.enclosing_objects |= named
            self._has_touched = False
            return
        self._has_touched |= bool((frames["hits"] | frames["contacts"]).any())
        # before the first contact an answer about the place where the tool lay may be left
        self.objects |= named if self._has_touched else named - self.enclosing_objects

    def end_process(self) -> None:
        """End the loop and its process, which sets the device's force to zero."""
        self.request_end()
        if self._worker is not None:
            self._worker.end()


def _check_choices(seconds: float | None, staleness: float) -> None:
    if seconds is not None and not 0.0 < seconds <= 1e6:
        raise UsageError(f"{seconds} seconds: give a number above 0, a million at most")
    if not staleness > 0.0:
        raise UsageError(f"a staleness of {staleness} s: give a number above 0, or inf")


def _checked_frames(frames_on: "BatchDevice", rendering: Rendering) -> "BatchDevice":
    """Raise unless frames can be computed there."""
    if frames_on != "cpu":
        from hapticdb.session.gpu_queries import check_frames  # noqa: PLC0415 - loads numba.cuda

        check_frames(frames_on, rendering)
    return frames_on
