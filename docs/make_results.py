"""Copies records and tables of a reproduction into results/, without its data and runs.

Run:  python docs/make_results.py OUT NAME        into results/NAME

Tables of the paper are written anew from the records; those that wait for runs are left out.
"""

import argparse
import dataclasses
import shutil
from pathlib import Path

from qs3.experiments.paper import EXPERIMENTS, PaperTable

from qs3.experiments.setup import MARKER, read_setup
from qs3.files import write_bytes, write_text

ROOT = Path(__file__).parents[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("name")
    options = parser.parse_args()
    folder = ROOT / "results" / options.name
    for path in sorted((options.out / "results").glob("*.json")):
        write_bytes(folder / "results" / path.name, path.read_bytes())
    write_bytes(folder / MARKER, (options.out / MARKER).read_bytes())
    for path in sorted(options.out.glob("adaptation-*.*")):
        write_bytes(folder / path.name, path.read_bytes())
    if (options.out / "galleries").is_dir():
        shutil.copytree(options.out / "galleries", folder / "galleries", dirs_exist_ok=True)
    setup = read_setup(folder)
    for name, experiment in EXPERIMENTS.items():
        part = PaperTable(experiment, setup)
        grid, faults = part.grid()
        cells = [place for place, cell in grid.cells.items() if cell.accuracies]
        if faults or not cells:
            print(f"{name}: left out", *faults)
            continue
        rows, columns = ({place[i] for place in cells} for i in (0, 1))
        part = dataclasses.replace(part, rows=tuple(sorted(rows)), columns=tuple(sorted(columns)))
        grid, _ = part.grid()
        for kind in ("md", "csv", "tex"):
            write_text(folder / f"{name}.{kind}", part.text(grid, kind))
        write_bytes(folder / f"{name}.png", part.picture(grid, "png"))
        print(f"{name}: {len(cells)} cells")


if __name__ == "__main__":
    main()
