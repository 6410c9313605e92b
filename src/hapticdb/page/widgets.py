"""Setter for viser's widgets, missing in viser's types."""

from typing import Any


def put(widget: Any, value: object) -> None:  # noqa: ANN401 - viser's types hide the setter
    """Set a widget's value; its callbacks receive an event with client None."""
    widget.value = value
