"""Damage to small valid files of every kind, and the end of loading each."""

import shutil
import signal
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from qs3.errors import QS3Error

from .kinds import KINDS

SECONDS = 60
GOOD = ("ok", "refused")
ENDS = (*GOOD, "several lines", "traceback", "hang")
_NUMBERS = [0, 1, *(2**bits - less for bits in (7, 8, 15, 16, 31, 32, 63, 64) for less in (0, 1))]
_WORDS = [b"nan", b"-1", b"1e999", b"x", b"null", b"[" * 10_000, b"9" * 5000, b"\xff\xfe", b""]


class End(NamedTuple):
    kind: str
    number: int
    end: str
    message: str


class _HangError(BaseException):
    """Not an Exception, so that no handler catches it."""


def attack(kinds: Sequence[str], folder: Path, count: int, seed: int = 0) -> Iterator[End]:
    """Damage a copy of a file of each kind in turn and load it, ``count`` times in all."""
    for number in range(count):
        kind = KINDS[name := kinds[number % len(kinds)]]
        valid, sample = folder / f"valid-{name}", folder / "sample"
        if not valid.exists():
            valid.mkdir()
            kind.build(valid / kind.name)
            kind.load(valid / kind.name)  # undamaged, it loads
        shutil.rmtree(sample, ignore_errors=True)
        shutil.copytree(valid, sample)
        files = sorted(path for path in sample.rglob("*") if path.is_file())
        rng = np.random.default_rng([seed, number])
        victim = files[int(rng.integers(len(files)))]
        victim.write_bytes(damaged(victim.read_bytes(), rng))
        yield End(name, number, *end_of(kind.load, sample / kind.name))


def end_of(load: Callable[..., Any], *arguments: Any) -> tuple[str, str]:
    """Call a function; return one of ``ENDS`` and the message."""

    def stop(*_: Any) -> None:
        raise _HangError

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(SECONDS)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            load(*arguments)
        return "ok", ""
    except QS3Error as error:
        return ("refused" if len(str(error).splitlines()) == 1 else "several lines"), str(error)
    except _HangError:
        return "hang", f"over {SECONDS} s"
    except Exception as error:
        return "traceback", f"{type(error).__name__}: {error}"
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """Change a file in one to three places; half of the hits go into its first 256 bytes."""
    for _ in range(int(rng.integers(1, 4))):
        end = min(256, len(data)) if rng.random() < 0.5 else len(data)
        at, size = int(rng.integers(max(end, 1))), int(rng.integers(1, 64))
        number = _NUMBERS[int(rng.integers(len(_NUMBERS)))] % 2**32
        change = [
            data[:at],
            data[:at] + data[at + size :],
            data[:at] + rng.bytes(size) + data[at:],
            data[:at] + data[at : at + size] * 2 + data[at + size :],
            data[:at] + number.to_bytes(4, "little") + data[at + 4 :],
            data[:at] + _WORDS[int(rng.integers(len(_WORDS)))] + data[at + 1 :],
            data[:at] + bytes([rng.integers(256)]) + data[at + 1 :],
        ]
        data = change[int(rng.integers(len(change)))]
    return data
