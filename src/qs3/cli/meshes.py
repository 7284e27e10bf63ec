"""``qs3 meshes``: sizes, faults and a contact sheet of a folder of meshes."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from qs3.cli.text import columns, notify, quoted, show
from qs3.errors import InputError, say_once
from qs3.meshes.sizes import Unit

if TYPE_CHECKING:
    from qs3.meshes.inspecting import Inspection

_LISTED = 20
_COMPARED = 50
"""Meshes up to which symmetries are looked for: each takes a fifth of a second."""


def meshes(
    folder: Annotated[str, tyro.conf.Positional],
    out: Path = Path("contact-sheet.png"),
    up: Literal["z", "y"] | None = None,
    units: Unit | None = None,
    classes: tuple[str, ...] = (),
    labels: Path | None = None,
) -> int:
    """Show what a folder of meshes holds: classes, sizes, faults, a contact sheet.

    Symmetries of up to fifty meshes are listed: turns after which a part looks the same.

    Args:
        folder: Folder of meshes, as for qs3 generate; or shapes.
        out: Contact sheet to write, PNG: the first eight of each class with their names.
        up: Up axis of the meshes; default: y for glTF and ShapeNet, z for all others.
        units: Unit of files without one in --labels, except STEP and IGES; default: the file's,
            else m up to a longest side of 5, mm above.
        classes: Classes to show, or pointda10 for its ten; default: all.
        labels: CSV with a row per mesh: columns file, class, and optionally split, unit and up.
    """
    from tqdm import tqdm

    if out.suffix.lower() != ".png":
        raise InputError(f"--out {out}: the contact sheet is a PNG; name a file that ends in .png")
    from qs3.files import check_output
    from qs3.meshes.collections import collect
    from qs3.meshes.inspecting import inspect
    from qs3.report.figure import check_picture

    check_output(out, "--out", ".png")
    check_picture(out)
    items = collect(folder, classes=classes or None, labels=labels, up=up)
    looks = inspect(items, units)
    inspections = list(tqdm(looks, total=len(items), unit="mesh", leave=False, disable=None))
    has_faults = show_meshes(inspections, out, Path(folder).name)
    following = f"qs3 generate --meshes {quoted(folder)} --out SET, with these options"
    if not all(item.class_name for item in items):
        following = "put the meshes into one folder per class, or name a CSV of them: --labels CSV"
    if any(not look.fault for look in inspections):
        notify(f"Next: {following}")
    return 1 if has_faults else 0


def show_meshes(
    inspections: "Sequence[Inspection]", out: Path | None, title: str, *, as_messages: bool = False
) -> bool:
    """Print sizes, hints and faults, and draw the contact sheet; return whether there are faults.

    ``as_messages`` prints them as messages: results of another verb follow.
    """
    from qs3.meshes.inspecting import odd_sizes

    print_lines = notify if as_messages else show
    groups: dict[str, list[Inspection]] = {}
    for look in sorted(inspections, key=lambda look: look.item.class_name):
        groups.setdefault(look.item.class_name or "no class", []).append(look)
    rows = [("class", "meshes", "longest side (m)", "with hints", "faults")]
    print_lines(*columns(rows + [_row(name, group) for name, group in groups.items()], right=1))
    examples = {hint: look.item.id for look in reversed(inspections) for hint in look.hints}
    counts = Counter(hint for look in inspections for hint in look.hints)
    for hint, count in counts.most_common():
        print_lines(f"hint: {count} of {len(inspections)}, such as {examples[hint]}: {hint}")
    if not as_messages:
        print_lines(*_symmetries(inspections))
    odd = odd_sizes(inspections)
    for text in _first([text for _, text in odd]):
        say_once(text)
    faults = [f"fault: {look.fault}" for look in inspections if look.fault]
    print_lines(*_first(faults))
    if out is not None:
        from qs3.report.figure import write_png
        from qs3.report.sheet import contact_sheet, tiles_of

        write_png(out, contact_sheet(tiles_of(groups, dict(odd)), title))
        print_lines(out)
    return bool(faults)


def _symmetries(inspections: "Sequence[Inspection]") -> list[str]:
    """Return a line for each kind of symmetry among the drawn meshes of an object's size."""
    drawn = [look for look in inspections if look.mesh is not None and look.size is not None]
    if len(drawn) > _COMPARED:
        return []
    from qs3.parts.views import view_of  # it imports numba

    found: dict[str, list[str]] = {}
    for look in drawn:
        if look.mesh is not None and look.size is not None:
            scale = look.size / float(look.mesh.extents.max())
            part = view_of(look.mesh, scale, look.item.class_name, look.item.id)
            found.setdefault(str(part.symmetry), []).append(look.item.id)
    found.pop("", None)
    return [
        f"symmetry of {', '.join(ids)}: {text}"
        for text, ids in sorted(found.items(), key=lambda pair: -len(pair[1]))
    ]


def _first(texts: Sequence[str]) -> list[str]:
    """Return the first of many lines, and the number of the others."""
    more = [f"and {len(texts) - _LISTED} more"] if len(texts) > _LISTED else []
    return [*texts[:_LISTED], *more]


def _row(name: str, group: "list[Inspection]") -> tuple[str, ...]:
    sizes = [look.size for look in group if look.size is not None]
    span = f"{min(sizes):.3g} to {max(sizes):.3g}" if sizes else "unknown"
    hinted = sum(bool(look.hints) for look in group)
    faulty = sum(bool(look.fault) for look in group)
    return name, str(len(group)), span, str(hinted), str(faulty)
