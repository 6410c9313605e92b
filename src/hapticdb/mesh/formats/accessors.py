"""Buffers and accessors of a glTF file; each distinct buffer is read once.

trimesh is not used: it reads an external file once for each of its buffers, makes arrays of all
accessors, used or not, and takes half a second to import.
"""

import base64
import binascii
import os
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hapticdb.mesh.parsed import UnreadableError, referenced_path

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_BIN = b"BIN\0"


def objects_of(tree: dict[str, Any], key: str) -> list[dict[str, Any]]:
    """List of objects under a key; empty if the key is missing."""
    found = tree.get(key, [])
    if not isinstance(found, list) or not all(isinstance(one, dict) for one in found):
        raise UnreadableError(f"it is damaged: its '{key}' is no list of objects")
    return found


def whole(value: object, what: str, least: int = 0) -> int:
    """Check for an integer of `least` or more, also as a float 1.0; true and 1.5 are none."""
    if type(value) is float and value.is_integer():
        value = int(value)
    if type(value) is not int or not least <= value < 2**53:
        raise UnreadableError(f"it is damaged: {what} is no whole number from {least} on")
    return value


def item(items: list[dict[str, Any]], number: object, what: str) -> dict[str, Any]:
    """Item of a list by its index; UnreadableError out of range."""
    n = whole(number, f"the number of {what}")
    if n >= len(items):
        raise UnreadableError(f"it is damaged: it refers to {what} {n} of {len(items)}")
    return items[n]


def extension_of(owner: dict[str, Any], name: str) -> dict[str, Any] | None:
    """Extension of an object, or None; some programs write an empty list instead of none."""
    extensions = owner.get("extensions")
    found = extensions.get(name) if isinstance(extensions, dict) else None
    return found if isinstance(found, dict) else None


def _external_name(buffer: dict[str, Any]) -> str | None:
    """File name of a buffer; None for an embedded one."""
    name = buffer.get("uri")
    if name is not None and not isinstance(name, str):
        raise UnreadableError("it is damaged: the 'uri' of a buffer is no text")
    return None if name is None or name.startswith("data:") else name


def external_bytes(tree: dict[str, Any], folder: Path) -> int:
    """Total size of the existing files that a glTF file refers to; each file counts once."""
    sizes: dict[tuple[int, int], int] = {}
    for name in {_external_name(buffer) for buffer in objects_of(tree, "buffers")} - {None}:
        file = referenced_path(folder, str(name))
        if file is not None:
            status = file.stat()
            sizes[status.st_dev, status.st_ino] = status.st_size
    return sum(sizes.values())


def chunks_of(content: bytes) -> list[memoryview]:
    """Binary chunks of a GLB file, in their order."""
    view = memoryview(content)
    at = 20 + int(struct.unpack("<I", content[12:16])[0])
    found = []
    while at + 8 <= len(view):
        (length,) = struct.unpack("<I", view[at : at + 4])
        if at + 8 + length > len(view):
            raise UnreadableError("it is cut short: one of its chunks ends behind the file's end")
        if view[at + 4 : at + 8] == _BIN:
            found.append(view[at + 8 : at + 8 + length])
        at += 8 + length
    return found


