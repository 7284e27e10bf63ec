"""Helpers of tests about damaged files."""

import contextlib
import struct
import zlib
from collections.abc import Iterator

import pytest

from qs3.errors import InputError


@contextlib.contextmanager
def refused(message: str, *names: object) -> Iterator[None]:
    """What is done within is refused in one line that holds the names."""
    with pytest.raises(InputError, match=message) as caught:
        yield
    text = str(caught.value)
    assert "\n" not in text
    assert all(str(name) in text for name in names), text


def png_bytes(width, height, bits=16, colour=0, data=b"\0" * 32):
    """A PNG whose header may announce anything."""

    def chunk(name, body):
        check = struct.pack(">I", zlib.crc32(name + body))
        return struct.pack(">I", len(body)) + name + body + check

    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    parts = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + parts
