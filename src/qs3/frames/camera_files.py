"""Cameras of depth images as users have them: four numbers, and files of many programs."""

import contextlib
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from qs3.errors import InputError, say_once
from qs3.files import read_json, table_of
from qs3.frames.camera_tables import NoCameraError, camera_of, k_of, of_matrix
from qs3.frames.images import DEPTH
from qs3.frames.intrinsics import Intrinsics
from qs3.reading import plain_text, reading

CAMERA_FILES = ("intrinsics.json", "intrinsics.txt", "camera.json", "K.txt", "camera_info.yaml")
"""Names of the file that describes the camera of a folder of images."""
_MOST_ALIASES = 16
_FORMS = "give fx,fy,cx,cy, a JSON or YAML file, or a text or npy file of 3×3 numbers"


def read_intrinsics(camera: str | Path, depth_scale: float | None = None) -> Intrinsics:
    """Read a camera from four numbers or from a file.

    ``camera`` is ``fx,fy,cx,cy``; a text or npy file of 3×3 or 4×4 numbers, row by row; a JSON or
    YAML file, see `camera_of`; or a folder with one of `CAMERA_FILES`. ``depth_scale`` replaces the
    file's.
    """
    if not isinstance(camera, str | Path):
        raise InputError(f"intrinsics {str(camera)[:80]!r}: {_FORMS}")
    text, path = str(camera), Path(camera)
    numbers: list[float] = []
    with contextlib.suppress(ValueError):
        numbers = [float(word) for word in text.split(",")]
    if len(numbers) == 4:
        fx, fy, cx, cy = numbers
        return Intrinsics(fx, fy, cx, cy, depth_scale=depth_scale)
    if numbers:
        raise InputError(f"intrinsics {text!r}: {_FORMS}")
    if path.is_dir():
        files = [path / name for name in CAMERA_FILES if (path / name).is_file()]
        if not files:
            names = ", ".join(CAMERA_FILES)
            fix = f"put one there, or {_FORMS} as --intrinsics"
            raise InputError(f"{path}: has no camera file ({names}); {fix}")
        found: dict[Path, Intrinsics] = {}
        strange: list[NoCameraError] = []
        for file in files:
            try:
                found[file] = read_intrinsics(file, depth_scale)
            except NoCameraError as error:  # of another program
                strange.append(error)
        if not found:
            raise strange[0]
        (first, camera_there), *others = found.items()
        for file, other in others:
            if not camera_there.is_like(other):
                raise InputError(f"{first}: {file.name} beside it differs; remove one")
            if other.distortion != camera_there.distortion:  # none may mean straightened images
                if other.distortion and camera_there.distortion:
                    raise InputError(f"{first}: {file.name} beside it has another lens; remove one")
                say_once(f"{first}: {file.name} beside it has another lens, which does not count")
            names = (name for name, value in vars(camera_there).items() if value is None)
            camera_there = replace(camera_there, **{name: getattr(other, name) for name in names})
        return camera_there
    if not path.is_file():
        raise InputError(f"intrinsics {text!r}: no such file; {_FORMS}")
    if (ending := path.suffix.lower()) == ".xml":
        raise InputError(f"{path}: is XML; let cv2.FileStorage write it under a name in .yaml")
    with reading(path, "a camera"):
        if ending in (".json", ".yaml", ".yml"):
            table = read_json(path) if ending == ".json" else _read_yaml(path)
            if not isinstance(table, list):
                return camera_of(table, path, depth_scale=depth_scale)
            text = str(table)
        elif ending == ".npy":
            with path.open("rb") as handle:
                text = str(np.lib.format.read_array(handle, allow_pickle=False).tolist())
        else:
            try:
                text = re.sub("#.*", "", plain_text(path.read_bytes()).decode())
            except UnicodeDecodeError:
                raise NoCameraError(f"is no text; {_FORMS}") from None
        words = re.split(r"[\s,;\[\]()]+", text.strip(" \t\r\n,;[]()"))
        try:
            numbers = list(map(float, words))
        except ValueError as error:
            raise NoCameraError(f"holds words and no numbers ({error}); {_FORMS}") from error
        if len(numbers) == 4:
            fx, fy, cx, cy = numbers
            return Intrinsics(fx, fy, cx, cy, depth_scale=depth_scale)
        matrix = k_of(numbers, "the matrix")
        return Intrinsics(**of_matrix(matrix), depth_scale=depth_scale)


def camera_of_images(
    images: Path, camera: str | Path = "", depth_scale: float | None = None
) -> Intrinsics:
    """Return the camera of depth images: as `read_intrinsics` reads it, or that beside them.

    If it names no depth scale, that of the file beside the images counts: it is theirs.
    """
    beside = camera_beside(images)
    read = read_intrinsics(camera or beside or images, depth_scale)
    if beside and read.depth_scale is None:
        try:
            read = replace(read, depth_scale=read_intrinsics(beside).depth_scale)
        except InputError as error:  # the other camera is given in place of it
            say_once(f"{error}; if it names a step of depth, it does not count")
    return read


def camera_beside(source: Path) -> str:
    """Return the folder whose file describes the camera of depth images; empty if none does."""
    folder = source if source.is_dir() else source.parent
    places = [folder, folder.parent] if folder.name == DEPTH else [folder]
    held = (place for place in places if any((place / name).is_file() for name in CAMERA_FILES))
    return str(next(held, ""))


def _read_yaml(path: Path) -> Any:
    import yaml  # few cameras come so

    class Loader(yaml.SafeLoader):
        """Plain values, with OpenCV's matrices as tables; no name has two values."""

        def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
            pairs = ((key, value) for key, value in node.value if key.tag != merge)
            table_of([(str(key.value), self.construct_object(value, True)) for key, value in pairs])
            return super().construct_mapping(node, deep)

    merge = "tag:yaml.org,2002:merge"  # it may be overruled
    # 1e-3 is text to YAML 1.1, which asks for a point and a sign.
    number = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)[eE][-+]?\d+$")
    Loader.add_implicit_resolver("tag:yaml.org,2002:float", number, list("-+.0123456789"))
    matrix = "tag:yaml.org,2002:opencv-matrix"
    Loader.add_constructor(matrix, yaml.SafeLoader.construct_yaml_map)
    text = plain_text(path.read_bytes()).decode()
    text = re.sub(r"\A(%.*\n)+", "", text)  # OpenCV 4's has a colon that YAML does not know
    texts = re.split(r"^---\s*$", text, flags=re.MULTILINE)  # ROS may print many messages
    text = next(filter(str.strip, texts), "")
    if sum(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text)) > _MOST_ALIASES:
        raise InputError(f"has over {_MOST_ALIASES} aliases, which may stand for endless values")
    return next(yaml.load_all(text, Loader), None)
