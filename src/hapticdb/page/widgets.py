"""Widgets of viser, where its types or its ways need a word."""

from typing import Any


def put(widget: Any, value: object) -> None:  # noqa: ANN401 - viser's inputs share no public type
    """Set what a widget shows; its callbacks run with an event whose client is None."""
    if widget.value != value:
        widget.value = value


def show(thing: Any, *, is_seen: bool) -> None:  # noqa: ANN401 - likewise
    """Show or hide a widget or a node; nothing is sent if it is so already."""
    if thing.visible != is_seen:
        thing.visible = is_seen
