"""``qs3 demo`` with several seeds: parts, scans and forests are drawn anew for each.

Run: python benchmarks/demo.py --out out/demo [--seeds 0 1 2]

``demo.md`` has the shares of right answers and their median. What is in --out is not made again.
"""

import csv
from pathlib import Path

import numpy as np
from adapt import HERE, run
from common import arguments, keep

ROWS = {
    "surfaces": "forest of CAD surfaces",
    "forest": "forest of simulated scans",
    "locate": "CAD alone",
    "mine/answers": "forest and CAD",
    "few": "forest, CAD and 24 labels, on the other 72 scans",
}


def main() -> None:
    options = arguments(__doc__, "out", seeds=(0, 1, 2)).parse_args()
    for seed in options.seeds:
        run(HERE, "demo", "--seed", seed, "--out", options.out / f"seed-{seed}")
    numbers = [f"seed {seed}" for seed in options.seeds]
    lines = [" | ".join(["| right, %", *numbers, "median |"]), "|---" * (len(numbers) + 2) + "|"]
    for name, text in ROWS.items():
        shares = []
        for seed in options.seeds:
            place = options.out / f"seed-{seed}"
            labelled = (
                {row["file"] for row in rows_of(place / "labels.csv")} if name == "few" else ()
            )
            shares.append(right(place / f"{name}.csv", labelled))
        cells = [f"{100 * share:.1f}" for share in (*shares, np.median(shares))]
        lines.append(" | ".join([f"| {text}", *cells]) + " |")
    keep(options, "demo", lines)


def right(answers: Path, left_out: set[str] | tuple[()]) -> float:
    """Return the share of right answers; a scan's folder has the name of its class."""
    rows = [row for row in rows_of(answers) if row["file"] not in left_out]
    return float(np.mean([row["class"] == Path(row["file"]).parent.name for row in rows]))


def rows_of(table: Path) -> list[dict[str, str]]:
    with table.open(encoding="utf-8", newline="") as file:
        return [*csv.DictReader(file)]


if __name__ == "__main__":
    main()
