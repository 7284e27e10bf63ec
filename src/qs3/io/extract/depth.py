"""Objects from depth images of any camera, one or a folder of them, with masks or a box.

A source in BOP's layout goes to `qs3.io.extract.bop`.
"""

import csv
import dataclasses
import io
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro
from jaxtyping import Bool, Int32

from qs3.errors import InputError
from qs3.io.extract.cut import CutSettings, as_cloud, keep_pixels, lift, turn, upright
from qs3.io.extract.depth_images import DEPTH_FILES, read_depth, read_mask
from qs3.io.extract.intrinsics import Intrinsics, read_intrinsics
from qs3.io.extract.run import (
    ExtractedCloud,
    ExtractReport,
    OutputSettings,
    recorded,
    run_extract,
)
from qs3.io.guards import read_small

_LARGEST_TABLE = 1 << 26
_MOST_INSTANCES = 4096


@dataclass(frozen=True)
class DepthImageSettings:
    """What is cut from depth images of any camera, or from scenes in BOP's layout."""

    intrinsics: str = ""
    """fx,fy,cx,cy; a JSON file of a camera; or a text file of 3×3 numbers."""
    mask: Path | None = None
    """The mask of the image, or a folder of masks with the images' names; not 0 is the object."""
    instances: bool = False
    """Each number of a mask is an object of its own."""
    box: tuple[int, int, int, int] | None = None
    """First column and row of the object, and those after its last: u0 v0 u1 v1."""
    depth_scale: float | None = None
    """Metres a step of the images; None takes the camera's, else 0.001 for whole numbers and 1 for
    others."""
    class_name: Annotated[str, tyro.conf.arg(name="class")] = ""
    """Class of every object; object, or obj_000001 and so on, by default."""
    names: Path | None = None
    """CSV with the columns name and class: of an image (a), an instance (a/1, or */1 in any image)
    or a model of BOP (1 or obj_000001)."""
    frame: Literal["auto", "world", "camera", "model"] = "auto"
    """Axes of the clouds, in BOP's layout: auto is the world where the scene tells it."""
    depth_folder: str = "depth"
    """Folder of the depth pictures in a scene of BOP's layout; depth_true, of qs3 scan --frames,
    gives clean twins."""
    gravity: tuple[float, float, float] = (0.0, 1.0, 0.0)
    """Downward direction in the camera's axes (x right, y down, z forward), which z is turned
    against."""
    split: str = ""
    """Name of the split of every object, such as train or test."""
    cut: Annotated[CutSettings, tyro.conf.arg(name="")] = field(default_factory=CutSettings)
    """Which pixels are kept."""

    def __post_init__(self) -> None:
        upright(self.gravity)
        if self.box is not None:
            u0, v0, u1, v1 = self.box
            if not (0 <= u0 < u1 and 0 <= v0 < v1):
                raise InputError(f"box {self.box}: must be u0 v0 u1 v1 with u0 < u1 and v0 < v1")
        if not re.fullmatch(r"\w+", self.depth_folder):
            raise InputError(
                f"{self.depth_folder!r} is no folder of a scene; give a name such as depth"
            )


def extract_depth(
    source: Path, output: OutputSettings, settings: DepthImageSettings
) -> ExtractReport:
    """Cut objects from depth images, or from scenes in BOP's layout, into a data set.

    Convention:
        Metres; the camera is the origin, axes as `cut.upright` says. For BOP see `bop.cut_frame`.

    Args:
        source: A depth image, a folder of them, a scene in BOP's layout, or a folder of scenes.
        output: Where the clouds go.
        settings: What is cut.

    Raises:
        InputError: where there is nothing to cut from, camera or object is not told, a setting
            does not suit the source, or as `run_extract` does.
    """
    from qs3.io.extract import bop

    source = Path(source)
    names = read_names(settings.names) if settings.names is not None else {}
    if bop.is_bop(source):
        return bop.extract_bop(source, output, settings, names)
    if settings.frame not in ("auto", "camera"):
        raise InputError(f"--frame {settings.frame}: is for scenes in BOP's layout; use --gravity")
    if not settings.intrinsics:
        raise InputError("--intrinsics: give fx,fy,cx,cy or a file; depth alone makes no points")
    if settings.mask is None and settings.box is None:
        raise InputError("depth: name the object by --mask FILE|DIR or --box u0 v0 u1 v1")
    if settings.instances and settings.mask is None:
        raise InputError("--instances: needs --mask, whose numbers it means")
    settings = dataclasses.replace(settings, class_name=settings.class_name or "object")
    camera = read_intrinsics(settings.intrinsics)
    images = list_depth_images(source, settings.mask)
    of_bop = ("frame", "depth_folder")
    return run_extract(
        images,
        partial(cut_image, camera=camera, settings=settings, names=names),
        output,
        settings={
            "extract": "extract_depth",
            "camera": recorded(camera),
            **recorded(settings, "intrinsics", "mask", *of_bop),
            "names": names,
        },
        class_names=sorted({settings.class_name, *names.values()}),
        planned=None if settings.instances else len(images),
        min_points=settings.cut.min_points,
    )


