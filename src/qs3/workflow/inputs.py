"""CAD and scans as a user names them, and what is refused before anything is scanned."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Literal

from qs3.answers.classifier import Clouds
from qs3.errors import InputError, without_warnings
from qs3.files import resolved
from qs3.meshes import collect
from qs3.meshes.cad_text import UNITS as CAD_UNITS
from qs3.meshes.inspecting import Inspection, inspect
from qs3.meshes.sizes import Unit, file_unit
from qs3.meshes.trees import MeshItem
from qs3.parts.library import refuse_words, shape_of
from qs3.workflow.options import Written
from qs3.workflow.scans import Scans, read_scans

_TRIED = 3  # files, to see what a folder holds


def read_inputs(
    cad: Path, scans: Clouds, folder: Path, up: Literal["z", "y"] | None
) -> tuple[list[MeshItem], Scans]:
    """List the CAD and read the scans; arrays get names below ``folder``.

    Raises:
        InputError: If one of them cannot be read, or was named for the other.
    """
    try:
        items = collect(cad, up=up)
        found = read_scans(scans, folder)
        _check_classes(cad, items)
    except InputError as error:
        places = scans if isinstance(scans, list | tuple) else [scans]
        first = places[0] if places else None
        if isinstance(first, str | Path):
            refuse_swapped(cad, Path(first), error)
        raise
    return items, found


def refuse_written(out: Path, paths: Iterable[Path]) -> None:
    """Refuse files that are read and lie where the call writes below ``out``."""
    taken = [resolved(out / name) for name in Written]
    for path in paths:
        if any(resolved(path).is_relative_to(place) for place in taken):
            raise InputError(
                f"{path}: lies where this call writes its results, and would be lost; copy it to "
                f"another place than {out}, and name the copy"
            )


def refuse_swapped(cad: Path, scans: Path, cause: InputError | None = None) -> None:
    """Refuse meshes in the place of the scans, if there are none in that of the CAD."""
    if not _holds_mesh(cad) and _holds_mesh(scans):
        raise InputError(
            f"{cad} holds no CAD, and {scans} does: name the CAD first, then the scans"
        ) from cause


def _holds_mesh(folder: Path) -> bool:
    try:
        with without_warnings():  # of scans as CAD, and of CAD as if no options were given
            return any(not look.fault for look in inspect(collect(folder)[:_TRIED]))
    except InputError:
        return False


def _check_classes(cad: Path, items: Sequence[MeshItem]) -> None:
    refuse_words(items, cad)
    if flat := [item.id for item in items if not item.class_name]:
        raise InputError(
            f"{cad}: the class of {flat[0]} is unknown; put it into a folder of its class"
        )
    if len({item.class_name for item in items}) < 2:
        fix = "add the CAD of another part (a file or a folder per class)"
        folders = {item.path.parent for item in items if item.path is not None}
        if len(items) > 1 and len(folders) == 1:
            fix += f"; if each file is a class, name the folder {folders.pop()}"
        raise InputError(
            f"{cad}: holds one class alone, {items[0].class_name}, and there is nothing to tell it "
            f"from: {fix}"
        )


def check_parts(
    cad: Path,
    items: Sequence[MeshItem],
    looks: Sequence[Inspection],
    found: Scans,
    *,
    same: bool,
) -> None:
    """Refuse clouds in the place of the CAD, and, unless ``same``, two classes of the same CAD."""
    if all(look.fault for look in looks):
        if not found.in_memory:
            refuse_swapped(cad, found.places[0])
        raise InputError(f"{cad}: no mesh can be used; the first: {looks[0].fault}")
    shapes: dict[str, MeshItem] = {}
    for item, look in zip(items, looks, strict=True):
        if look.fault or same:
            continue
        other = shapes.setdefault(shape_of(item.load()), item)
        if other.class_name != item.class_name:
            raise InputError(
                f"{cad}: {other.id} and {item.id} have the same shape, and no scan can tell "
                f"{other.class_name} from {item.class_name}: remove one (--force goes on)"
            )


def unit_of(look: Inspection, units: Unit | None) -> str | None:
    """Return the unit that a mesh is taken to be in; None if its file is sure of it."""
    if look.fault or look.item.path is None:
        return None
    mesh = look.item.load()
    if mesh.units is not None and (units is None or look.item.path.suffix.lower() in CAD_UNITS):
        return None
    return file_unit(mesh, units)[1].split()[0]
