"""Health checks of a running server, and metrics of sessions and their tables."""

import asyncio
import contextlib
import logging
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any, NamedTuple

from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from hapticdb.environment import Environment
from hapticdb.errors import HapticDBError, UsageError
from hapticdb.server.page_supervisor import PageSupervisor
from hapticdb.server.served import Served
from hapticdb.session.host import SessionHost
from hapticdb.session.report import LoopFigures
from hapticdb.store.connect import open_store

LOG = logging.getLogger("hapticdb.server")
GOOD_FOR = 1.0
"""Lifetime of a cached result, seconds."""
TIMEOUT = 5.0
"""Time limit of the database's response, seconds."""


class Health(NamedTuple):
    """Health of each part: true if it responds."""

    database: bool
    fetching: bool
    workers: bool
    page: bool

    @property
    def is_well(self) -> bool:
        """Whether all parts respond."""
        return all(self)

    def words(self) -> dict[str, str]:
        """Status for people and probes, without details of use to an attacker."""
        parts = {name: "ok" if is_well else "failing" for name, is_well in self._asdict().items()}
        return {"status": "ok" if self.is_well else "failing"} | parts


class HealthChecker:
    """Health checks of a server's parts."""

    def __init__(self, served: Served, supervisor: PageSupervisor) -> None:
        self._served, self._supervisor = served, supervisor
        # a store belongs to one thread
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="health")
        self._env: Environment | None = None
        self._last: tuple[float, Health] | None = None
        self._querying = asyncio.Lock()

    async def health(self) -> Health:
        """Health of each part, at most `GOOD_FOR` old."""
        async with self._querying:
            now = time.monotonic()
            if self._last is not None and now - self._last[0] < GOOD_FOR:
                return self._last[1]
            database, page = await asyncio.gather(self._is_answered(), self._supervisor.answers())
            sessions = await asyncio.to_thread(self._served.host.sessions)
            are_working = not any(session.is_over for session in sessions)
            found = Health(database, self._served.host.failure is None, are_working, page)
            if not found.is_well:
                LOG.warning("a part does not answer", extra=found.words())
            self._last = (now, found)
            return found

    def close(self) -> None:
        """Close the connection to the database."""
        self._thread.submit(self._forget)
        self._thread.shutdown(wait=True)

    async def _is_answered(self) -> bool:
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(TIMEOUT):
                return await loop.run_in_executor(self._thread, self._query_revision)
        except TimeoutError:
            return False

    def _query_revision(self) -> bool:
        """Query the database's revision, in the thread of its connection."""
        try:
            if self._env is None:
                self._env = Environment(open_store(self._served.host.url, read_only=True))
            began = time.perf_counter()
            self._env.store.revision()
        except HapticDBError as error:
            LOG.warning("the database does not answer: %s", error)
            self._forget()
            return False
        self._served.figures.database.observe(time.perf_counter() - began)
        return True

    def _forget(self) -> None:
        env, self._env = self._env, None
        if env is not None:
            env.close()


class HostCollector(Collector):
    """Metrics of a host's sessions and tables, computed at each scrape."""

    def __init__(self, host: SessionHost) -> None:
        self._host = host

    def collect(self) -> Iterator[Metric]:
        """Yield each metric: sums; of times and shares the worst."""
        figures: list[tuple[LoopFigures, dict[str, Any]]] = []
        for session in self._host.sessions():
            with contextlib.suppress(UsageError):  # one may end meanwhile
                figures.append((session.figures(), session.counts()))
        sessions = [loop for loop, _ in figures]
        unknown, held, stale = (
            sum(counts[f"{name}_frames"] for _, counts in figures)
            for name in ("unknown", "held", "stale")
        )
        tables = [cells.figures() for cells in self._host.cells]
        hit_rates, latencies = ([getattr(t, n) for t in tables] for n in ("hit_rate", "latency"))
        late, took = ([getattr(f, n).p99 for f in sessions] for n in ("lateness", "elapsed"))
        for name, words, value in (
            ("sessions", "Sessions that run.", len(sessions)),
            ("workers", "Worker processes that run.", len(self._host.pids)),
            ("session_frames", "Frames of the sessions.", sum(f.frames for f in sessions)),
            ("session_missed", "Deadlines without a frame.", sum(f.missed for f in sessions)),
            ("session_unknown_frames", "With unknown cells.", unknown),
            ("session_held_frames", "With an earlier force.", held),
            ("session_stale_frames", "Without a database.", stale),
            ("session_rate_hertz", "Frames a second that are aimed at.", self._host.rate),
            ("session_lateness_seconds", "From a deadline to its frame, p99.", max([0.0, *late])),
            ("session_frame_seconds", "Computing a frame, p99.", max([0.0, *took])),
            ("cell_tables", "Tables of cells.", len(tables)),
            ("cells_resident", "Cells in memory.", sum(t.resident for t in tables)),
            ("cells_loaded", "Cells read so far.", sum(t.loaded for t in tables)),
            ("cells_losses", "How often the database was lost.", sum(t.losses for t in tables)),
            ("cells_restarts", "Fetchers started again.", sum(t.restarts for t in tables)),
            ("cells_hit_rate", "Share of cells found in memory.", min([1.0, *hit_rates])),
            ("cells_latency_seconds", "Median of recent batches.", max([0.0, *latencies])),
        ):  # fmt: skip
            yield GaugeMetricFamily(f"hapticdb_{name}", words, float(value))
