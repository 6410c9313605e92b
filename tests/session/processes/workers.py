"""Work of processes in the tests; the first word of the request says what they do."""

import os
import sys
import time
from pathlib import Path

from hapticdb.errors import DatabaseError
from hapticdb.query.law import DISTANCE
from hapticdb.session.device_loop import empty_loop
from hapticdb.session.processes.process import MessageSender, parent_is_gone


def work(request: tuple[str, object], sender: MessageSender) -> None:
    word, content = request
    if word == "echo":
        print("a driver's words")  # noqa: T201 - they must not mix with messages
        sender.send("heard", content)
        sender.send("again", (content, os.getpid()))
    elif word == "where":
        sender.send("here", (str(Path.cwd()), os.environ["HAPTICDB_TEST_WORD"]))
    elif word == "fail":
        raise DatabaseError("no such place: make it first")
    elif word == "break":
        raise ZeroDivisionError("one\ntwo")
    elif word == "wait":
        sender.send("waiting")
        while not parent_is_gone():
            time.sleep(1e-3)
    elif word == "tidy":
        try:
            sender.send("waiting")
            time.sleep(1000)
        finally:
            sender.send("tidied")
    elif word == "measure":
        sender.send("measuring")
        empty_loop(DISTANCE, None, 1000.0, 3600.0)
    elif word == "end of file":
        raise EOFError("of something else")
    elif word == "hang":
        sender.send("hanging")
        time.sleep(1000)
    elif word == "exit":
        sys.exit(3)
