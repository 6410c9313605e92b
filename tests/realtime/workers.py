"""Processes for the tests: what they do is the first word of their request."""

import os
import sys
import time

from hapticdb import DatabaseError
from hapticdb.realtime.processes import Voice, parent_is_gone


def work(request: tuple[str, object], voice: Voice) -> None:
    word, content = request
    if word == "echo":
        print("a driver's words")  # noqa: T201 - they must not mix with messages
        voice.say("heard", content)
        voice.say("again", (content, os.getpid()))
    elif word == "fail":
        raise DatabaseError("no such place: make it first")
    elif word == "break":
        raise ZeroDivisionError("one\ntwo")
    elif word == "wait":
        voice.say("waiting")
        while not parent_is_gone():
            time.sleep(1e-3)
    elif word == "tidy":
        try:
            voice.say("waiting")
            time.sleep(1000)
        finally:
            voice.say("tidied")
    elif word == "end of file":
        raise EOFError("of something else")
    elif word == "hang":
        voice.say("hanging")
        time.sleep(1000)
    elif word == "exit":
        sys.exit(3)
