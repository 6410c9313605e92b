"""Decoding of text files (UTF-8, UTF-16, UTF-32, GB18030, Windows-1252); units named in text."""

import codecs
import re
from contextlib import suppress

from hapticdb.units import NAMES, UNITS

_MARKS = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_DECLARED = re.compile(rb"<\?xml[^>]*encoding=[\"']([\w.-]+)")
_SAMPLE = 64
"""Leading bytes checked for UTF-16 without a byte order mark."""
_NOT_ASCII = re.compile(rb"[\x80-\xff]+")
_COMMON = re.compile(rb"(?:[\xb0-\xd7][\xa1-\xfe])+")
"""Common Chinese characters in GB18030. In Latin-1 text few words consist of such byte pairs
alone."""

_UNIT = re.compile(
    r"\bunits?(?: used in this file)?[ \t]*(?:[=:]|\b(?:in|is|are)\b)[ \t]*(?:in[ \t]+)?"
    r"([a-z]+)(?![\w/^*-])"
    r"|\buses ([a-z]+) as units\b",
    re.IGNORECASE,
)
"""Unit in a comment, as by Maya and SketchUp, or in a sentence such as 'the units are in metres'.
Neither a name such as 'foot unit' nor units of areas or speeds such as mm/s match."""
_LENGTHS = UNITS | {"inch": UNITS["in"], "foot": UNITS["ft"]}
_LENGTHS |= {word: UNITS[sign] for sign, name in NAMES.items() for word in (name, name[:-1])}


def unit_in(text: str) -> tuple[str, float | None]:
    """Unit statement in a text, and the unit's length, metres; '' and None without one."""
    for found in _UNIT.finditer(text):
        length = unit_length(found[1] or found[2])
        if length is not None:
            return found[0], length
    return "", None


def unit_length(word: str) -> float | None:
    """Length, metres, of a unit by its name or symbol; None for other words."""
    return _LENGTHS.get(word.lower().replace("meter", "metre"))


def recoded(content: bytes) -> bytes:
    """Content without a byte order mark, UTF-16 and UTF-32 as UTF-8; other content unchanged."""
    for mark, name in _MARKS:
        if content.startswith(mark):
            return content.decode(name, "replace").encode()
    head = content[:_SAMPLE]
    for name, zeros, letters in (("utf-16-le", head[1::2], head[::2]),
                                 ("utf-16-be", head[::2], head[1::2])):  # fmt: skip
        if len(head) > 3 and not any(zeros) and all(letters):
            return content.decode(name, "replace").encode()
    return content


def xml_of(content: bytes) -> bytes:
    """XML as UTF-8, decoded by its declared encoding, or by `text_of` if that fails."""
    plain = recoded(content)
    declared = _DECLARED.match(plain)
    if plain is content and declared is not None:
        with suppress(LookupError, UnicodeError):
            text = plain.decode(declared[1].decode())
            if text.startswith("<"):
                return text.encode()
    return text_of(plain).encode()


def text_of(content: bytes) -> str:
    """Decoded text: UTF-8; else GB18030 if most runs of other bytes fit it, else Windows-1252."""
    plain = recoded(content)
    try:
        return plain.decode()
    except UnicodeDecodeError:
        pass
    words = _NOT_ASCII.findall(plain)
    is_chinese = sum(_COMMON.fullmatch(word) is not None for word in words) * 2 > len(words)
    return plain.decode("gb18030" if is_chinese else "cp1252", "replace")
