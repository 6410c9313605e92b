"""Log of the server: a line for each event on standard error, plain or as JSON."""

import json
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

STANDARD = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "color_message"}
"""Fields of every record; all others come from the event."""
TIME = "%Y-%m-%dT%H:%M:%S"
LOGGERS = ("hapticdb", "uvicorn.error", "websockets.client")
"""Loggers written. uvicorn's access log is not: its URLs can contain a token."""


class _PlainLine(logging.Formatter):
    """Time, level, message, and fields of the event."""

    def format(self, record: logging.LogRecord) -> str:
        """Format an event as one line."""
        more = "".join(f" {name}={value}" for name, value in fields_of(record).items())
        return (
            f"{self.formatTime(record, TIME)} {record.levelname.lower()} {words_of(record)}{more}"
        )


class _JsonLine(logging.Formatter):
    """One JSON object an event."""

    def format(self, record: logging.LogRecord) -> str:
        """Format an event as one line."""
        line = {
            "time": f"{self.formatTime(record, TIME)}.{int(record.msecs):03d}",
            "level": record.levelname.lower(),
            "event": words_of(record),
            "from": record.name,
        }
        return json.dumps(line | fields_of(record), default=str)


def fields_of(record: logging.LogRecord) -> dict[str, object]:
    """Fields of an event."""
    return {name: value for name, value in vars(record).items() if name not in STANDARD}


def words_of(record: logging.LogRecord) -> str:
    """Message of an event on one line, with type and message of an exception."""
    words = record.getMessage()
    if record.exc_info and record.exc_info[1] is not None:
        error = record.exc_info[1]
        words = f"{words.strip()}: {type(error).__name__}: {error}"
    return " ".join(words.split())


@contextmanager
def written(form: Literal["plain", "json"], level: int = logging.INFO) -> Iterator[None]:
    """Write the server's events to standard error inside the block."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_JsonLine() if form == "json" else _PlainLine())
    before = []
    for name in LOGGERS:
        logger = logging.getLogger(name)
        before.append((logger, logger.handlers, logger.propagate, logger.level))
        logger.handlers = [handler]
        logger.propagate = False
        logger.setLevel(level if name == "hapticdb" else max(level, logging.WARNING))
    try:
        yield
    finally:
        for logger, handlers, propagates, former in before:
            logger.handlers, logger.propagate = handlers, propagates
            logger.setLevel(former)
