"""``qs3 convert``: a data set of this field into the layout of another."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from qs3.cli.text import columns, notify, quoted, show
from qs3.errors import InputError


def convert(
    source: Annotated[Path | None, tyro.conf.Positional] = None,
    target: Annotated[Path | None, tyro.conf.Positional] = None,
    to: str = "",
    origin: Annotated[str | None, tyro.conf.arg(name="from")] = None,
    split: str | None = None,
    cloud: Literal["points", "clean", "surface"] = "points",
    num_points: int | None = None,
    classes: tuple[str, ...] = (),
    unmapped: Literal["error", "drop"] = "error",
    list: bool = False,
) -> int:
    """Convert a data set into the layout of another.

    Args:
        source: What to read: a folder or a file.
        target: What to write: a new name, or an empty folder.
        to: Layout to write, by its name in --list.
        origin: Layout of the source; found out by default.
        split: train or test only; all by default.
        cloud: Which cloud of a data set that qs3 generate made.
        num_points: Points per cloud: more are reduced by farthest point sampling, fewer repeated.
        classes: Classes to map the labels onto, or pointda10 for its ten; kept as they are by
            default.
        unmapped: What to do with clouds whose class is not in --classes.
        list: Print the known layouts and stop.
    """
    from qs3.clouds.layouts import formats
    from qs3.clouds.load import convert as convert_data
    from qs3.meshes.classes import POINTDA10

    if list:
        rows = [("name", "read", "write", "layout")]
        for layout in formats().values():
            able = ["yes" if way is not None else "no" for way in (layout.read, layout.write)]
            rows.append((layout.name, able[0], able[1], layout.layout))
        show(*columns(rows))
        return 0
    if source is None or target is None or not to:
        raise InputError("convert: name what to read, what to write and its layout: qs3 convert "
                         "SRC DST --to NAME; the names: qs3 convert --list")  # fmt: skip
    clouds = convert_data(
        source,
        target,
        to,
        origin=origin,
        split=split,
        cloud=cloud,
        num_points=num_points,
        classes=POINTDA10 if classes == ("pointda10",) else classes or None,
        unmapped=unmapped,
    )
    show(target)
    kind, use = "without labels", "--method qbst --source DATA --target"
    if clouds.labels is not None:
        kind, use = f"of {len(set(clouds.labels.tolist()))} classes", "--source"
    notify(f"{len(clouds.ids)} clouds {kind} written as {to}. Next: qs3 train {use} "
         f"{quoted(target)} --out RUN")  # fmt: skip
    return 0
