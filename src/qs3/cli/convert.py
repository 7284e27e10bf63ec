"""``qs3 convert``: a data set of this field into the layout of another."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import tyro

from qs3.errors import InputError


@dataclass(frozen=True)
class ConvertOptions:
    """Read a data set in any known layout and write it in another."""

    source: Annotated[Path | None, tyro.conf.Positional] = None
    """What to read: a folder or a file."""
    target: Annotated[Path | None, tyro.conf.Positional] = None
    """What to write: a new name, or an empty folder."""
    to: str = ""
    """Layout to write, by its name in --list."""
    origin: Annotated[str | None, tyro.conf.arg(name="from")] = None
    """Layout of the source; found out by default."""
    split: str | None = None
    """train or test only; all by default."""
    cloud: Literal["points", "clean", "surface"] = "points"
    """Which cloud of a data set that qs3 generate made."""
    num_points: int | None = None
    """Points a cloud: more are thinned by farthest point sampling, fewer repeated."""
    classes: tuple[str, ...] = ()
    """Classes to map the labels onto, or pointda10 for its ten; kept as they are by default."""
    unmapped: Literal["error", "drop"] = "error"
    """What to do with clouds of a class that is none of --classes."""
    list: bool = False
    """Print the known layouts and stop."""


def convert(options: Annotated[ConvertOptions, tyro.conf.arg(name="")]) -> int:
    """Convert a data set into the layout of another; --list tells which are known."""
    if options.list:
        _print_layouts()
        return 0
    if options.source is None or options.target is None or not options.to:
        raise InputError("convert: name what to read, what to write and its layout: qs3 convert "
                         "SRC DST --to NAME; the names: qs3 convert --list")  # fmt: skip
    from qs3.io.convert import convert as convert_data
    from qs3.meshes.classes import POINTDA10

    classes = POINTDA10 if options.classes == ("pointda10",) else options.classes or None
    clouds = convert_data(
        options.source,
        options.target,
        options.to,
        origin=options.origin,
        split=options.split,
        cloud=options.cloud,
        num_points=options.num_points,
        classes=classes,
        unmapped=options.unmapped,
    )
    print(options.target)
    told, given = "without labels", "--method qbst --source DATA --target"
    if clouds.labels is not None:
        told, given = f"of {len(set(clouds.labels.tolist()))} classes", "--source"
    print(
        f"{len(clouds.ids)} clouds {told} written as {options.to}. Next: qs3 train {given} "
        f"{options.target} --out RUN",
        file=sys.stderr,
    )
    return 0


def _print_layouts() -> None:
    from qs3.io.layouts import FORMATS

    rows = [("name", "read", "write", "layout")]
    for layout in FORMATS.values():
        able = ["yes" if way is not None else "no" for way in (layout.read, layout.write)]
        rows.append((layout.name, able[0], able[1], layout.layout))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        cells = (cell.ljust(width) for cell, width in zip(row, widths, strict=True))
        print("  ".join(cells).rstrip())
