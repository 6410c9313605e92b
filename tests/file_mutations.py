"""Damages files: their bytes, numbers and lines, and the structure of JSON, XML and archives."""

import io
import json
import re
import struct
import zipfile
from collections.abc import Callable
from random import Random
from typing import Any

TEXTS = {".obj", ".off", ".stl", ".ply", ".dae", ".ifc", ".step", ".stp", ".csv", ".gltf"}
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
_VALUE = re.compile(rb'(?<=: )("[^"]*"|[-\d.e]+|true|false)|(?<=\[)[-\d.e]+')
_PAIR = re.compile(rb'"\w+": ("[^"]*"|[-\d.e]+|\[[^\[\]]*\]), ')
_LIST = re.compile(rb"\[([^\[\]]+)\]")
_ELEMENT = re.compile(rb"<(\w+)[^<>]*(?:/>|>[^<]*</\1>)")


def mutated(random: Random, suffix: str, content: bytes, other: bytes) -> bytes:
    """Content with one to three damages. `other` is a file of the same format."""
    choices: list[Callable[[Random, bytes], bytes]] = [_bytes_changed, _cut_or_grown]
    choices += [_numbers_changed, _lines_changed] * (2 * (suffix in TEXTS))
    choices += [_json_changed] * (4 * (suffix in {".gltf", ".glb"}))
    choices += [_elements_changed] * (2 * (suffix in {".dae", ".3mf"}))
    choices += [_archive_changed] * (5 * (suffix in {".3mf", ".npz"}))
    choices += [_header_changed] * (2 * (suffix in {".las", ".laz", ".stl", ".hdbrec", ".glb"}))
    for _ in range(random.choice((1, 1, 1, 2, 3))):
        if random.random() < 0.04:  # spliced
            cut = random.randrange(len(content) + 1)
            content = content[:cut] + other[random.randrange(len(other) + 1) :]
        content = random.choice(choices)(random, content)
    return content


def _bytes_changed(random: Random, content: bytes) -> bytes:
    found = bytearray(content)
    for _ in range(random.choice((1, 1, 2, 8)) if content else 0):
        at = random.randrange(len(found))
        if random.random() < 0.5:
            found[at] ^= 1 << random.randrange(8)
        else:
            extreme = random.choice(BYTES)
            found[at : at + len(extreme)] = extreme
    return bytes(found)


def _header_changed(random: Random, content: bytes) -> bytes:
    at, extreme = random.randrange(min(len(content), 400) or 1), random.choice(BYTES)
    return content[:at] + extreme + content[at + len(extreme) :]


def _cut_or_grown(random: Random, content: bytes) -> bytes:
    first, last = sorted(random.randrange(len(content) + 1) for _ in range(2))
    grown = random.randbytes(random.choice((1, 4, 100)))
    return content[:first] + random.choice(
        (b"", content[last:], content[first:last] + content[first:], grown + content[first:])
    )


def _numbers_changed(random: Random, content: bytes) -> bytes:
    places = list(_NUMBER.finditer(content))
    chosen = random.sample(places, min(len(places), random.choice((1, 1, 3))))
    for place in sorted(chosen, key=lambda found: -found.start()):
        word = random.choice(WORDS).encode()
        content = content[: place.start()] + word + content[place.end() :]
    return content


def _lines_changed(random: Random, content: bytes) -> bytes:
    lines = content.split(b"\n")
    n, m = random.randrange(len(lines)), random.randrange(len(lines))
    words = lines[n].split(b" ")
    del words[random.randrange(len(words))]
    noise = random.choice((b" #c", b"\\", b" 1", b"\r", b"\0", b"\xff", b" " * 5000))
    opened = b"".join(random.choice((b"(", b"[", b"<a>", b'"')) for _ in range(3000))
    lines[n : n + 1] = random.choice(
        (
            [], [lines[n]] * random.choice((2, 4, 2000)), [lines[m]], [b" ".join(words)],
            [lines[n] + noise], [lines[n] * random.choice((2, 500))], [opened],
        )
    )  # fmt: skip
    return b"\n".join(lines)


def _elements_changed(random: Random, content: bytes) -> bytes:
    elements = list(_ELEMENT.finditer(content))
    if not elements:
        return content
    one, two = random.choice(elements), random.choice(elements)
    if random.random() < 0.2:
        depth = random.choice((3, 3000))
        return content[: one.start()] + b"<a>" * depth + one[0] + b"</a>" * depth
    stripped = re.sub(rb' \w+="[^"]*"', b"", one[0], count=1)
    new = random.choice((b"", one[0] * random.choice((2, 1000)), two[0], stripped))
    return content[: one.start()] + new + content[one.end() :]


def _json_changed(random: Random, content: bytes) -> bytes:
    """Value replaced, pair dropped, or list repeated, in a glTF file or the JSON of a GLB file."""
    start = 20 if content[:4] == b"glTF" else 0
    end = start + int.from_bytes(content[12:16], "little") if start else len(content)
    text = content[start:end]
    places = list(random.choice((_VALUE, _VALUE, _PAIR, _LIST)).finditer(text))
    if places:
        one = random.choice(places)
        values = [json.dumps(value).encode() for value in VALUES]
        repeated = b"[" + b", ".join([one[one.lastindex or 0]] * random.choice((2, 2000))) + b"]"
        new = {_VALUE: random.choice(values), _PAIR: b"", _LIST: repeated}[one.re]
        text = text[: one.start()] + new + text[one.end() :]
    if not start:
        return text
    text += b" " * (-len(text) % 4)
    size = 20 + len(text) + len(content[end:])
    return struct.pack("<4s2I2I", b"glTF", 2, size, len(text), 0x4E4F534A) + text + content[end:]


def _archive_changed(random: Random, content: bytes) -> bytes:
    """Archive with one of its entries changed or compressed in another way."""
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            entries = [(name, archive.read(name)) for name in archive.namelist()]
        n = random.randrange(len(entries))
    except Exception:  # noqa: BLE001 - damaged already
        return _bytes_changed(random, content)
    name, body = entries[n]
    kind, half = random.randrange(12), len(body) // 2
    changes = _bytes_changed, _numbers_changed, _elements_changed, _lines_changed, _cut_or_grown
    if kind == 0:
        del entries[n]
    elif kind == 1:
        entries.append((name, body[:half]))
    elif kind == 2:
        entries[n] = (random.choice(("x", "../x", "3d/3dmodel.model", "points", "a" * 500)), body)
    elif kind == 3 and random.random() < 0.05:
        entries[n] = (name, body[:half] + b" " * (40 << 20) + body[half:])
    else:
        entries[n] = (name, random.choice(changes)(random, body))
    out = io.BytesIO()
    method = random.choice((zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED, zipfile.ZIP_DEFLATED, 12, 14))
    with zipfile.ZipFile(out, "w", method) as archive:
        for name, body in entries:
            archive.writestr(name, body)
    return out.getvalue()
