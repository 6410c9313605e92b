"""Fields of a message's body, one after another, little-endian; a length is never trusted."""

import struct
from typing import Self

import numpy as np
from numpy.typing import NDArray

from hapticdb.errors import ProtocolError
from hapticdb.protocol.header import LAYOUT, MOST_TEXT

_U1, _U2, _U4 = (struct.Struct(f"<{code}") for code in "BHI")
_I8, _F8 = struct.Struct("<q"), struct.Struct("<d")


class FieldsRead:
    """Reads the fields of a message's body in their order.

    Every method raises ProtocolError when fewer bytes are left than the field needs.
    """

    def __init__(self, message: bytes, start: int = LAYOUT.size) -> None:
        self._message = message
        self._at = start

    @property
    def left(self) -> int:
        """Bytes that have not been read."""
        return len(self._message) - self._at

    def end(self) -> None:
        """Refuse a message that is longer than its fields."""
        if self.left:
            raise ProtocolError(f"a message with {self.left} bytes after its last field")

    def take(self, n_bytes: int) -> bytes:
        """Next bytes, as many as asked for."""
        at = self._reserve(n_bytes)
        return self._message[at : at + n_bytes]

    def u1(self) -> int:
        """Next unsigned byte."""
        return self._number(_U1)

    def u2(self) -> int:
        """Next unsigned number of 2 bytes."""
        return self._number(_U2)

    def u4(self) -> int:
        """Next unsigned number of 4 bytes."""
        return self._number(_U4)

    def i8(self) -> int:
        """Next signed number of 8 bytes."""
        return self._number(_I8)

    def f8(self) -> float:
        """Next floating-point number of 8 bytes, finite or not."""
        at = self._reserve(_F8.size)
        return float(_F8.unpack_from(self._message, at)[0])

    def text(self) -> str:
        """Next text: its bytes in UTF-8 after their number, 4 bytes."""
        n_bytes = self.u4()
        if n_bytes > MOST_TEXT:
            raise ProtocolError(f"a text of {n_bytes} bytes: at most {MOST_TEXT} may be sent")
        try:
            return self.take(n_bytes).decode()
        except UnicodeDecodeError:
            raise ProtocolError("a text that is no UTF-8") from None

    def i8s(self, count: int) -> NDArray[np.int64]:
        """Next `count` signed numbers of 8 bytes, a copy (count,)."""
        return self.array(count, "<i8").astype(np.int64)

    def f8s(self, count: int) -> NDArray[np.float64]:
        """Next `count` floating-point numbers of 8 bytes, a copy (count,)."""
        return self.array(count, "<f8").astype(np.float64)

    def array(self, count: int, dtype: str) -> NDArray[np.generic]:
        """Next `count` values of a type, a view that cannot be written."""
        of_type = np.dtype(dtype)
        at = self._reserve(count * of_type.itemsize)
        return np.frombuffer(self._message, of_type, count, at)

    def _number(self, layout: struct.Struct) -> int:
        at = self._reserve(layout.size)
        return int(layout.unpack_from(self._message, at)[0])

    def _reserve(self, n_bytes: int) -> int:
        at = self._at
        if n_bytes < 0 or n_bytes > len(self._message) - at:
            raise ProtocolError(
                f"a message that ends after {len(self._message)} bytes, inside a field"
            )
        self._at += n_bytes
        return at


class FieldsWritten:
    """Collects the fields of a message's body."""

    def __init__(self) -> None:
        self._parts: list[bytes] = []

    def joined(self) -> bytes:
        """All fields so far, one after another."""
        return b"".join(self._parts)

    def take(self, some: bytes) -> Self:
        """Append bytes as they are."""
        self._parts.append(some)
        return self

    def u1(self, *values: int) -> Self:
        """Append unsigned bytes."""
        return self.take(bytes(values))

    def u2(self, value: int) -> Self:
        """Append an unsigned number of 2 bytes."""
        return self.take(_U2.pack(value))

    def u4(self, *values: int) -> Self:
        """Append unsigned numbers of 4 bytes."""
        return self.take(b"".join(map(_U4.pack, values)))

    def i8(self, *values: int) -> Self:
        """Append signed numbers of 8 bytes."""
        return self.take(b"".join(map(_I8.pack, values)))

    def f8(self, *values: float) -> Self:
        """Append floating-point numbers of 8 bytes."""
        return self.take(b"".join(map(_F8.pack, values)))

    def text(self, text: str) -> Self:
        """Append a text, cut to the longest that may be sent."""
        data = text.encode("utf-8", "replace")[:MOST_TEXT].decode("utf-8", "ignore").encode()
        return self.u4(len(data)).take(data)

    def array(self, values: NDArray[np.generic], dtype: str) -> Self:
        """Append the values of an array as a type."""
        return self.take(np.ascontiguousarray(values, dtype).tobytes())
