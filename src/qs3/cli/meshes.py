"""``qs3 meshes``: what a folder of meshes holds, before anything is made of it."""

from collections import Counter
from collections.abc import Container, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from qs3.cli.text import columns, quoted, show, tell
from qs3.errors import InputError, say_once
from qs3.meshes.sizes import Unit

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from qs3.meshes.inspecting import Inspection
    from qs3.meshes.trees import MeshItem

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
        folder: A folder as `qs3 generate` takes it, or shapes.
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
    from qs3.meshes.odd_sizes import Measured, odd_sizes
    from qs3.report.figure import write_png

    check_output(out, "--out", ".png")
    items = collect(folder, classes=classes or None, labels=labels, up=up)
    looks = inspect(items, units)
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
    odd = odd_sizes(
        [
            Measured(look.item.id, look.item.class_name, look.extents)
            for look in inspections
            if look.extents is not None
        ]
    )
    for text in _first([text for _, text in odd], ""):
        say_once(text)
    faults = [look.fault for look in inspections if look.fault]
    show(*_first(faults, "fault: "))
    alike, apart = _same_files(Path(folder), [look.item for look in inspections if not look.fault])
    show(*_first(alike, "hint: "))
    for text in _first(apart, f"{folder}: "):
        say_once(text)
    write_png(out, _sheet(groups, dict(odd), Path(folder).name))
    show(out)
    given: dict[str, Sequence[object]] = {"classes": classes, "labels": (labels,), "up": (up,)}
    if units is not None:  # generate takes them for sizes by the file and a camera in metres
        given |= {"sensor": ("d435",), "object-size": ("file",), "units": (units,)}
    tell(f"Next: {_following(folder, items, given)}")
    return 1 if faults else 0


def _first(texts: Sequence[str], before: str) -> list[str]:
    """The first of many lines, and how many more there are."""
    more = [f"and {len(texts) - _LISTED} more"] if len(texts) > _LISTED else []
    return [before + text for text in [*texts[:_LISTED], *more]]


def _following(
    folder: str, items: "Sequence[MeshItem]", given: Mapping[str, Sequence[object]]
) -> str:
    """The command that comes next, with those of the options that were given here."""
    if not all(item.class_name for item in items):
        return (
            "a class for each mesh: put them into one folder a class, or name a CSV of them: "
            "--labels CSV"
        )
    words = [f"qs3 generate --meshes {quoted(folder)}"]
    for name, values in given.items():
        if any(value is not None for value in values):
            words.append(f"--{name} {' '.join(map(quoted, values))}")
    return f"{' '.join(words)} --out SET"


def _same_files(folder: Path, items: "Sequence[MeshItem]") -> tuple[list[str], list[str]]:
    """Tell the files of one content in one class, and those in several; a pair of each.

    Only files of equal size are read.
    """
    from qs3.store.manifest import mesh_sums

    paths = {item.id: item.path for item in items if item.path is not None}
    sizes = {name: path.stat().st_size for name, path in paths.items()}
    count = Counter(sizes.values())
    sums = mesh_sums({name: path for name, path in paths.items() if count[sizes[name]] > 1})
    equal: dict[str, list[MeshItem]] = {}
    for item in items:
        if item.id in sums:
            equal.setdefault(sums[item.id], []).append(item)
    alike, apart = [], []
    for first, *others in equal.values():
        strange = [item for item in others if item.class_name != first.class_name]
        pair = [first, *(strange or others)][:2]
        text = " and ".join(str(item.path.relative_to(folder)) for item in pair if item.path)
        text += f" are the same file{' in two classes' * bool(strange)}"
        text += f" (and {len(others) - 1} more)" * (len(others) > 1)
        if others:
            (apart if strange else alike).append(text)
    return alike, apart


def _sheet(
    groups: "Mapping[str, Sequence[Inspection]]", odd: Container[str], title: str
) -> "Figure":
    """Draw the first of each class, with their names."""
    from qs3.report.sheet import Tile, contact_sheet

    tiles = []
    for name, group in groups.items():
        shown = group[:_PICTURED]
        for look, text in zip(shown, _captions([look.item.id for look in shown]), strict=True):
            load = None if look.fault else look.item.load
            is_faulty = bool(look.fault) or look.size is None or look.item.id in odd
            tiles.append(Tile(text, name, load, look.extents, is_faulty))
    return contact_sheet(tiles, title)


def _captions(ids: Sequence[str]) -> list[str]:
    """The last part of each name that tells one from another: of a/model and b/model a and b."""
    parts = [id.split("/") for id in ids]
    while len({part[-1] for part in parts}) == 1 < len(parts) and all(p[1:] for p in parts):
        parts = [part[:-1] for part in parts]
    return [part[-1] for part in parts]


def _row(name: str, group: "list[Inspection]") -> tuple[str, ...]:
    sizes = [look.size for look in group if look.size is not None]
    span = f"{min(sizes):.3g} to {max(sizes):.3g}" if sizes else "unknown"
    hinted = sum(bool(look.hints) for look in group)
    faulty = sum(bool(look.fault) for look in group)
    return name, str(len(group)), span, str(hinted), str(faulty)