@dataclass(frozen=True)
class DepthImage:
    """One depth image to cut objects from."""

    id: str
    """Its file name without ending."""
    path: Path
    """The file."""
    mask: Path | None
    """Its mask, or None where a box tells the object."""


def list_depth_images(source: Path, mask: Path | None = None) -> list[DepthImage]:
    """List the depth images of a file or folder with the masks of the same name.

    Args:
        source: A depth image, or a folder with nothing else of those endings in it.
        mask: The mask of one image, a folder of masks named as their images, or None.

    Raises:
        InputError: where there is no image, two have one name, or a mask is missing.
    """
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
    if mask is not None and not mask.exists():
        raise InputError(f"{mask}: no such file or folder")
    if mask is None or mask.is_file():
        if mask is not None and len(paths) > 1:
            raise InputError(f"{mask}: one mask for {len(paths)} depth images; name a folder")
        return [DepthImage(name, path, mask) for name, path in paths.items()]
    masks = _images(mask)
    for name, path in paths.items():
        if name not in masks:
            raise InputError(f"{mask}: no mask {name}.png for {path}")
    return [DepthImage(name, path, masks[name]) for name, path in paths.items()]


def _images(folder: Path) -> dict[str, Path]:
    images: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or path.suffix.lower() not in DEPTH_FILES:
            continue
        if path.stem in images:
            raise InputError(f"{path}: {images[path.stem].name} has the same name; rename one")
        images[path.stem] = path
    return images


def cut_image(
    image: DepthImage,
    camera: Intrinsics,
    settings: DepthImageSettings,
    names: Mapping[str, str],
) -> Iterator[ExtractedCloud]:
    """Cut the objects from one depth image.

    Raises:
        InputError: where a file is damaged, sizes differ, or the box is outside the image.
    """
    depth = read_depth(image.path, settings.depth_scale or camera.depth_scale)
    camera.check_size(depth.shape, str(image.path))
    level = upright(settings.gravity)
    for number, mask in _objects(image, settings, depth.shape):
        keep = keep_pixels(depth, mask, settings.cut)
        points = as_cloud(turn(level, lift(depth, keep, camera)), str(image.path))
        if len(points) < settings.cut.min_points:
            continue
        keys = [image.id]
        if settings.instances:
            keys = [f"{image.id}/{number}", f"*/{number}", image.id]
        yield ExtractedCloud(
            id=keys[0],
            class_name=next((names[key] for key in keys if key in names), settings.class_name),
            points=points,
            split=settings.split,
            source={"image": image.path.name, "points": len(points), "pixels": int(mask.sum())},
        )


def _objects(
    image: DepthImage, settings: DepthImageSettings, shape: tuple[int, ...]
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
        yield 1, window
        return
    mask: Int32[np.ndarray, "h w"] = read_mask(image.mask, shape)
    if not settings.instances:
        yield 1, (mask != 0) & window
        return
    numbers = np.unique(mask[mask != 0])
    if len(numbers) > _MOST_INSTANCES:
        raise InputError(f"{image.mask}: {len(numbers)} instances; is it a mask of instances?")
    for number in numbers.tolist():
        yield number, (mask == number) & window


def read_names(path: Path) -> dict[str, str]:
    """Read which image, instance or object is of which class from a CSV with name and class.

    Raises:
        InputError: where it is no such file, or a name is empty or comes twice.
    """
    path = Path(path)
    content = read_small(path, _LARGEST_TABLE, "a table of classes")
    names: dict[str, str] = {}
    try:
        rows: Any = csv.DictReader(
            io.StringIO(content.decode("utf-8-sig"), newline=""), strict=True
        )
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
