"""Fixtures of the tests that crash a server."""

from crashes import (  # noqa: F401
    _impatient,
    crashing,
    edited,
    file,
    server,
    template,
    undisturbed,
    url,
)
