import pytest
from hypothesis import given
from hypothesis import strategies as st

from hapticdb.errors import ProtocolError
from hapticdb.protocol.header import Kind, MessageHeader, header_of
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
