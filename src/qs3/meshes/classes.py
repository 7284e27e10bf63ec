"""Names of classes, their aliases, and labels put from one list of classes onto another.

Convention:
    Names are kept as they stand, in Unicode's composed form (NFC). They change in three cases
    alone: a known data set's layout says so, the user gives a map of names (``read_class_map``), or
    labels are put onto a list of classes that is there already, PointDA-10's ten or a run's
    (``map_labels``).
"""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Bool, Int

from qs3.errors import InputError
from qs3.escapes import is_printable, nfc
from qs3.toml_files import read_toml

LONGEST_NAME = 180
"""Bytes of a class name; a file system takes 255 with what is added."""
_POINTDA10 = "bathtub bed bookshelf cabinet chair lamp monitor plant sofa table"
POINTDA10: tuple[str, ...] = tuple(_POINTDA10.split())

_ALIASES = {
    "bathtub": "bath bath_tub tub",
    "bookshelf": "shelf bookcase book_shelf shelves",
    "cabinet": "night_stand nightstand bedside_table dresser wardrobe cupboard chest_of_drawers "
    "file_cabinet filing_cabinet",
    "chair": "armchair arm_chair office_chair swivel_chair stool bar_stool barstool bench",
    "lamp": "floor_lamp desk_lamp table_lamp light",
    "monitor": "television tv tv_monitor tvmonitor display screen",
    "plant": "potted_plant pottedplant house_plant houseplant",
    "sofa": "couch settee loveseat",
    "table": "desk dining_table diningtable coffee_table side_table end_table",
}
_CANONICAL = {alias: name for name, aliases in _ALIASES.items() for alias in aliases.split()}


def canonical(name: str) -> str:
    """Fold case, spaces and hyphens, and replace an alias by its class of PointDA-10.

    A name that is in no row of the table comes back folded.

    Example:
        >>> canonical("Night Stand"), canonical("TV-monitor"), canonical("toilet")
        ('cabinet', 'monitor', 'toilet')
    """
    folded = re.sub(r"[\s_-]+", "_", nfc(name).strip().lower())
    return _CANONICAL.get(folded, folded)


def check_class_names(names: Any) -> tuple[str, ...]:
    """Return names of classes if each is fit for a folder, a table and a terminal, and unique."""
    if not isinstance(names, list | tuple) or not all(isinstance(name, str) for name in names):
        raise InputError("class names are no list of texts")
    for name in names:
        paths = "/" in name or name.startswith(".")
        if paths or not name.strip() or not is_printable(name) or len(name.encode()) > LONGEST_NAME:
            raise InputError(
                f"class name {name[:40]!r} is empty, a path, too long or not printable; rename it"
            )
    looks = [nfc(name) for name in names]
    if twice := [name for name in looks if looks.count(name) > 1]:
        raise InputError(f"class {twice[0]!r} is named twice; rename one")
    return tuple(names)


_SPLITS = {"train": "train", "training": "train", "test": "test", "testing": "test"}
_SPLITS |= dict.fromkeys(("val", "valid", "validation"), "val")


def split_of(folder: str) -> str:
    """Return the split that a folder's name means: train, test or val; empty if none.

    Example:
        >>> [split_of(name) for name in ("Train", "valid", "chair")]
        ['train', 'val', '']
    """
    return _SPLITS.get(folder.casefold(), "")


def read_class_map(path: Path) -> dict[str, str]:
    """Read the new names of classes: a TOML file of lines such as ``stool = "chair"``."""
    hint = 'give each class one line, such as stool = "chair"'
    table = read_toml(path, hint)
    for name, wanted in table.items():
        try:
            check_class_names([wanted])
        except InputError as error:
            raise InputError(f"{path}: {name!r} is given no name ({error}); {hint}") from error
    return {nfc(name): nfc(wanted) for name, wanted in table.items()}


def require_named(names: Sequence[str], wanted: Mapping[str, str]) -> None:
    """Refuse a map without any of these classes."""
    if not set(names) & set(wanted):
        raise InputError(
            f"the map of classes names {', '.join(wanted) or 'nothing'}, and none of "
            f"{', '.join(names)}"
        )


def describe_renaming(
    renamed: Mapping[str, str], wanted: Mapping[str, str] | None = None
) -> list[str]:
    """Return a line about the classes that were renamed, and one about unused names of the map."""
    kinds: dict[str, list[str]] = {}
    for name, other in renamed.items():
        kinds.setdefault(other, []).append(name)
    renamings = [f"{', '.join(names)} → {other}" for other, names in kinds.items()]
    unused = [name for name, to in (wanted or {}).items() if name != to and name not in renamed]
    lines = [f"classes: {'; '.join(renamings)}"] if renamings else []
    vain = f"classes: none here is {', '.join(unused)}, as the map has it"
    return [*lines, vain] if unused else lines


