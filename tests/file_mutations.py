"""Damages files: their bytes, numbers and lines, and the structure of JSON, XML and archives."""

import io
import json
import re
import struct
import zipfile
from collections.abc import Callable
from random import Random
from typing import Any

TEXTS = {".obj", ".off", ".stl", ".ply", ".dae", ".step", ".stp", ".csv", ".gltf"}
WORDS = (  # noqa: SIM905 - longer as a list
    "0 -1 1e308 -1e308 nan inf 4294967295 2147483648 -2147483649 9223372036854775808 1e-320 0x10 x "
    "99999999999999999999999 1e400 1_0 # ; 1,5 \u0661 1e5 65536 3.5"
).split()
BYTES = (
    *(n.to_bytes(4, "little") for n in (0, 1, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 0x01000000)),
    *(struct.pack("<f", x) for x in (float("nan"), float("inf"), 3e38, -3e38, 1e-45)),
    *(n.to_bytes(8, "little") for n in (0, 1 << 31, 1 << 40, (1 << 63) - 1, (1 << 64) - 1)),
    *(struct.pack("<d", x) for x in (float("nan"), float("-inf"), 1e308, 1e200)),
    *(n.to_bytes(2, "little") for n in (0, 0x7FFF, 0xFFFF)),
)
VALUES: tuple[Any, ...] = (
    None, True, [], {}, "", "x", -1, 0, 0.5, 2**31, 2**53, 2**64, 1e308, 10**30, [[]], [None],
    {"a": 1}, float("nan"), [0, 0], "\ud800", "../seed", "data:,x", "data:;base64,AAAA", 3, 9, 100,
)  # fmt: skip
_NUMBER = re.compile(rb"-?\d+\.?\d*(?:[eE][-+]?\d+)?")
_ELEMENT = re.compile(rb"<(\w+)[^<>]*(?:/>|>[^<]*</\1>)")


def mutated(random: Random, suffix: str, content: bytes, other: bytes) -> bytes:
    """Content with one to three damages. `other` is a file of the same format."""
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        choices: list[Callable[[Random, bytes], bytes]] = [_bytes_changed, _cut_or_grown]
        if suffix in TEXTS:
            choices += [_numbers_changed, _lines_changed, _numbers_changed, _lines_changed]
        if suffix in {".gltf", ".glb"}:
            choices += [_json_changed] * 4
        if suffix in {".dae", ".3mf"}:
            choices += [_elements_changed] * 2
        if suffix in {".3mf", ".npz"}:
            choices += [_archive_changed] * 5
        if suffix in {".las", ".laz", ".stl", ".hdbrec", ".glb"}:
            choices += [_header_changed] * 2
        chosen = random.choice(choices)
        if random.random() < 0.04:
            content = _spliced(random, content, other)
        content = chosen(random, content)
    return content


def _bytes_changed(random: Random, content: bytes) -> bytes:
    found = bytearray(content)
    for _ in range(random.choice((1, 1, 2, 8))):
        if found:
            at = random.randrange(len(found))
            if random.random() < 0.5:
                found[at] ^= 1 << random.randrange(8)
            else:
                extreme = random.choice(BYTES)
                found[at : at + len(extreme)] = extreme
    return bytes(found)


def _header_changed(random: Random, content: bytes) -> bytes:
    at = random.randrange(min(len(content), 400) or 1)
    extreme = random.choice(BYTES)
    return content[:at] + extreme + content[at + len(extreme) :]


def _cut_or_grown(random: Random, content: bytes) -> bytes:
    first, last = sorted(random.randrange(len(content) + 1) for _ in range(2))
    kind = random.randrange(4)
    if kind == 0:
        return content[:first]
    if kind == 1:
        return content[:first] + content[last:]
    if kind == 2:
        return content[:last] + content[first:]
    return content[:first] + random.randbytes(random.choice((1, 4, 100))) + content[first:]


def _spliced(random: Random, content: bytes, other: bytes) -> bytes:
    return content[: random.randrange(len(content) + 1)] + other[random.randrange(len(other) + 1) :]


def _numbers_changed(random: Random, content: bytes) -> bytes:
    places = list(_NUMBER.finditer(content))
    for place in sorted(random.sample(places, min(len(places), random.choice((1, 1, 3)))),
                        key=lambda found: -found.start()):  # fmt: skip
        word = random.choice(WORDS).encode()
        content = content[: place.start()] + word + content[place.end() :]
    return content


