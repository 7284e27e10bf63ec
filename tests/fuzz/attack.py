"""Hostile files against the package's readers, in a process of its own that may die of them.

``python -m tests.fuzz.attack FOLDER SEED FIRST LAST NAME…`` is that process: sample i is a damaged
copy of a layout, or a hand-made case, NAME[i % n]; what becomes of it is told line by line.
"""

import contextlib
import json
import os
import resource
import shutil
import signal
import subprocess
import sys
import warnings
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from .cases import CASES
from .layouts import LAYOUTS
from .mutate import mutate

ROOT = Path(__file__).parents[2]
SECONDS = 20
BYTES = 4 * 2**30
KINDS = (
    *("ok", "refused", "several lines", "printed", "traceback", "over memory"),
    *("unpickled", "wrote outside", "hang", "died"),
)
"""Ends; the first two are good ones, the last two end the process."""

_WRITES = ("os.remove", "os.rename", "os.rmdir", "os.mkdir")
_watch: dict[str, Any] = {"inside": (), "seen": ""}


def attack(names: Sequence[str], folder: Path, count: int, seed: int = 0) -> list[dict[str, Any]]:
    """Try ``count`` samples; return for each its number, name, kind of end and message."""
    ends: list[dict[str, Any]] = []
    while len(ends) < count:
        words = [str(folder), str(seed), str(len(ends)), str(count), *names]
        command = [sys.executable, "-B", "-m", "tests.fuzz.attack", *words]
        done = subprocess.run(
            command, cwd=ROOT, env=os.environ | _own(folder), capture_output=True, text=True,
            check=False,
        )  # fmt: skip
        lines = [json.loads(line) for line in done.stdout.splitlines()]
        ends += [line for line in lines if "kind" in line]
        if not lines or (done.returncode and "kind" in lines[-1]):
            raise AssertionError(f"the process failed outside a sample: {done.stderr[-2000:]}")
        if "kind" not in lines[-1]:
            hang = -done.returncode in (signal.SIGALRM, signal.SIGPROF)
            kind = "hang" if hang else "died"
            message = f"{done.returncode} {done.stderr[-300:]}"
            ends.append(lines[-1] | {"kind": kind, "message": message})
    return ends


def _own(folder: Path) -> dict[str, str]:
    """Make places where libraries may keep what they like."""
    own = folder / "own"
    own.mkdir(parents=True, exist_ok=True)
    names = ("TMPDIR", "HOME", "XDG_CACHE_HOME", "MPLCONFIGDIR", "TORCHINDUCTOR_CACHE_DIR")
    names += ("NUMBA_CACHE_DIR",)
    return dict.fromkeys(names, str(own)) | {"COLUMNS": "200"}


def _audit(event: str, arguments: tuple[Any, ...]) -> None:
    """Note what is written beyond the sample's folder, and what is unpickled."""
    if not _watch["inside"]:
        return
    if event == "pickle.find_class" and not _is_own_code():
        _watch["seen"] = f"unpickled {arguments}"
    opens = event == "open" and arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
    if (event in _WRITES or opens) and isinstance(arguments[0], str | bytes | Path):
        # Relative to an open folder, where the last argument is one's number.
        above = f"/proc/self/fd/{arguments[-1]}" if event in _WRITES and arguments[-1] >= 0 else ""
        path = Path(os.path.realpath(Path(above, os.fsdecode(arguments[0]))))
        if not any(path.is_relative_to(own) for own in _watch["inside"]):
            _watch["seen"] = f"wrote outside {event} {path}"


def _is_own_code() -> bool:
    """Whether numba is at its own work, on code that is ours: it reads no file of a stranger."""
    frame = sys._getframe()
    while frame is not None:
        if str(frame.f_globals.get("__name__")).startswith("numba."):
            return True
        frame = frame.f_back
    return False


@contextlib.contextmanager
def _printed(file: Path) -> Iterator[None]:
    """Send both streams, those of libraries in C too, into a file."""
    kept = [os.dup(number) for number in (1, 2)]
    handle = os.open(file, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    try:
        for number in (1, 2):
            os.dup2(handle, number)
        yield
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        for number, own in zip((1, 2), kept, strict=True):
            os.dup2(own, number)
            os.close(own)
        os.close(handle)


def _memory(error: BaseException | None) -> bool:
    while error is not None:
        if isinstance(error, MemoryError):
            return True
        error = error.__cause__ or error.__context__
    return False


def _try(load: Any, place: Path, sample: Path) -> tuple[str, str]:
    """Load one sample; return how it ended."""
    from qs3.errors import QS3Error

    inside = (sample, sample.parent / "own", "/dev")
    _watch.update(inside=[os.path.realpath(path) for path in inside], seen="")
    try:
        with _printed(sample / ".printed"):
            load(place)
        kind, message = "ok", ""
    except QS3Error as error:
        message = str(error)
        kind = "refused" if len(message.splitlines()) == 1 else "several lines"
        if _memory(error) and "takes over" not in message:
            kind = "over memory"
    except MemoryError as error:
        kind, message = "over memory", str(error)
    except BaseException as error:
        kind, message = "traceback", f"{type(error).__name__}: {error}"
    finally:
        _watch["inside"] = ()
    for fault in ("unpickled", "wrote outside"):
        if _watch["seen"].startswith(fault):
            return fault, _watch["seen"]
    printed = (sample / ".printed").read_text(errors="replace")
    return ("printed", printed) if printed and kind in ("ok", "refused") else (kind, message)


def _damaged(name: str, valid: Path, sample: Path, rng: np.random.Generator) -> tuple[Any, Path]:
    """Copy a valid data set and damage one of its files."""
    layout = LAYOUTS[name]
    if not valid.exists():
        layout.build(valid)
        layout.load(layout.path(valid))  # as it is, it must load
    data = sample / "data"
    shutil.copytree(valid, data)
    files = sorted(path for path in data.rglob("*") if path.is_file())
    victim = files[int(rng.integers(len(files)))]
    victim.write_bytes(mutate(victim.read_bytes(), rng))
    return layout.load, layout.path(data)


def main(folder: Path, seed: int, first: int, last: int, names: Sequence[str]) -> None:
    """Try the samples from ``first`` to ``last``."""
    if any("run" in name for name in names):
        import torch  # the room of its libraries is not the sample's

        torch.ones(64, 64) @ torch.ones(64, 64)
    pages = int(Path("/proc/self/statm").read_text().split()[0]) if sys.platform == "linux" else 0
    used = pages * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + BYTES, resource.RLIM_INFINITY))
    warnings.simplefilter("error")
    sys.addaudithook(_audit)
    for number in range(first, last):
        name = names[number % len(names)]
        sample = folder / "sample"
        shutil.rmtree(sample, ignore_errors=True)
        sample.mkdir(parents=True)
        print(json.dumps({"sample": number, "name": name}), flush=True)
        if name in CASES:
            load, place = CASES[name].act, sample
        else:
            rng = np.random.default_rng([seed, number])
            load, place = _damaged(name, folder / f"valid-{name}", sample, rng)
        # Processor seconds, for machines that are busy; nothing can catch these two signals.
        signal.setitimer(signal.ITIMER_PROF, SECONDS)
        signal.alarm(30 * SECONDS)
        kind, message = _try(load, place, sample)
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.alarm(0)
        line = {"sample": number, "name": name, "kind": kind, "message": message[:300]}
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    place, start, low, high, *given = sys.argv[1:]
    main(Path(place), int(start), int(low), int(high), given)
