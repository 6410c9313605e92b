"""Whether each part of a running server answers, and the figures of sessions and their tables."""

import asyncio
import contextlib
import logging
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

from prometheus_client.core import GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from hapticdb.environment import Environment
from hapticdb.errors import HapticDBError, UsageError
from hapticdb.hosting.host import SessionHost
from hapticdb.hosting.hosted import HostedFigures
from hapticdb.server.access import Role
from hapticdb.server.page_keeper import PageKeeper
from hapticdb.server.served import Served
from hapticdb.store.connect import open_store

LOG = logging.getLogger("hapticdb.server")
GOOD_FOR = 1.0
"""Seconds that an answer is given again without asking the parts. Larger: a failure is seen later,
and many who ask cost the database less."""
PATIENCE = 5.0
"""Seconds that the database has to answer."""


class Health(NamedTuple):
    """Whether each part answers."""

    database: bool
    fetching: bool
    workers: bool
    page: bool

    @property
    def is_well(self) -> bool:
        """Whether all do."""
        return all(self)

    def words(self) -> dict[str, str]:
        """For people and for probes; nothing that helps an attacker."""
        parts = {name: "ok" if is_well else "failing" for name, is_well in self._asdict().items()}
        return {"status": "ok" if self.is_well else "failing"} | parts


class Doctor:
    """Asks the parts of a server whether they work.

    Parameters
    ----------
    served : Served
        The environment, the sessions and the figures.
    keeper : PageKeeper
        The page.
    """

    def __init__(self, served: Served, keeper: PageKeeper) -> None:
        self._served, self._keeper = served, keeper
        # a store belongs to one thread
        self._thread = ThreadPoolExecutor(1, thread_name_prefix="health")
        self._env: Environment | None = None
        self._last: tuple[float, Health] | None = None
        self._asking = asyncio.Lock()

    async def health(self) -> Health:
        """Whether each part answers, at most `GOOD_FOR` old."""
        async with self._asking:
            now = time.monotonic()
            if self._last is not None and now - self._last[0] < GOOD_FOR:
                return self._last[1]
            database, page = await asyncio.gather(self._asked(), self._keeper.answers())
            are_working = await asyncio.to_thread(self._are_working)
            found = Health(database, self._served.host.failure is None, are_working, page)
            if not found.is_well:
                LOG.warning("a part does not answer", extra=found.words())
            self._last = (now, found)
            return found

    def close(self) -> None:
        """Close the connection to the database."""
        self._thread.submit(self._forget)
        self._thread.shutdown(wait=True)

    def _are_working(self) -> bool:
        """Whether no session has lost its process."""
        return not any(session.is_over for session in self._served.host.sessions())

    async def _asked(self) -> bool:
        loop = asyncio.get_running_loop()
        try:
            async with asyncio.timeout(PATIENCE):
                return await loop.run_in_executor(self._thread, self._ask)
        except TimeoutError:
            return False

    def _ask(self) -> bool:
        """Ask the database for its revision, in the thread that has it open."""
        try:
            if self._env is None:
                url = self._served.urls[Role.VIEWER]
                self._env = Environment(open_store(url, read_only=True))
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
    """Figures of sessions and tables, read when they are asked for.

    Parameters
    ----------
    host : SessionHost
        Where they run.
    """

    def __init__(self, host: SessionHost) -> None:
        self._host = host

    def collect(self) -> Iterator[Metric]:
        """Yield one family of figures after another."""
        figures = self._figures()
        yield GaugeMetricFamily("hapticdb_sessions", "Sessions that run.", len(figures))
        yield GaugeMetricFamily(
            "hapticdb_workers", "Worker processes that run.", len(self._host.pids)
        )
        for name, words, values in (
            ("frames", "Frames of the sessions that run.", [f.frames for f in figures]),
            ("missed", "Deadlines at which no frame began.", [f.missed for f in figures]),
            ("unknown_frames", "Frames with unknown cells.", [f.unknown for f in figures]),
            ("held_frames", "Frames with an earlier force.", [f.held for f in figures]),
            ("stale_frames", "Frames without a database.", [f.stale for f in figures]),
        ):
            yield GaugeMetricFamily(f"hapticdb_session_{name}", words, float(sum(values)))
        yield GaugeMetricFamily(
            "hapticdb_session_rate_hertz", "Frames a second that each session aims at.",
            self._host.rate,
        )  # fmt: skip
        for name, words, spreads in (
            ("lateness", "From a deadline to its frame.", [f.lateness for f in figures]),
            ("frame", "Computing a frame.", [f.elapsed for f in figures]),
        ):
            family = GaugeMetricFamily(
                f"hapticdb_session_{name}_seconds", f"{words} Of the worst session.",
                labels=["quantile"],
            )  # fmt: skip
            for quantile, times in (
                ("0.5", [spread.p50 for spread in spreads]),
                ("0.99", [spread.p99 for spread in spreads]),
                ("1", [spread.worst for spread in spreads]),
            ):
                family.add_metric([quantile], max(times, default=0.0))
            yield family
        yield from self._cells()

    def _figures(self) -> list[HostedFigures]:
        """Figures of the sessions that run; one may end meanwhile."""
        found = []
        for session in self._host.sessions():
            with contextlib.suppress(UsageError):
                found.append(session.figures())
        return found

    def _cells(self) -> Iterator[Metric]:
        """Figures of the tables of cells, added up; of times the worst."""
        tables = [cells.figures() for cells in self._host.cells]
        yield GaugeMetricFamily("hapticdb_cell_tables", "Tables of cells.", len(tables))
        for name, words, values in (
            ("bytes", "Memory of the tables.", [t.budget_bytes for t in tables]),
            ("resident", "Cells in memory.", [t.resident for t in tables]),
            ("loaded", "Cells read so far.", [t.loaded for t in tables]),
            ("evicted", "Cells that made room so far.", [t.evicted for t in tables]),
            ("losses", "How often the database was lost.", [t.losses for t in tables]),
            ("restarts", "Fetching processes started again.", [t.restarts for t in tables]),
        ):
            yield GaugeMetricFamily(f"hapticdb_cells_{name}", words, float(sum(values)))
        yield GaugeMetricFamily(
            "hapticdb_cells_hit_rate", "Share of wanted cells that were there; the worst table.",
            min((t.hit_rate for t in tables), default=1.0),
        )  # fmt: skip
        yield GaugeMetricFamily(
            "hapticdb_cells_latency_seconds", "Median of recent batches; the worst table.",
            max((t.latency for t in tables), default=0.0),
        )  # fmt: skip
