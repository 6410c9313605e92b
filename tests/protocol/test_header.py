import re
import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hapticdb.errors import ProtocolError
from hapticdb.protocol.fields import FieldsRead, FieldsWritten
from hapticdb.protocol.header import LAYOUT, CloseCode, Kind, MessageHeader, Refusal, header_of
from sources import ROOT

PAGE = (ROOT / "docs/protocol.md").read_text()
INT8 = st.integers(-(1 << 63), (1 << 63) - 1)


@given(kind=st.integers(0, 255), number=st.integers(0, (1 << 32) - 1), revision=INT8)
def test_a_header_returns_as_written(kind: int, number: int, revision: int) -> None:
    header = MessageHeader(kind, number, revision)
    assert header_of(header.packed()) == header


def test_a_header_has_the_bytes_that_the_page_gives() -> None:
    packed = MessageHeader(Kind.HELLO, 0x01020304, -1).packed()
    assert packed == b"hd\x01\x01\x04\x03\x02\x01" + b"\xff" * 8


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (b"", "a message of 0 bytes"),
        (b"hd\x01", "a message of 3 bytes"),
        (b"XX" + bytes(14), "does not begin with 'hd'"),
        (b"hd\x02" + bytes(13), "of version 2"),
    ],
)
def test_what_is_no_header_is_refused(message: bytes, words: str) -> None:
    with pytest.raises(ProtocolError, match=words):
        header_of(message)


def test_fields_return_as_written() -> None:
    values = np.array([3, -1, 1 << 62], dtype=np.int64)
    written = FieldsWritten().u1(7, 255).u2(65535).u4(1, 0xFFFFFFFF).i8(-5).f8(0.25)
    body = written.text("Tür").array(values, "<i8").joined()
    read = FieldsRead(body, 0)
    assert (read.u1(), read.u1(), read.u2(), read.u4(), read.u4()) == (7, 255, 65535, 1, 0xFFFFFFFF)
    assert (read.i8(), read.f8(), read.text()) == (-5, 0.25, "Tür")
    np.testing.assert_array_equal(read.i8s(3), values)
    read.end()


@given(st.binary(max_size=64))
def test_no_field_reads_past_the_end(body: bytes) -> None:
    """Whatever the bytes are, a field is read whole or refused."""
    for ask in (FieldsRead.text, FieldsRead.i8, lambda read: read.i8s(9), FieldsRead.f8):
        read = FieldsRead(body, 0)
        try:
            ask(read)
        except ProtocolError:
            continue
        assert read.left >= 0


def test_a_length_is_not_trusted() -> None:
    for length in (5, 1 << 20, 0xFFFFFFFF):
        with pytest.raises(ProtocolError):
            FieldsRead(struct.pack("<I", length) + b"four", 0).text()
    with pytest.raises(ProtocolError, match="after its last field"):
        FieldsRead(b"1", 0).end()
    with pytest.raises(ProtocolError, match="no UTF-8"):
        FieldsRead(b"\x01\x00\x00\x00\xff", 0).text()


def test_the_page_lists_all_refusals_and_close_codes() -> None:
    assert LAYOUT.size == 16
    for refusal in Refusal:
        assert f"| {refusal.value} | {refusal.name} |" in PAGE
    for code in CloseCode:
        assert re.search(rf"^\| {code.value} \| ", PAGE, re.MULTILINE)
