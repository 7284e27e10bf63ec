"""Depth images, infrared images and masks from files: PNG, TIFF and npy."""

import functools
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float32, Int32, Shaped, UInt8, UInt16

from qs3.errors import InputError, say_once
from qs3.escapes import nfc
from qs3.files import state_of
from qs3.frames.masks import object_numbers
from qs3.frames.png_and_tiff import decode_image, decode_palette
from qs3.reading import naming, reading

DEPTH_FILES = (".png", ".tif", ".tiff", ".npy")
"""Endings of depth images and of masks."""

_MASK = frozenset(
    {"mask", "masks", "label", "labels", "instance", "instances"}
    | {"seg", "segmentation", "segmap", "segmaps"}
)
_LAST = re.compile(rf"(?i)[\W_]({'|'.join(sorted(_MASK))})$")
_OTHER = {"color", "colour", "rgb", "image", "ir", "infrared", "infra", "left", "right", "gray"}
_OTHER |= {"grey", "confidence", "confidencemap", "amplitude", "normal", "normals", "normalmap"}
_OTHER |= {"colors", "colours", "texture", "snr", "intensity", "semantic", *_MASK}
"""Words in the names of pictures beside depth."""
_WORDS = frozenset(_OTHER - {"left", "right"} | {"depth", "aligned", "to", "raw"})
_NO_DEPTH = re.compile(
    r"(?i)dispar(ity|ities)|(?<![^\W\d_])disp(?![^\W\d_])|euclid\w*|distance[\W_]*to[\W_]*camera"
    r"|depth[\W_]*perspective|(radial|inverse)[\W_]*d(epth|istance)|distance(?=[\W\d_]*(\.\w+)?$)"
)
"""Names of what is no depth along the optical axis."""
DEPTH = "depth"
"""Folder of the depth images of a capture."""
MILLIMETRE = 0.001
DIVISOR = 50.0
"""A depth scale from here on is one to divide by: no camera has steps of 50 mm, or of 50 m."""
UNIT = "give --depth-scale, metres per step"
"""What to do if the unit of a depth image is wrong, for verbs that have this option."""
_NEAR, _ROOM = 0.1, 10.0  # metres; middle depths that a depth camera is used for
_FAR = 100.0  # metres; no depth camera sees so far
_FAR_PART = 3000  # millimetres; few parts are scanned from farther away
_NONE = 65535  # of 16 bits, how many cameras write what they did not measure
_MARKS = tuple(2**bits - 1 for bits in (11, 12, 13, 14, 15))  # what cameras of fewer write
_NEXT = 0.9  # of such a number; a surface that is so far away has nearer points too
_LARGEST_HALF = 65504  # of floats of 16 bits, what renderers write for infinity
_ONE = 0.9  # of what is farther than _FAR, which a background has as one number
_SOME = 0.001  # of a picture's pixels are more than specks
_PILE = 0.01  # of a picture's pixels with one number are no measurement
_MANY = 50  # different depths from which on their common divisor is no accident
_FINEST = 5e-6  # metres per step of depth; the finest camera we know of has 1e-5
_BESIDE = {".json", ".txt", ".csv", ".yaml", ".yml"}  # cameras, times and names


def read_depth(
    path: Path, depth_scale: float | None = None, fix: str = UNIT
) -> Float32[np.ndarray, "h w"]:
    """Read a depth image: a 16-bit grey PNG, a TIFF of 16 to 64 bits, or an npy array [h w].

    Convention:
        Depth is along the optical axis in metres, NaN if there is none. ``depth_scale`` is metres
        per step; by default whole numbers count millimetres and floating-point numbers metres. 0, a
        negative number, NaN, infinity, 65535 of 16 bits, 65504 of floating-point numbers, and 100 m
        and more are no depth. Nor is the largest whole number if it is 2047 to 32767, of 11 to 15
        bits, is that of 1 % of the pixels, and the next one is a tenth smaller.

    Raises:
        InputError: If depths are negative, or the middle depth is beyond what depth cameras see;
            without a ``depth_scale`` also if floating-point numbers lie beyond 10 m in the middle,
            as centimetres and disparities do. The message ends with ``fix``.
    """
    raw = read_raw(path)
    for name in (path.name, path.parent.name):
        if found := _NO_DEPTH.search(name):
            say_once(
                f"{path}: is called {found[0]}, and is read as depth along the optical axis; save "
                "that if it is another number",
                found[0],
            )
    with naming(path):
        return to_metres(raw, depth_scale, fix)