_MODELNET40 = """
airplane bathtub bed bench bookshelf bottle bowl car chair cone cup curtain desk door dresser
flower_pot glass_box guitar keyboard lamp laptop mantel monitor night_stand person piano plant
radio range_hood sink sofa stairs stool table tent toilet tv_stand vase wardrobe xbox
"""
MODELNET40: frozenset[str] = frozenset(_MODELNET40.split())
"""Folders of ModelNet40; ModelNet10's are among them."""

POINTDA10_OF_MODELNET: dict[str, str] = {
    "night_stand" if name == "cabinet" else name: name for name in POINTDA10
}
"""ModelNet40's share of PointDA-10: ten folders, of which only night_stand gets another name.

4,183 meshes to train on and 856 to test on; Qin et al., PointDAN, NeurIPS 2019.
"""

_SHAPENET = """
02691156 airplane  02747177 ashcan  02773838 bag  02801938 basket  02808440 bathtub  02818832 bed
02828884 bench  02843684 birdhouse  02871439 bookshelf  02876657 bottle  02880940 bowl
02924116 bus  02933112 cabinet  02942699 camera  02946921 can  02954340 cap  02958343 car
02992529 cellular_telephone  03001627 chair  03046257 clock  03085013 computer_keyboard
03207941 dishwasher  03211117 display  03261776 earphone  03325088 faucet  03337140 file
03467517 guitar  03513137 helmet  03593526 jar  03624134 knife  03636649 lamp  03642806 laptop
03691459 loudspeaker  03710193 mailbox  03759954 microphone  03761084 microwave
03790512 motorcycle  03797390 mug  03928116 piano  03938244 pillow  03948459 pistol  03991062 pot
04004475 printer  04074963 remote_control  04090263 rifle  04099429 rocket  04225987 skateboard
04256520 sofa  04330267 stove  04379243 table  04401088 telephone  04460130 tower  04468005 train
04530566 vessel  04554684 washer
"""
SHAPENET: dict[str, str] = dict(zip(_SHAPENET.split()[::2], _SHAPENET.split()[1::2], strict=True))
"""ShapeNetCore's 55 synsets: WordNet 3.0 offset → the synset's first name."""

POINTDA10_OF_SHAPENET: dict[str, str] = {
    "display": "monitor",
    "pot": "plant",
    **{name: name for name in POINTDA10 if name not in ("monitor", "plant")},
}
"""ShapeNetCore's share of PointDA-10, by the names of ``SHAPENET``; pot is a flowerpot's synset."""


def map_labels(
    class_names: Sequence[str],
    labels: Int[np.ndarray, "b"],
    to: Sequence[str] = POINTDA10,
    unmapped: Literal["error", "drop"] = "error",
) -> tuple[Int[np.ndarray, "m"], Bool[np.ndarray, "b"]]:
    """Put labels onto another list of classes by the table of aliases.

    A name that the other list has keeps it. Otherwise it becomes its class of PointDA-10 if the
    list has that, else its alias in the list if that is the only one.

    Args:
        class_names: Names that the labels index.
        labels: Labels of the clouds.
        to: Names that the result indexes.
        unmapped: Whether to drop clouds of a class that is not in ``to``.

    Returns:
        The new labels of the clouds that are kept, and which clouds are kept.

    Example:
        >>> labels, kept = map_labels(["desk", "dresser"], np.array([1, 0]))
        >>> [POINTDA10[i] for i in labels]
        ['cabinet', 'table']
    """
    mapped = _positions(class_names, to)[labels]
    kept = mapped >= 0
    if unmapped == "error" and not kept.all():
        missing = sorted({class_names[int(i)] for i in np.unique(labels[~kept])})
        raise InputError(
            f"class {', '.join(map(repr, missing))} is not one of: {', '.join(to)}; rename it, or "
            "name the classes to use, or what each is called: --map"
        )
    return mapped[kept], kept


def _positions(names: Sequence[str], to: Sequence[str]) -> Int[np.ndarray, "k"]:
    """Return the position in ``to`` of each name, −1 if it is not there.

    A list may hold a class beside its alias (ScanObjectNN: table and desk): the class comes first.
    Of several aliases (armchair and stool) none is meant.
    """
    exact = {nfc(name): position for position, name in enumerate(to)}
    kinds = [canonical(name) for name in to]
    merged = {kind: kinds.index(kind) for kind in kinds if kinds.count(kind) == 1}
    folded = [(nfc(name), canonical(name)) for name in names]
    rows = [exact.get(n, exact.get(fold, merged.get(fold, -1))) for n, fold in folded]
    return np.array(rows, dtype=np.int64)
