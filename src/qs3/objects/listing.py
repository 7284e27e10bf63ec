"""Objects of one depth image: its settings, its objects, and their points."""

import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float

from qs3.checks import INLINE, Bounds, Option, check
from qs3.errors import InputError, first_few, say_once
from qs3.escapes import nfc
from qs3.frames.images import UNIT, read_depth, read_mask
from qs3.frames.intrinsics import Intrinsics
from qs3.objects.cut import CutSettings, as_cloud, keep_pixels, lift, turn, upright
from qs3.objects.rim import on_object
from qs3.objects.run import ExtractedCloud
from qs3.reading import naming

_MOST_INSTANCES = 4096
_BLEED = 4  # pixels: detectors draw masks on a grid of every fourth


@dataclass(frozen=True)
class DepthImageSettings:
    """Settings for objects from depth images of any camera, or from scenes in BOP's layout."""

    intrinsics: str = ""
    """fx,fy,cx,cy; a JSON or YAML file of a camera; or a text file of 3×3 numbers; default: the
    camera's file beside the images (intrinsics.json, K.txt …)."""
    mask: Path | None = None
    """The mask of the image, or a folder of masks with the images' names; not 0 is the object."""
    instances: bool = False
    """Each number of a mask is an object of its own."""
    depth_scale: float | None = None
    """Metres per step of the images; None takes the camera's, else 0.001 for whole numbers and 1
    for others."""
    class_name: Annotated[str, Option(name="class")] = ""
    """Class of every object; object, or obj_000001 and so on, by default."""
    names: Path | None = None
    """CSV with the columns name and class: of an image (a), an instance (a/1, or */1 in any image)
    or a model of BOP (1 or obj_000001)."""
    frame: Literal["auto", "world", "camera", "model"] = "auto"
    """Axes of the clouds, in BOP's layout: auto is the world if the scene has it."""
    depth_folder: str = "depth"
    """Folder of the depth pictures in a scene of BOP's layout; depth_true, of qs3 scan --frames,
    gives clean twins."""
    gravity: tuple[float, float, float] = (0.0, 1.0, 0.0)
    """Downward direction in the camera's axes (x right, y down, z forward), which z is turned
    against."""
    split: str = ""
    """Name of the split of every object, such as train or test."""
    bleed: Annotated[int | None, Bounds(high=100)] = None
    """Pixels by which a mask may reach beyond its object, as those of detectors do: of this rim go
    pixels that continue the background. None is 4, and 0 in BOP's layout, whose masks are exact."""
    cut: Annotated[CutSettings, INLINE] = field(default_factory=CutSettings)
    """Rules for the pixels to keep."""

    def __post_init__(self) -> None:
        check(self, "depth")
        upright(self.gravity)
        if not re.fullmatch(r"\w+", self.depth_folder):
            raise InputError(
                f"{self.depth_folder!r} is no folder of a scene; give a name such as depth"
            )


@dataclass(frozen=True)
class FrameObject:
    """An object of a depth image, or all instances of its mask."""

    id: str
    """Name of its cloud; of instances ``id/number``."""
    mask: Path
    to_axes: Float[np.ndarray, "k k"]
    """Camera to the axes of the cloud: a rotation, or a pose in metres."""
    class_name: str = ""
    source: Mapping[str, object] = field(default_factory=dict)


@dataclass(frozen=True)
class Frame:
    """A depth image to cut objects from."""

    id: str
    path: Path
    camera: Intrinsics
    objects: tuple[FrameObject, ...]
    fix: str = UNIT
    """What to do if the unit of its depth is wrong."""
    bleed: int = _BLEED
    """Pixels by which its masks may reach beyond their objects."""


def cut_frame(
    frame: Frame, settings: DepthImageSettings, names: Mapping[str, str]
) -> Iterator[ExtractedCloud]:
    """Cut the objects from one depth image.

    ``names`` gives the class by the object: ``a``, or of an instance ``a/1`` or ``*/1``.
    """
    bleed, depth = settings.bleed, read_depth(frame.path, frame.camera.depth_scale, frame.fix)
    frame.camera.check_size(depth.shape, str(frame.path))
    for item in frame.objects:
        mask = read_mask(item.mask, depth.shape, settings.instances)
        numbers = np.unique(mask[mask != 0]).tolist() if settings.instances else [None]
        if len(numbers) > _MOST_INSTANCES:
            raise InputError(f"{item.mask}: {len(numbers)} instances; is it a mask of instances?")
        if settings.instances:
            objects = [_keys(item.id, number) for number in numbers]
            check_names(settings.names, names, objects, f"{nfc(item.id)}/")
        for number in numbers:
            pixels = (mask != 0) if number is None else (mask == number)
            with naming(frame.path):
                kept = on_object(depth, pixels, mask == 0, frame.bleed if bleed is None else bleed)
                local = lift(depth, keep_pixels(depth, kept, settings.cut), frame.camera)
            if len(local) < settings.cut.min_points:
                continue
            points = turn(item.to_axes[:3, :3], local)
            if len(item.to_axes) == 4:
                points = points + item.to_axes[:3, 3]
            keys = _keys(item.id, number)
            named = next((names[key] for key in keys if key in names), settings.class_name)
            yield ExtractedCloud(
                id=item.id if number is None else f"{item.id}/{number}",
                class_name=item.class_name or named,
                points=as_cloud(points, str(frame.path)),
                split=settings.split,
                source={**item.source, "points": len(points), "pixels": int(pixels.sum())},
            )


def _keys(name: str, number: int | None) -> list[str]:
    """Return the names that a row of an object may have, the first of them first."""
    keys = [name] if number is None else [f"{name}/{number}", f"*/{number}", name]
    return [nfc(key) for key in keys]


def check_names(
    table: Path | None, names: Iterable[str], objects: Iterable[Sequence[str]], start: str = ""
) -> None:
    """Report rows of a table that name nothing; refuse them if an object has no row.

    ``names`` are those of the rows; checked are those that begin with ``start``. ``objects`` has
    for each object the names that its row may have.
    """
    rows, objects = {*names}, list(objects)
    known = {name for keys in objects for name in keys}
    unknown = sorted(name for name in rows - known if name.startswith(start))
    if unknown:
        fault = f"{table}: nothing here is called {first_few(unknown, 5)}"
        for keys in objects:
            if rows.isdisjoint(keys):
                raise InputError(f"{fault}, and {keys[0]} has no row")
        say_once(fault)