def check_scale(scale: float) -> None:
    """Refuse a depth scale that is not positive, is to be divided by, or too fine."""
    if not 0 < scale < math.inf:
        raise InputError(f"depth scale {scale:g}: must be positive metres per step")
    if scale >= DIVISOR:
        raise InputError(
            f"depth scale {scale:g}: is metres per step; if depth is to be divided by it, write "
            f"{1 / scale:.7g}"
        )
    if scale < _FINEST:
        raise InputError(
            f"depth scale: {scale:g} m per step of depth is finer than any camera's; in a camera's "
            "file depth_scale is millimetres per step (BOP's), and depth_unit metres"
        )


def to_metres(
    raw: Shaped[np.ndarray, "h w"], depth_scale: float | None = None, fix: str = UNIT
) -> Float32[np.ndarray, "h w"]:
    """Turn the numbers of a depth image into metres, as `read_depth` does."""
    if depth_scale is not None:
        check_scale(depth_scale)
    whole = raw.dtype.kind in "iu"
    scale = depth_scale or (MILLIMETRE if whole else 1.0)
    with np.errstate(over="ignore", invalid="ignore"):
        depth = raw.astype(np.float32) * np.float32(scale)
        depth = np.where((depth > 0) & np.isfinite(depth), depth, np.float32(np.nan))
        if not whole or raw.max(initial=0) <= _NONE:
            depth[raw == _NONE] = np.nan
        if not whole:
            depth[raw == _LARGEST_HALF] = np.nan
        depth = _without_background(depth)
        if whole and _is_mark(raw):
            depth[raw == raw.max()] = np.nan
    below = raw[(raw < 0) & (raw > -np.inf)]  # one number may mark what was not measured
    if len(below) and below.min() < below.max() and not np.isfinite(depth).any():
        raise InputError("its depths are negative: z looks backwards, as OpenGL's; negate them")
    some = depth[::8, ::8]
    middle = np.median(some[np.isfinite(some)]) if np.isfinite(some).any() else 1.0
    if not 0.005 < middle < _FAR:
        raise InputError(
            f"its middle depth would be {middle:.4g} m, which no depth camera sees; {fix} (now "
            f"{scale:g}; {'0.001 if it holds millimetres' if middle > 1 else '1 if metres'})"
        )
    if depth_scale is None:
        _doubt(raw, fix)
    if depth_scale is None and not _NEAR < middle < _ROOM:
        unit = "millimetres" if whole else "metres"
        fault = f"its middle depth would be {middle:.4g} m if it holds {unit}"
        if not whole and middle > _ROOM:
            raise InputError(
                f"{fault}; {fix} (1 if so, 0.01 if centimetres; disparities are no depth)"
            )
        say_once(f"{fault}; if that is wrong, {fix}", "depth")
    elif middle < _NEAR:
        say_once(
            f"its middle depth is {middle:.4g} m; if that is wrong, {fix} (now {scale:g})", "depth"
        )
    depth[depth >= _FAR] = np.nan  # the background of a rendered image
    return depth


def _doubt(raw: Shaped[np.ndarray, "h w"], fix: str) -> None:
    """Report numbers that look like no depth in metres or millimetres."""
    if raw.dtype.kind == "f":
        if raw.max(initial=0) == 1 and raw.min(initial=0) >= 0 and np.mean(raw == 1) > _PILE:
            say_once("its largest number, 1, comes often: if depth runs from 0 to 1, render metres")
        return
    values = np.unique(raw[(raw > 0) & (raw < _NONE)])
    step = int(np.gcd.reduce(values)) if len(values) >= _MANY else 1
    # Multiples of 10 are whole centimetres too, but no camera sees these so far away.
    is_tenth = step == 10 and np.median(values) > _FAR_PART
    if is_tenth or step == 5 or (step >= 8 and step.bit_count() == 1):
        say_once(
            f"all its numbers are multiples of {step}: those of TUM RGB-D are 5 times millimetres, "
            f"and of SUN RGB-D 8 times; if these are {step} times, {fix} ({MILLIMETRE / step:g})"
        )


def _is_mark(raw: Shaped[np.ndarray, "h w"]) -> bool:
    """Return whether the largest number marks what was not measured: full bits, often, alone."""
    top = raw.max(initial=0)
    if top not in _MARKS or np.mean(raw == top) < _PILE:
        return False
    is_alone = bool(0 < raw[raw < top].max(initial=0) < _NEXT * top)
    if is_alone:
        say_once(f"its largest number, {top}, is of full bits and comes often: it is no depth")
    return is_alone


