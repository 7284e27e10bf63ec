"""Damaged and hostile files: whatever is done to them, they are read or refused in one line."""

import contextlib
import struct
import zlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
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


def mutated(content: bytes, rng: np.random.Generator) -> bytes:
    """Change some bytes, half of them in the header; or cut, double or drop a part."""
    bad = bytearray(content)
    begin, end = sorted(rng.integers(0, len(bad), 2).tolist())
    kind = rng.integers(7)
    if kind == 0:
        del bad[end:]
    elif kind == 1:
        del bad[begin:end]
    elif kind == 2:
        bad[begin:begin] = bad[begin:end]
    elif kind == 3:
        bad[begin:begin] = bytes(rng.integers(48, 58, int(rng.integers(1, 12))).tolist())
    else:
        for place in rng.integers(0, len(bad), rng.integers(1, 8)).tolist():
            place = place % 160 if rng.random() < 0.5 else place
            bad[min(place, len(bad) - 1)] = rng.choice([0, 1, 127, 128, 255, rng.integers(256)])
    return bytes(bad)


def fuzz(
    paths: Sequence[Path],
    read: Callable[[Path], object],
    rng: np.random.Generator,
    rounds: int,
    damage: Callable[[bytes, np.random.Generator], bytes] = mutated,
) -> None:
    """Damage one file after another; enough are refused to show that the damage matters."""
    good = [path.read_bytes() for path in paths]
    count = 0
    for number in range(rounds):
        path, content = paths[number % len(paths)], good[number % len(paths)]
        path.write_bytes(damage(content, rng))
        try:
            read(path)
        except InputError as error:
            assert "\n" not in str(error)
            count += 1
        path.write_bytes(content)
    assert count > rounds / 20


def png_bytes(width, height, bits=16, colour=0, data=b"\0" * 32):
    """A PNG whose header may announce anything."""

    def chunk(name, body):
        check = struct.pack(">I", zlib.crc32(name + body))
        return struct.pack(">I", len(body)) + name + body + check

    header = struct.pack(">IIBBBBB", width, height, bits, colour, 0, 0, 0)
    parts = chunk(b"IHDR", header) + chunk(b"IDAT", zlib.compress(data)) + chunk(b"IEND", b"")
    return b"\x89PNG\r\n\x1a\n" + parts
