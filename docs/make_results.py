"""Copies records and tables of a reproduction into results/, without its data and runs.

Run:  python docs/make_results.py OUT NAME        into results/NAME
      python docs/make_results.py results/NAME NAME   writes the tables anew

Tables are written from the records; those that wait for runs are left out.
"""

import argparse
import shutil
from dataclasses import replace
from pathlib import Path

from qs3.experiments import GALLERIES, TABLES
from qs3.experiments.setup import MARKER, RESULTS, read_setup
from qs3.experiments.table import Table
from qs3.files import write_bytes

ROOT = Path(__file__).parents[1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("name")
    options = parser.parse_args()
    folder = ROOT / "results" / options.name
    for path in [options.out / MARKER, *sorted((options.out / RESULTS).glob("*.json"))]:
        write_bytes(folder / path.relative_to(options.out), path.read_bytes())
    pictures = options.out / GALLERIES
    if pictures.is_dir() and pictures.resolve() != (folder / GALLERIES).resolve():
        shutil.copytree(pictures, folder / GALLERIES, dirs_exist_ok=True)
    for name in TABLES:
        filled = Table(name, read_setup(folder)).read()
        if filled.faults or not filled.records:
            print(f"{name}: left out", *filled.faults)
        else:
            # Of the rows and columns alone that have records.
            places = [place for place in filled.runs if filled.records_of(place)]
            rows, columns = (tuple(dict.fromkeys(place[i] for place in places)) for i in (0, 1))
            print(replace(filled.table, rows=rows, columns=columns).write())


if __name__ == "__main__":
    main()
