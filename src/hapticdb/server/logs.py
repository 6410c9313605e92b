"""The server's log: a line for each event on standard error, plain or as JSON."""

import json
import logging
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

STANDARD = frozenset(vars(logging.makeLogRecord({}))) | {"message", "asctime", "color_message"}
"""Fields that every record has; all others were given with the event."""
TIME = "%Y-%m-%dT%H:%M:%S"
LOGGERS = ("hapticdb", "uvicorn.error", "websockets.client")
"""What is written. uvicorn's log of requests is not: their addresses can hold a token."""


class _PlainLine(logging.Formatter):
    """Time, level, words, and what belongs to the event."""

    def format(self, record: logging.LogRecord) -> str:
        """Put an event on one line."""
        more = "".join(f" {name}={value}" for name, value in fields_of(record).items())
        return (
            f"{self.formatTime(record, TIME)} {record.levelname.lower()} {words_of(record)}{more}"
        )


class _JsonLine(logging.Formatter):
    """One JSON object an event."""

    def format(self, record: logging.LogRecord) -> str:
        """Put an event on one line."""
        line = {
            "time": f"{self.formatTime(record, TIME)}.{int(record.msecs):03d}",
            "level": record.levelname.lower(),
            "event": words_of(record),
            "from": record.name,
        }
        return json.dumps(line | fields_of(record), default=str)


def fields_of(record: logging.LogRecord) -> dict[str, object]:
    """Fields that were given with an event."""
    return {name: value for name, value in vars(record).items() if name not in STANDARD}


def words_of(record: logging.LogRecord) -> str:
    """Words of an event on one line; of an exception its type and its own words."""
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
