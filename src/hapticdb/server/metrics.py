"""Metrics of the server for Prometheus."""

from functools import partial

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, generate_latest

DATABASE_BUCKETS = (0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 5.0)
"""Bucket bounds of the database's response times, seconds."""


class Metrics:
    """Metrics of one server."""

    def __init__(self) -> None:
        self.registry = CollectorRegistry()
        gauge = partial(Gauge, registry=self.registry)
        counter = partial(Counter, registry=self.registry)
        self.browsers = gauge("hapticdb_browsers", "Browsers that are connected.", ["role"])
        self.connections = counter(
            "hapticdb_browser_connections",
            "Connections of browsers, by how they ended or why they were refused.",
            ["end"],
        )
        self.messages = counter(
            "hapticdb_relay_messages", "Messages of browsers passed to the page."
        )
        self.dropped = counter(
            "hapticdb_relay_messages_dropped",
            "Messages of browsers that were not passed: malformed, type, role or size.",
            ["reason"],
        )
        self.relayed = counter(
            "hapticdb_relay_bytes", "From browsers (in) and to them (out).", ["direction"]
        )
        self.throttled = counter(
            "hapticdb_relay_throttled_seconds", "Waits of browsers that sent too much."
        )
        self.page_starts = gauge("hapticdb_page_starts", "How often the page process was started.")
        self.database = Histogram(
            "hapticdb_database_seconds", "Answers of the database to a health check.",
            buckets=DATABASE_BUCKETS, registry=self.registry,
        )  # fmt: skip
        for reason in ("malformed", "type", "role", "size"):
            self.dropped.labels(reason)
        for direction in ("in", "out"):
            self.relayed.labels(direction)

    def text(self) -> bytes:
        """All metrics in the text format of Prometheus."""
        return generate_latest(self.registry)
