"""What is closed at the end of its `with` block."""

from abc import ABC, abstractmethod
from typing import Self


class Closes(ABC):
    """Something that a `with` block closes at its end."""

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Close it."""

    def __deepcopy__(self, _: object = None) -> Self:
        raise TypeError(f"a {type(self).__name__} cannot be copied: a copy would close it, too")

    __copy__ = __deepcopy__
