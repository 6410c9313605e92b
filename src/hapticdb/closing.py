"""Context managers that close themselves."""

from abc import ABC, abstractmethod
from typing import Self


class Closes(ABC):
    """Base of classes with `close`, called at the end of a `with` block."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Release the resources."""

    def __deepcopy__(self, _: object = None) -> Self:
        raise TypeError(f"a {type(self).__name__} cannot be copied: a copy would close it, too")

    __copy__ = __deepcopy__
