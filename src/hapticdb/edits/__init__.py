"""Moves of objects by several people: each one transaction, with undo."""
