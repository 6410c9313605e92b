"""Devices on another machine: contact proxies."""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hapticdb.client.contact_proxy import ContactProxy

__all__ = ["ContactProxy"]


def __getattr__(name: str) -> Any:  # noqa: ANN401 - whatever a name stands for
    if name in __all__:
        from hapticdb.client import contact_proxy  # noqa: PLC0415 - loads numba

        return getattr(contact_proxy, name)
    raise AttributeError(name)
