"""``python -m tests.fuzz --count N --seed S``: damaged files of every kind, and how each ended."""

import argparse
import tempfile
from collections import Counter
from pathlib import Path

from .attack import KINDS, attack
from .layouts import LAYOUTS


def main() -> None:
    """Print a table of ends by kind, and the bad ones."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--count", type=int, default=1500)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", nargs="+", choices=tuple(LAYOUTS), default=tuple(LAYOUTS))
    given = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        ends = attack(given.only, Path(folder), given.count, given.seed)
    counts = Counter((end["name"], end["kind"]) for end in ends)
    kinds = [kind for kind in KINDS if any(key[1] == kind for key in counts)]
    print(f"{'files':26}", *(f"{kind:>13}" for kind in kinds))
    for name in given.only:
        print(f"{name:26}", *(f"{counts[name, kind]:13}" for kind in kinds))
    totals = Counter(end["kind"] for end in ends)
    print(f"{'all':26}", *(f"{totals[kind]:13}" for kind in kinds))
    for end in ends:
        if end["kind"] not in ("ok", "refused"):
            print(end)


if __name__ == "__main__":
    main()
