"""``python -m tests.fuzz --count N --seed S``: load damaged files of every kind, count the ends."""

import argparse
import tempfile
from collections import Counter
from pathlib import Path

from .attack import ENDS, GOOD, attack
from .kinds import KINDS


def main() -> None:
    """Print a table of ends by kind, after the bad ones."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=tuple(KINDS), default=tuple(KINDS))
    options = parser.parse_args()
    counts: Counter[tuple[str, str]] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        for end in attack(options.only, Path(folder), options.count, options.seed):
            counts[end.kind, end.end] += 1
            if end.end not in GOOD:
                print(end)
    print(f"{'kind':12}", *(f"{end:>13}" for end in ENDS))
    for kind in options.only:
        print(f"{kind:12}", *(f"{counts[kind, end]:13}" for end in ENDS))


if __name__ == "__main__":
    main()