def _without_background(depth: Float32[np.ndarray, "h w"]) -> Float32[np.ndarray, "h w"]:
    """Return depth without a renderer's background: one number beyond 100 m, beside nearer ones."""
    far = depth >= _FAR
    if not far.any() or np.mean(depth < _FAR) < _SOME:
        return depth
    is_one = np.mean(depth[far] == depth[far].max()) >= _ONE
    return np.where(far, np.float32(np.nan), depth) if is_one else depth


def list_images(folder: Path) -> dict[str, Path]:
    """List the images of a folder, or of its ``depth``, as `list_files` does.

    If some are called depth, those called after another picture (color, ir, mask, disparity …) are
    left out, and those of the same name without that word. Else those are left out that are called
    after another picture, and without that word have the name of one that is not.
    """
    files = list_files(folder / DEPTH if (folder / DEPTH).is_dir() else folder, DEPTH_FILES)
    called = {name for name in files if DEPTH in _plain(name)}
    strange = {name for name in files if _is_other(_plain(name))} - called
    twins: dict[tuple[str, ...], str] = {}
    for name in sorted(called or files.keys() - strange):
        if (other := twins.setdefault(bare(name), name)) != name and called:
            say_once(
                f"{folder}: {other} and {name} may be one picture twice, and the camera is that of "
                "one; remove the other",
                "twice",
            )
    suffices = any if called else all
    others = {
        name for name in files.keys() - called if suffices((name in strange, bare(name) in twins))
    }
    if others:
        say_once(f"{folder}: {len(others)} pictures, such as {min(others)}, are left out: no depth")
    return {name: path for name, path in files.items() if name not in others}


def _is_other(plain: str) -> bool:
    words = re.split(r"[\W\d_]+", plain)
    return not _OTHER.isdisjoint(words) or _NO_DEPTH.search(plain) is not None


def bare(name: str, kinds: frozenset[str] = _WORDS) -> tuple[str, ...]:
    """Return the words and numbers of a picture's name but those of its kind: depth, color, mask.

    Example:
        >>> bare("frame-0004.color") == bare("depth_frame_0004"), bare("left_4") == bare("4")
        (True, False)
    """
    words = re.findall(r"[^\W\d_]+|\d+", _plain(name))
    return tuple(word for word in words if word not in kinds)


def _plain(name: str) -> str:
    """Return a name in small letters, with the word depth in place of Isaac Sim's."""
    return nfc(name).casefold().replace("distance_to_image_plane", DEPTH)


def holds_images(folder: Path) -> bool:
    """Return whether a folder holds depth images and no other data."""
    if (folder / DEPTH).is_dir():
        return True
    files = [path for path in folder.iterdir() if path.is_file() and path.name[0] != "."]
    endings = {path.suffix.lower() for path in files} - _BESIDE
    return bool(endings - {".npy"}) and endings <= {*DEPTH_FILES}


def list_files(folder: Path, endings: tuple[str, ...]) -> dict[str, Path]:
    """List the files of a folder by their names without ending, in the order of their numbers."""
    files: dict[str, Path] = {}
    taken: dict[str, str] = {}  # some disks take A and a for one
    for path in sorted(folder.iterdir(), key=natural):
        if path.name[0] == "." or path.suffix.lower() not in endings or path.is_dir():
            continue
        if (other := taken.setdefault(path.stem.casefold(), path.name)) != path.name:
            raise InputError(f"{path}: {other} has the same name; rename one")
        files[path.stem] = path
    return files


def find_image(folder: Path, name: str) -> Path:
    """Return the image of a name, with any ending of `DEPTH_FILES`; .png if there is none."""
    found = [path for ending in DEPTH_FILES if (path := folder / (name + ending)).is_file()]
    if len(found) > 1:
        raise InputError(f"{found[1]}: {found[0].name} has the same name; remove one")
    return found[0] if found else folder / f"{name}.png"


