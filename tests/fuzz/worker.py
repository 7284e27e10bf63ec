"""Load damaged copies of one valid data set after another; told on standard output, line by line.

python worker.py LAYOUT FOLDER FIRST LAST: each sample has its own seed, so one can be repeated.
"""

import json
import resource
import shutil
import signal
import sys
import warnings
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent))

from layouts import LAYOUTS
from mutate import mutate

from qs3.errors import QS3Error

SECONDS = 20
BYTES = 12 * 2**30


class TooLongError(BaseException):
    """A sample took too long; no handler of exceptions may swallow it."""


def too_long(*_: object) -> None:
    raise TooLongError


def main() -> None:
    name, folder, first, last = sys.argv[1], Path(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4])
    layout = LAYOUTS[name]
    valid = folder / "valid"
    if not valid.exists():
        layout.build(valid)
    layout.load(layout.path(valid))  # as it is, it must load
    files = sorted(path.relative_to(valid) for path in valid.rglob("*") if path.is_file())
    resource.setrlimit(resource.RLIMIT_AS, (BYTES, BYTES))
    signal.signal(signal.SIGALRM, too_long)
    warnings.simplefilter("error")
    for sample in range(first, last):
        rng = np.random.default_rng([sample, sum(name.encode())])
        damaged = folder / f"damaged-{first}"
        shutil.rmtree(damaged, ignore_errors=True)
        shutil.copytree(valid, damaged)
        victim = damaged / files[int(rng.integers(len(files)))]
        victim.write_bytes(mutate(victim.read_bytes(), rng))
        print(json.dumps({"sample": sample}), flush=True)
        line = {"sample": sample, "file": str(files and victim.relative_to(damaged))}
        signal.alarm(SECONDS)
        try:
            layout.load(layout.path(damaged))
            line["end"] = "read"
        except QS3Error as error:
            lines = str(error).splitlines()
            line |= {"end": "refused", "lines": len(lines), "message": str(error)[:200]}
        except TooLongError:
            line |= {"end": f"took over {SECONDS} s"}
        except BaseException as error:
            line |= {"end": f"{type(error).__name__}: {error}"[:300]}
        signal.alarm(0)
        print(json.dumps(line), flush=True)


if __name__ == "__main__":
    main()
