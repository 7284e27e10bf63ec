"""Damage to files, as disks, networks, editors and malice make it."""

import re

import numpy as np

_NUMBERS = [0, 1, *(2**bits - less for bits in (7, 8, 15, 16, 31, 32, 63, 64) for less in (0, 1))]
_WORDS = (
    b"nan inf -1 0 1.5 1e12 1e999 1e-400 -2147483649 99999999999999999999 \xff\xfe .. / "
    b'../../etc/passwd null true [] {} [1] "x" "\\ud800" \x00 \x1b[2J "'
).split(b" ")
_WORDS += [b"", b"9" * 5000, b"[" * 100_000]


def mutate(data: bytes, rng: np.random.Generator) -> bytes:
    """Damage a file in one to three places."""
    for _ in range(int(rng.integers(1, 4))):
        data = _WAYS[int(rng.integers(len(_WAYS)))](data, rng)
    return data


def _place(data: bytes, rng: np.random.Generator) -> int:
    # Headers are short and matter most: half of the hits go into the first 256 bytes.
    end = min(256, len(data)) if rng.random() < 0.5 else len(data)
    return int(rng.integers(max(end, 1)))


def _flip(data: bytes, rng: np.random.Generator) -> bytes:
    changed = bytearray(data)
    for _ in range(int(rng.integers(1, 9))):
        if changed:
            changed[_place(data, rng)] ^= 1 << int(rng.integers(8))
    return bytes(changed)


def _number(data: bytes, rng: np.random.Generator) -> bytes:
    at, size = _place(data, rng), int(rng.choice([1, 2, 4, 8]))
    value = _NUMBERS[int(rng.integers(len(_NUMBERS)))] % 2 ** (8 * size)
    order = "little" if rng.random() < 0.8 else "big"
    return data[:at] + value.to_bytes(size, order) + data[at + size :]


def _cut(data: bytes, rng: np.random.Generator) -> bytes:
    return data[: int(rng.integers(len(data) + 1))]


def _remove(data: bytes, rng: np.random.Generator) -> bytes:
    at = _place(data, rng)
    return data[:at] + data[at + int(rng.integers(1, 64)) :]


def _insert(data: bytes, rng: np.random.Generator) -> bytes:
    at = _place(data, rng)
    return data[:at] + rng.bytes(int(rng.integers(1, 32))) + data[at:]


def _repeat(data: bytes, rng: np.random.Generator) -> bytes:
    at, size = _place(data, rng), int(rng.integers(1, 256))
    return data[:at] + data[at : at + size] * 2 + data[at + size :]


def _word(data: bytes, rng: np.random.Generator) -> bytes:
    """Replace one number, name or quoted text of a text file."""
    words = list(re.finditer(rb'"[^"]*"|[-+.\w]+', data[:65536]))
    if not words:
        return _flip(data, rng)
    at = words[int(rng.integers(len(words)))]
    word = _WORDS[int(rng.integers(len(_WORDS)))]
    return data[: at.start()] + word + data[at.end() :]


_WAYS = [_flip, _number, _cut, _remove, _insert, _repeat, _word]