def find_mask(folder: Path, image: Path) -> Path:
    """Return the mask of an image, as `find_image` does; never the image itself.

    If none has its name, but one alone has it before a word for masks, or without its own words for
    kinds of pictures (`bare`), it is that one: the mask depth_4_mask, mask_4 or 4-label of depth_4.
    In the folder of the image it must have such a word.

    Raises:
        InputError: If the folder holds the image itself and no mask of it.
    """
    path = find_image(folder, name := image.stem)
    is_image = path.is_file() and path.resolve() == image.resolve()
    if (path.is_file() and not is_image) or not folder.is_dir():
        return path
    masks = _masks_by_name(folder.absolute(), state_of(folder))
    keys = (nfc(name), bare(name))
    listed = [[one for one in masks.get(key, []) if one.name != image.name] for key in keys]
    if is_image:  # other pictures of it may lie there as well
        none = frozenset[str]()
        listed = [[one for one in each if _MASK & {*bare(one.stem, none)}] for each in listed]
    found = next(filter(None, listed), [])
    if is_image and len(found) != 1:
        raise InputError(f"{folder}: holds {image.name} itself and no mask {name}_mask.png of it")
    return folder / found[0].name if len(found) == 1 else path


@functools.lru_cache(maxsize=8)  # every image of a folder asks
def _masks_by_name(folder: Path, _state: tuple[int, ...]) -> Mapping[Any, list[Path]]:
    """Return the masks of each name, which macOS decomposes, also without words for masks.

    They are listed again if the folder has changed.
    """
    masks: dict[Any, list[Path]] = {}
    for name, path in list_files(folder, DEPTH_FILES).items():
        for key in {nfc(name), _LAST.sub("", nfc(name)), bare(name, _MASK)}:
            masks.setdefault(key, []).append(path)
    return masks


def natural(path: Path) -> tuple[list[tuple[str, int, str]], str]:
    """Return a key that sorts names by the numbers in them: f-1, f-2.25, f-2.5, f-10."""
    parts = re.findall(r"(\D*)(\d*)((?:\.\d+)?)", path.name.casefold())
    return [(text, int(whole or 0), fraction) for text, whole, fraction in parts], path.name


def read_raw(path: Path) -> np.ndarray:
    """Read the numbers [h w] of a depth image as they are stored."""
    image = _read(path, "iuf")
    if image.ndim != 2:
        raise InputError(
            f"{path}: a colour picture, not depth; depth is one grey channel of 16 bits"
        )
    if image.dtype.itemsize == 1:
        raise InputError(
            f"{path}: has 8 bits, which is a picture of depth and no measurement; save depth as "
            "16-bit PNG in millimetres, TIFF or npy"
        )
    return image


def read_infrared(path: Path) -> UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]:
    """Read an infrared image of 8 or 16 bits; three channels, as viewers store it, become grey."""
    import cv2

    image = _read(path, "u")
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: holds {image.dtype}; an infrared image has 8 or 16 bits")
    if image.ndim == 3:
        image = cv2.cvtColor(np.ascontiguousarray(image[..., :3]), cv2.COLOR_BGR2GRAY)
    return image


def read_mask(
    path: Path, shape: tuple[int, ...] | None = None, instances: bool = False
) -> Int32[np.ndarray, "h w"]:
    """Read a mask: 0 is background, other numbers are objects, as `masks.object_numbers` has it.

    With ``instances`` a mask whose numbers are no objects, such as one with soft edges, is refused.
    """
    palette = None
    if path.suffix.lower() in DEPTH_FILES[:-1]:
        with reading(path):
            palette = decode_palette(path.read_bytes())
    picture = palette or _read(path, "iub")
    height, width = (picture if isinstance(picture, np.ndarray) else picture.indices).shape[:2]
    if shape is not None and (height, width) != shape[:2]:
        raise InputError(
            f"{path}: is {width}×{height} pixels, the depth image {shape[1]}×{shape[0]}; give the "
            "mask of this image"
        )
    with naming(path):
        return object_numbers(picture, instances)


def _read(path: Path, npy_kinds: str) -> np.ndarray:
    ending = path.suffix.lower()
    if ending not in DEPTH_FILES:
        raise InputError(
            f"{path}: not an image of a depth camera; known are {', '.join(DEPTH_FILES)}"
        )
    with reading(path):
        if ending != ".npy":
            return decode_image(path.read_bytes())
        with path.open("rb") as handle:
            array = np.lib.format.read_array(handle, allow_pickle=False)
    if array.ndim == 3 and 1 in array.shape:
        array = array.squeeze()
    if array.dtype.kind not in npy_kinds or array.ndim != 2 or not array.size:
        raise InputError(
            f"{path}: holds {array.dtype} of shape {list(array.shape)}; needed are "
            f"{'' if 'f' in npy_kinds else 'whole '}numbers of shape [h, w]"
        )
    return array
