"""Lines of each room of the package, against its budget.

Counts lines as ``wc`` does, in the Python files that git tracks. A budget is a guide: a room above
it is looked at twice.

    python benchmarks/lines.py [--at REVISION] [--files]
"""

import argparse
import subprocess
from collections import defaultdict
from pathlib import Path

ROOT = Path(__file__).parents[1]
REST = "errors, files, settings"
"""Modules of the package itself, outside of its rooms."""
BUDGETS = {
    "cli": 1800, "paper": 5800, "report": 1500, "workflow": 600, "answers": 1300, "parts": 1600,
    "training": 2300, "runs": 750, "adaptation": 350, "models": 1500, "evaluation": 550,
    "objects": 900, "frames": 1100, "clouds": 1500, "store": 1400, "sensor": 5800, "meshes": 2200,
    "shapes": 3550, "points": 250, REST: 800,
}  # fmt: skip
OTHERS = {"tests": 24_000, "benchmarks": 3000}
LARGE = 300
"""Lines from which on a file is looked at twice."""


def count(folder: str, revision: str | None) -> dict[str, int]:
    """Return the lines of each Python file below a folder, now or at a revision."""
    command = ["git", "grep", "-c", "", *([revision] if revision else []), "--", f"{folder}/*.py"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    pairs = (line.rpartition(":") for line in done.stdout.splitlines())
    return {path.removeprefix(f"{revision}:"): int(number) for path, _, number in pairs}


def row(name: str, lines: int, budget: int) -> str:
    """Return a line of the table."""
    return f"| {name} | {lines:,} | {budget:,} | {lines - budget:+,} |"


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--at", metavar="REVISION", help="a commit; default: the files as they are")
    parser.add_argument("--files", action="store_true", help=f"list files of {LARGE} lines or more")
    options = parser.parse_args()
    rooms: dict[str, int] = defaultdict(int)
    files = count("src/qs3", options.at)
    for path, lines in files.items():
        inner = Path(path).relative_to("src/qs3").parts
        rooms[inner[0] if len(inner) > 1 else REST] += lines
    print("| room | lines | budget | over |\n|---|---|---|---|")
    for name in [*BUDGETS, *sorted(rooms.keys() - BUDGETS.keys())]:
        print(row(name, rooms[name], BUDGETS.get(name, 0)))
    whole, paper = sum(rooms.values()), rooms["paper"]
    print(row("without paper", whole - paper, 30_500))
    print(row("all", whole, 36_500))
    for name, budget in OTHERS.items():
        print(row(name, sum(count(name, options.at).values()), budget))
    if options.files:
        large = sorted((lines, path) for path, lines in files.items() if lines >= LARGE)
        print(*(f"{lines} {path}" for lines, path in reversed(large)), sep="\n")


if __name__ == "__main__":
    main()
