"""Widgets of viser, where its types need a word."""

from typing import Any


def put(widget: Any, value: object) -> None:  # noqa: ANN401 - viser's types hide the setter
    """Set what a widget shows; its callbacks run with an event whose client is None."""
    widget.value = value