class Accessors:
    """Arrays of a glTF file's accessors: made on demand, and views if possible.

    tree : the file's JSON; chunks : binary chunks, the n-th is the n-th buffer without a URI;
    folder : of the referenced files.
    """

    def __init__(self, tree: dict[str, Any], chunks: list[memoryview], folder: Path) -> None:
        self._buffers = objects_of(tree, "buffers")
        self._views = objects_of(tree, "bufferViews")
        self._accessors = objects_of(tree, "accessors")
        self._is_packed = "compression" in str(tree.get("extensionsUsed"))
        self._chunks, self._folder = chunks, folder
        self._contents: dict[object, memoryview] = {}
        self._arrays: dict[int, NDArray[np.generic]] = {}

    def entry(self, number: object) -> dict[str, Any]:
        """JSON object of an accessor."""
        return item(self._accessors, number, "accessor")

    def array(self, number: int) -> NDArray[np.generic]:
        """Values (count, width) of an accessor, shared: do not write them."""
        if number not in self._arrays:
            self._arrays[number] = self._made(self.entry(number), f"accessor {number}")
        return self._arrays[number]

    def _made(self, accessor: dict[str, Any], what: str) -> NDArray[np.generic]:
        kind, shape = accessor.get("componentType"), accessor.get("type")
        if type(kind) is not int or kind not in _TYPES:
            raise UnreadableError(f"it is damaged: {what} has an unknown 'componentType'")
        if not isinstance(shape, str) or shape not in _WIDTHS:
            raise UnreadableError(f"it is damaged: {what} has an unknown 'type'")
        dtype, width = np.dtype(_TYPES[kind]), _WIDTHS[shape]
        count = whole(accessor.get("count"), f"the 'count' of {what}")
        if isinstance(accessor.get("sparse"), dict):
            return self._sparse(accessor, np.zeros((count, width), dtype), what)
        if "bufferView" not in accessor:
            if self._is_packed:
                raise UnreadableError(f"{what} has no buffer view: packed numbers are not read")
            return np.zeros((count, width), dtype)
        view = item(self._views, accessor["bufferView"], "buffer view")
        content = self._view(view)
        start = whole(accessor.get("byteOffset", 0), f"the 'byteOffset' of {what}")
        row = width * dtype.itemsize
        stride = whole(view.get("byteStride", row), "the 'byteStride' of a buffer view", 1)
        if count and start + (count - 1) * stride + row > len(content):
            raise UnreadableError(
                f"it is damaged or cut short: {what} promises {count:,} items, and its "
                f"{len(content):,} bytes hold fewer"
            )
        if not count:
            return np.empty((0, width), dtype)
        rows = np.ndarray((count, width), dtype, content, start, (stride, dtype.itemsize))
        return _normal(rows) if accessor.get("normalized") else rows

    def _sparse(
        self, accessor: dict[str, Any], found: NDArray[Any], what: str
    ) -> NDArray[np.generic]:
        """Values of a sparse accessor: base values with replacements; `found` : zeros."""
        sparse = accessor["sparse"]
        plain = accessor | {"sparse": None, "normalized": False}
        if "bufferView" in accessor:
            found[:] = self._made(plain, what)
        rows = {"count": sparse.get("count"), "type": "SCALAR"} | sparse["indices"]
        values = plain | {"byteOffset": 0, "count": sparse.get("count")} | sparse["values"]
        found[self._made(rows, what)[:, 0]] = self._made(values, what)
        return _normal(found) if accessor.get("normalized") else found

    def _view(self, view: dict[str, Any]) -> memoryview:
        number = whole(view.get("buffer"), "the 'buffer' of a buffer view")
        content = self._content(number, item(self._buffers, number, "buffer"))
        start = whole(view.get("byteOffset", 0), "the 'byteOffset' of a buffer view")
        length = whole(view.get("byteLength"), "the 'byteLength' of a buffer view")
        if start + length > len(content):
            raise UnreadableError(
                f"it is damaged or cut short: a buffer view ends at byte {start + length:,} of "
                f"buffer {number}, which has {len(content):,}"
            )
        return content[start : start + length]

    def _content(self, number: int, buffer: dict[str, Any]) -> memoryview:
        """Bytes of a buffer; buffers of one file share them."""
        name = _external_name(buffer)
        file = None if name is None else referenced_path(self._folder, name)
        if name is not None and file is None:
            raise UnreadableError(f"it refers to {name}, which is not beside it")
        key: object = number
        if file is not None:
            status = file.stat()
            key = (status.st_dev, status.st_ino)
        if key not in self._contents:
            self._contents[key] = memoryview(
                self._within(number, buffer) if file is None else _bytes_of(file)
            )
        return self._contents[key]

    def _within(self, number: int, buffer: dict[str, Any]) -> bytes | memoryview:
        """Bytes of an embedded buffer."""
        if "uri" in buffer:
            head, found, text = str(buffer["uri"]).partition("base64,")
            if not found:
                raise UnreadableError(f"buffer {number} is '{head[:40]}', not base64")
            try:
                return base64.b64decode(text)
            except (binascii.Error, ValueError):
                raise UnreadableError(f"it is damaged: buffer {number} is no base64") from None
        n = sum("uri" not in one for one in self._buffers[:number])
        if n >= len(self._chunks):
            raise UnreadableError(f"it is damaged or cut short: it holds no buffer {number}")
        return self._chunks[n]


def _normal(whole_numbers: NDArray[Any]) -> NDArray[Any]:
    """Normalised integers as fractions, -1 to 1 or 0 to 1; floats unchanged."""
    if whole_numbers.dtype.kind == "f":
        return whole_numbers
    return np.maximum(whole_numbers / np.iinfo(whole_numbers.dtype).max, -1.0)


def _bytes_of(file: Path) -> bytes:
    try:
        return file.read_bytes()
    except OSError as error:
        cause = error.strerror or str(error)
        raise UnreadableError(f"it refers to {os.fspath(file)}: {cause.lower()}") from None
