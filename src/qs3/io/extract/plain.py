"""Depth images as they come from any camera: one, or a folder of them, with masks or a box."""

import csv
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Int32

from qs3.errors import InputError
from qs3.io.extract.clouds import ExtractedCloud
from qs3.io.extract.depth import CutSettings, as_cloud, keep_pixels, lift, turn, upright
from qs3.io.extract.depth_images import DEPTH_FILES, read_depth, read_mask
from qs3.io.extract.intrinsics import Intrinsics

_LARGEST_TABLE = 1 << 26


@dataclass(frozen=True)
class DepthImage:
    """One depth image to cut objects from."""

    id: str
    """Its file name without ending."""
    path: Path
    """The file."""
    mask: Path | None
    """Its mask, or None where a box tells the object."""


@dataclass(frozen=True)
class DepthSettings:
    """What is cut from depth images."""

    camera: Intrinsics
    """The camera of all images."""
    box: tuple[int, int, int, int] | None = None
    """First column and row of the object, and those after its last."""
    instances: bool = False
    """Each number of a mask is an object of its own; else all that are not 0 are one object."""
    depth_scale: float | None = None
    """Metres a step; None takes the camera's, else millimetres for whole numbers and metres."""
    gravity: tuple[float, float, float] = (0.0, 1.0, 0.0)
    """Downward direction in camera coordinates (x right, y down, z forward)."""
    class_name: str = "object"
    """Class of objects that ``names`` does not tell."""
    names: Mapping[str, str] = field(default_factory=dict)
    """Class of ``image``; with ``instances`` first of ``image/number`` and ``*/number``."""
    split: str = ""
    """Split of every object."""
    cut: CutSettings = field(default_factory=CutSettings)
    """Which pixels are kept."""

    def __post_init__(self) -> None:
        upright(self.gravity)
        if self.box is not None:
            u0, v0, u1, v1 = self.box
            if not (0 <= u0 < u1 and 0 <= v0 < v1):
                raise InputError(f"box {self.box}: must be u0 v0 u1 v1 with u0 < u1 and v0 < v1")

    def class_of(self, image: str, number: int) -> str:
        """Return the class of an object."""
        keys = (f"{image}/{number}", f"*/{number}", image) if self.instances else (image,)
        return next((self.names[key] for key in keys if key in self.names), self.class_name)


def list_depth_images(source: Path, mask: Path | None = None) -> list[DepthImage]:
    """List the depth images of a file or folder with the masks of the same name.

    Args:
        source: A depth image, or a folder with nothing else of those endings in it.
        mask: The mask of one image, a folder of masks named as their images, or None.

    Raises:
        InputError: where there is no image, two have one name, or a mask is missing.
    """
    source = Path(source)
    if source.is_dir():
        paths = _images(source)
        if not paths:
            raise InputError(
                f"{source}: no depth image ({', '.join(DEPTH_FILES)}) and no scene of BOP's layout "
                "(scene_camera.json) in it"
            )
    elif source.is_file():
        paths = {source.stem: source}
    else:
        raise InputError(f"{source}: no such file or folder")
    if mask is None:
        return [DepthImage(name, path, None) for name, path in paths.items()]
    if mask.is_file():
        if len(paths) > 1:
            raise InputError(f"{mask}: one mask for {len(paths)} depth images; name a folder")
        return [DepthImage(name, path, mask) for name, path in paths.items()]
    if not mask.is_dir():
        raise InputError(f"{mask}: no such file or folder")
    masks = _images(mask)
    for name, path in paths.items():
        if name not in masks:
            raise InputError(f"{mask}: no mask {name}.png for {path}")
    return [DepthImage(name, path, masks[name]) for name, path in paths.items()]


def _images(folder: Path) -> dict[str, Path]:
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or path.suffix.lower() not in DEPTH_FILES:
            continue
        if path.stem in found:
            raise InputError(f"{path}: {found[path.stem].name} has the same name; rename one")
        found[path.stem] = path
    return found


def extract_depth(image: DepthImage, settings: DepthSettings) -> Iterator[ExtractedCloud]:
    """Cut the objects from one depth image.

    Convention:
        Metres; the camera is the origin, axes as `depth.upright` says.

    Raises:
        InputError: where a file is damaged, sizes differ, or the box is outside the image.
    """
    depth = read_depth(image.path, settings.depth_scale or settings.camera.depth_scale)
    settings.camera.check_size(depth.shape, str(image.path))
    level = upright(settings.gravity)
    for number, mask in _objects(image, settings, depth.shape):
        keep = keep_pixels(depth, mask, settings.cut)
        points = as_cloud(turn(level, lift(depth, keep, settings.camera)), str(image.path))
        if len(points) < settings.cut.min_points:
            continue
        name = f"{image.id}/{number}" if settings.instances else image.id
        yield ExtractedCloud(
            id=name,
            class_name=settings.class_of(image.id, number),
            points=points,
            split=settings.split,
            source={"image": image.path.name, "points": len(points), "pixels": int(mask.sum())},
        )


def _objects(
    image: DepthImage, settings: DepthSettings, shape: tuple[int, ...]
) -> Iterable[tuple[int, Bool[np.ndarray, "h w"]]]:
    """Number and pixels of each object, one at a time."""
    window = np.ones(shape, dtype=bool)
    if settings.box is not None:
        u0, v0, u1, v1 = settings.box
        if u1 > shape[1] or v1 > shape[0]:
            raise InputError(
                f"{image.path}: box {u0} {v0} {u1} {v1} goes beyond its {shape[1]}×{shape[0]} "
                "pixels"
            )
        window[:] = False
        window[v0:v1, u0:u1] = True
    if image.mask is None:
        if settings.box is None:
            raise InputError(f"{image.path}: name its object by --mask or --box")
        yield 1, window
        return
    mask: Int32[np.ndarray, "h w"] = read_mask(image.mask, shape)
    if not settings.instances:
        yield 1, (mask != 0) & window
        return
    numbers = np.unique(mask[mask != 0])
    if len(numbers) > 4096:
        raise InputError(f"{image.mask}: {len(numbers)} instances; is it a mask of instances?")
    for number in numbers.tolist():
        yield number, (mask == number) & window


def read_names(path: Path) -> dict[str, str]:
    """Read which image, instance or object is of which class from a CSV with name and class.

    Raises:
        InputError: where it is no such file, or a name is empty or comes twice.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file")
    if path.stat().st_size > _LARGEST_TABLE:
        raise InputError(f"{path}: too long for a table of classes")
    names: dict[str, str] = {}
    try:
        with path.open(encoding="utf-8-sig", newline="") as handle:
            rows: Any = csv.DictReader(handle, strict=True)
            if not {"name", "class"} <= set(rows.fieldnames or ()):
                raise InputError(f"{path}: its first line must name the columns name,class")
            for row in rows:
                name, kind = (row["name"] or "").strip(), (row["class"] or "").strip()
                if not name or not kind or not kind.isprintable() or name in names:
                    what = "comes twice" if name in names else "needs a name and a class"
                    raise InputError(f"{path}, line {rows.line_num}: {name!r} {what}")
                names[name] = kind
    except (UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path}: not a CSV of UTF-8 text ({error})") from error
    if not names:
        raise InputError(f"{path}: no row after the columns' names")
    return names
