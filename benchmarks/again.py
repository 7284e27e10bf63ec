"""All tables of the paper again: scans, trainings, records, tables. A stopped command resumes.

Run: python benchmarks/again.py --out again [--folders full-300 ...] [--workers 2] [--dry-run]
     python benchmarks/again.py --hours

--out gets a folder for each of results/ that `qs3 reproduce` made. The second command writes
results/hours.md from the records: what each table took.
"""

import argparse
import shlex
import sys
from collections.abc import Mapping
from pathlib import Path

from qs3.cli import run
from qs3.files import write_bytes, write_text
from qs3.paper import TABLES
from qs3.paper.domains import DATA
from qs3.paper.setup import MARKER, read_setup
from qs3.paper.table import Table

RESULTS = Path(__file__).resolve().parents[1] / "results"
PLAN: Mapping[str, tuple[str, ...]] = {
    "laptop": (
        "ordinary --methods pointnet --tasks M-D S-D S+C+M-D M-R S-R S+C+M-R M-U S-U S+C+M-U",
        "uda --methods ordinary supervised spst qbst-paper qbst-gentle defrec --tasks S-D",
        "uda --methods ordinary spst qbst-paper qbst-gentle --tasks M-D",
        "partiality real2sim --methods pointnet",
        "views --methods pointnet --tasks 1 5",
        "thresholds --methods S",
    ),
    "laptop-2": ("sensors", "views --methods pointnet --tasks 1 3"),
    "laptop-300": ("views --steps 300 --methods pointnet dgcnn --tasks 1 2 3 5 8",),
    "full": (
        "growth --seeds 0 --methods S:ordinary M:ordinary S:qbst-paper S:qbst-gentle S:spst",
        "growth --seeds 0 --methods M:qbst-paper M:qbst-gentle M:spst --tasks all",
        "adaptation-ablation --seeds 0 --methods qbst-paper qbst-paper-source-loss "
        "qbst-paper-warm-up qbst-paper-whole-pool qbst-paper-long",
        "thresholds --seeds 0 --methods M",
        "thresholds --seeds 0 --methods S --tasks qbst-theta-0.5",
    ),
    "full-300": (
        "ordinary real2sim --seeds 0 --steps 300 --methods pointnet pointnet2 dgcnn rscnn "
        "simpleview-64 forest --tasks M-D S-D M-F S-F M-R S-R M-U S-U D-M D-S",
        "uda --seeds 0 --steps 300 --methods supervised@dgcnn ordinary@dgcnn defrec@dgcnn "
        "defrec-pcm@dgcnn gast@dgcnn gast-spst@dgcnn qbst-paper@dgcnn ordinary@pointnet-sa "
        "pointdan@pointnet-sa --tasks M-D S-D S-F",
    ),
    "full-equal": (
        "ordinary --steps 300 --methods pointnet dgcnn --tasks M-D S-D M-R S-R M-U S-U",
        "real2sim --steps 300 --methods pointnet",
        "uda --steps 300 1130 3900 --methods ordinary-1130 qbst-paper qbst-gentle --tasks M-D S-D",
        "uda --steps 300 1130 3900 --methods ordinary-3900 --tasks S-D",
        "uda --steps 300 1130 3900 --seeds 0 1 --methods spst --tasks S-D",
    ),
    "full-2600": ("ordinary --seeds 0 --steps 2600 --methods dgcnn --tasks S-D S-F",),
}
"""Words of `qs3 reproduce` for each folder; the scale is the first word of its name."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path)
    parser.add_argument("--folders", nargs="+", choices=PLAN, default=[*PLAN])
    parser.add_argument("--workers", default="2")
    parser.add_argument("--dry-run", action="store_true")
    parser.add_argument("--hours", action="store_true")
    options = parser.parse_args()
    if options.hours:
        write_text(RESULTS / "hours.md", hours())
        return
    if options.out is None:
        parser.error("name the folder to make with --out")
    for folder in options.folders:
        make(folder, options)


def make(folder: str, options: argparse.Namespace) -> None:
    """Make a folder; those of a scale share their scans."""
    scale, place = folder.partition("-")[0], options.out / folder
    if not options.dry_run:
        scans = options.out / f"{DATA}-{scale}"
        scans.mkdir(parents=True, exist_ok=True)
        place.mkdir(exist_ok=True)
        if not (place / MARKER).exists():
            write_bytes(place / MARKER, (RESULTS / folder / MARKER).read_bytes())
        if not (place / DATA).exists():
            (place / DATA).symlink_to(Path("..", scans.name))
    for line in PLAN[folder]:
        words = ["reproduce", *line.split(), "--scale", scale, "--out", str(place)]
        words += ["--workers", options.workers, *["--dry-run"] * options.dry_run]
        print("qs3", shlex.join(words), flush=True)
        if code := run(words):
            sys.exit(code)


def hours() -> str:
    """Return a table of trainings and their processor hours; one that two tables show counts once.

    Records do not hold what the scans took.
    """
    lines, total = ["| folder | table | trainings | hours of one core |", "|---" * 4 + "|"], 0.0
    for marker in sorted(RESULTS.glob(f"*/{MARKER}")):
        folder, setup, counted = marker.parent, read_setup(marker.parent), set()
        for name in (name for name in TABLES if (folder / f"{name}.md").is_file()):
            records = Table(name, setup).records.items()
            spent = {cell.folder: one.cpu_seconds.get("total", 0.0) for cell, one in records}
            if new := spent.keys() - counted:
                counted |= new
                total += (here := sum(spent[place] for place in new) / 3600)
                lines.append(f"| {folder.name} | {name} | {len(new)} | {here:.1f} |")
    return "\n".join([*lines, f"| all | | | {total:.1f} |", ""])


if __name__ == "__main__":
    main()
