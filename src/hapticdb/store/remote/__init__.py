"""Environments behind a hapticdb server, to read: ``ws://host:port``."""