def _lines_changed(random: Random, content: bytes) -> bytes:
    lines = content.split(b"\n")
    n, m = random.randrange(len(lines)), random.randrange(len(lines))
    kind = random.randrange(7)
    if kind == 0:
        del lines[n]
    elif kind == 1:
        lines[n:n] = [lines[n]] * random.choice((1, 3, 2000))
    elif kind == 2:
        lines[n], lines[m] = lines[m], lines[n]
    elif kind == 3:
        words = lines[n].split(b" ")
        del words[random.randrange(len(words))]
        lines[n] = b" ".join(words)
    elif kind == 4:
        lines[n] += random.choice((b" #c", b"\\", b" 1", b"\r", b"\0", b"\xff", b" " * 5000))
    elif kind == 5:
        lines[n] *= random.choice((2, 500))
    else:
        lines[n] = b"".join(random.choice((b"(", b"[", b"<a>", b'"')) for _ in range(3000))
    return b"\n".join(lines)


def _elements_changed(random: Random, content: bytes) -> bytes:
    elements = list(_ELEMENT.finditer(content))
    if not elements:
        return content
    one, two = random.choice(elements), random.choice(elements)
    kind = random.randrange(5)
    if kind == 0:
        return content[: one.start()] + content[one.end() :]
    if kind == 1:
        times = random.choice((2, 1000))
        return content[: one.start()] + one[0] * times + content[one.end() :]
    if kind == 2:
        return content[: one.start()] + two[0] + content[one.end() :]
    if kind == 3:
        depth = random.choice((3, 3000))
        return content[: one.start()] + b"<a>" * depth + one[0] + b"</a>" * depth
    return (
        content[: one.start()]
        + re.sub(rb' \w+="[^"]*"', b"", one[0], count=1)
        + content[one.end() :]
    )


def _json_changed(random: Random, content: bytes) -> bytes:
    is_binary = content[:4] == b"glTF"
    try:
        length = int.from_bytes(content[12:16], "little") if is_binary else len(content)
        start = 20 if is_binary else 0
        tree = json.loads(content[start : start + length])
    except (ValueError, RecursionError):
        return _bytes_changed(random, content)
    holder, key = _place(random, tree)
    _change(random, holder, key)
    if random.random() < 0.02:
        return b'{"asset":{"version":"2.0"},"nodes":' + b"[" * 5000
    text = json.dumps(tree, ensure_ascii=True).encode()
    if not is_binary:
        return text
    text += b" " * (-len(text) % 4)
    rest = content[20 + length :]
    size = 20 + len(text) + len(rest)
    return struct.pack("<4s2I2I", b"glTF", 2, size, len(text), 0x4E4F534A) + text + rest


def _place(random: Random, tree: Any) -> tuple[Any, Any]:  # noqa: ANN401 - JSON
    """A list or object somewhere in a JSON tree, and one of its indices or keys."""
    holder: Any = {"": tree}
    key: Any = ""
    while isinstance(holder[key], (dict, list)) and holder[key] and random.random() < 0.8:
        holder = holder[key]
        key = random.choice(list(holder) if isinstance(holder, dict) else range(len(holder)))
    return holder, key


def _change(random: Random, holder: Any, key: Any) -> None:  # noqa: ANN401 - JSON
    kind = random.randrange(6)
    if kind == 0:
        del holder[key]
    elif kind == 1 and isinstance(holder[key], list):
        holder[key] = holder[key] * random.choice((2, 2000))
    elif kind == 2 and isinstance(holder, dict):
        holder[random.choice(("byteStride", "byteOffset", "mode", "sparse", "children"))] = (
            random.choice(VALUES)
        )
    elif kind == 3 and isinstance(holder[key], int):
        holder[key] += random.choice((-1, 1, 2))
    else:
        holder[key] = random.choice(VALUES)


def _archive_changed(random: Random, content: bytes) -> bytes:
    """Archive with one of its entries changed or compressed in another way."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = [(name, archive.read(name)) for name in archive.namelist()]
    except Exception:  # noqa: BLE001 - damaged already
        return _bytes_changed(random, content)
    if not entries:
        return content
    n = random.randrange(len(entries))
    name, body = entries[n]
    kind = random.randrange(12)
    if kind == 0:
        del entries[n]
    elif kind == 1:
        entries.append((name, body[: len(body) // 2]))
    elif kind == 2:
        entries[n] = (random.choice(("", "../x", "3d/3dmodel.model", "points", "a" * 500)), body)
    elif kind == 3 and random.random() < 0.05:
        entries[n] = (name, body[: len(body) // 2] + b" " * (40 << 20) + body[len(body) // 2 :])
    else:
        changes = (
            _bytes_changed,
            _numbers_changed,
            _elements_changed,
            _lines_changed,
            _cut_or_grown,
        )
        entries[n] = (name, random.choice(changes)(random, body))
    out = io.BytesIO()
    method = random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_DEFLATED, 12, 14))
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, body in entries:
            archive.writestr(name or "x", body)
    return out.getvalue()
