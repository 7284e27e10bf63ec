"""``qs3 meshes``: what a folder of meshes holds, before anything is made of it."""

import dataclasses
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from qs3.cli.text import columns, quoted, show, tell
from qs3.meshes.sizes import Unit

if TYPE_CHECKING:
    from qs3.meshes.inspecting import Inspection

_PICTURED, _LISTED = 8, 20


def meshes(
    folder: Annotated[str, tyro.conf.Positional],
    out: Path = Path("contact-sheet.png"),
    up: Literal["z", "y"] | None = None,
    units: Unit | None = None,
    classes: tuple[str, ...] = (),
    labels: Path | None = None,
) -> int:
    """Show what a folder of meshes holds: classes, sizes, faults, a contact sheet.

    Args:
        folder: As `qs3 generate` takes it: one folder a class, ModelNet's or ShapeNet's tree, or
            shapes.
        out: The contact sheet to write, PNG: the first eight of each class.
        up: Up axis of the meshes; by default y for glTF and ShapeNet, z for all others.
        units: Unit of the files, but STEP and IGES; by default what they tell, else m up to a
            longest side of 5, mm above.
        classes: Look at these classes only, or pointda10 for its ten; all by default.
        labels: CSV that tells the class of each mesh.
    """
    from tqdm import tqdm

    from qs3.meshes.collections import collect
    from qs3.meshes.inspecting import inspect
    from qs3.report.clouds import gallery
    from qs3.report.figure import write_png

    items = collect(folder, classes=classes or None, labels=labels)
    if up is not None:
        items = [dataclasses.replace(item, up=up) for item in items]
    looks = inspect(items, units, _PICTURED)
    inspections = list(tqdm(looks, total=len(items), unit="mesh", leave=False, disable=None))
    groups: dict[str, list[Inspection]] = {}
    for look in sorted(inspections, key=lambda look: look.item.class_name):
        groups.setdefault(look.item.class_name or "no class", []).append(look)
    rows = [("class", "meshes", "longest side (m)", "with hints", "faults")]
    show(*columns(rows + [_row(name, group) for name, group in groups.items()], right=1))
    examples = {hint: look.item.id for look in reversed(inspections) for hint in look.hints}
    counts = Counter(hint for look in inspections for hint in look.hints)
    for hint, count in counts.most_common():
        show(f"hint: {count} of {len(inspections)}, such as {examples[hint]}: {hint}")
    faults = [look.fault for look in inspections if look.fault]
    show(*(f"fault: {fault}" for fault in faults[:_LISTED]))
    if len(faults) > _LISTED:
        show(f"fault: and {len(faults) - _LISTED} more")
    pictures = {
        name: [look.surface for look in group if look.surface is not None]
        for name, group in groups.items()
    }
    wide = max(4, *map(len, pictures.values()))
    write_png(out, gallery(pictures, Path(folder).name, wide))
    show(out)
    tell(f"Next: qs3 generate --meshes {quoted(folder)} --out SET")
    return 1 if faults else 0


def _row(name: str, group: "list[Inspection]") -> tuple[str, ...]:
    sizes = [look.size for look in group if look.size is not None]
    span = f"{min(sizes):.3g} to {max(sizes):.3g}" if sizes else "unknown"
    hinted = sum(bool(look.hints) for look in group)
    faulty = sum(bool(look.fault) for look in group)
    return name, str(len(group)), span, str(hinted), str(faulty)
