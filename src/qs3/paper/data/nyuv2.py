"""Objects from NYU Depth v2's labelled frames: depth, class and instance of every pixel.

``nyu_depth_v2_labeled.mat`` is MATLAB's version 7.3, which is HDF5: arrays of h × w × 1449 lie
there as [1449 w h], and a cell of text is an array of references to arrays of characters. Frames
are read one by one.

Convention:
    Depth is aligned to the colour camera, in metres. As in the data set's toolbox
    (``camera_params.m``, ``rgb_plane2rgb_world.m``), the colour camera's intrinsics lift it, with
    pixels counted from 1; those of the depth camera (fx 582.62) hold for the raw dumps. Pixels
    outside its ``get_projection_mask.m`` were not measured and are left out. z is up, y the viewing
    direction as far as it is level, x to the right; z is 0 on the labelled floor, else the camera
    is the origin.
    The file's ``accelData`` is not used: the page calls it roll, yaw, pitch, the toolbox x, y, z.

Source: Silberman, Hoiem, Kohli and Fergus, "Indoor segmentation and support inference from RGBD
images", ECCV 2012 (https://cs.nyu.edu/~silberman/datasets/nyu_depth_v2.html).
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Bool, Float

from qs3.checks import INLINE
from qs3.errors import InputError
from qs3.frames.intrinsics import Intrinsics
from qs3.meshes.classes import canonical
from qs3.meshes.sizes import CLASS_SIZES
from qs3.objects.cut import CutSettings, as_cloud, keep_pixels, lift, turn, upright
from qs3.objects.run import (
    ExtractedCloud,
    ExtractReport,
    OutputSettings,
    recorded,
    run_extract,
    wanted_classes,
)
from qs3.paper.data.hdf5 import DEFLATE, check_dataset, open_dataset
from qs3.paper.data.scannet_scene import class_of
from qs3.points.planes import fit_plane, room_up
from qs3.reading import check_size, reading

FILE, SPLITS = "nyu_depth_v2_labeled.mat", "splits.mat"
_MEASURED = (slice(44, 471), slice(40, 601))
CAMERA = Intrinsics(518.85790117450188, 519.46961112127485,
                    324.58244941119034 - 40, 252.73736163340047 - 44)  # fmt: skip
"""The colour camera, from the toolbox's ``camera_params.m``; pixels count from 0, of the part that
was measured."""
WORDS: Mapping[str, str] = {
    "game table": "table",
    "endtable": "end table",
    "light": "",  # mostly on a ceiling or a wall; what stands is called lamp
    "piano bench": "chair",
    "ping pong table": "table",
    "pool table": "table",
}
"""Words of its annotators that the common table of class names does not hold, or not so."""

_ARRAYS = ("rawDepths", "labels", "instances")
_FLOOR = 500  # pixels of floor that fix a plane
_UP = np.array([0.0, -1.0, 0.0])


@dataclass(frozen=True)
class Nyuv2Settings:
    """Settings for objects from the labelled frames of NYU Depth v2."""

    splits: Path | None = None
    """The official splits.mat with train and test frames; by default the one beside the file, if
    there is one."""
    classes: tuple[str, ...] = ("pointda10",)
    """Classes to map the objects onto; pointda10 for its ten, all for the annotators' own."""
    strict: bool = False
    """Only objects that the image's border does not cut, over a floor that was found, of 2,500
    pixels, nearer than 5 m and of a size that their class has."""
    cut: Annotated[CutSettings, INLINE] = field(
        default_factory=lambda: CutSettings(far=10.0, erode=2)
    )
    """Rules for the pixels to keep; at 10 m the file's depth is capped."""

    def __post_init__(self) -> None:
        wanted_classes(self.classes)


@dataclass(frozen=True)
class NyuFrame:
    """One labelled frame; numbers count from 1 as in ``splits.mat``."""

    number: int
    split: str
    scene: str

    @property
    def id(self) -> str:
        """Such as nyu0001."""
        return f"nyu{self.number:04d}"


def extract_nyuv2(source: Path, output: OutputSettings, settings: Nyuv2Settings) -> ExtractReport:
    """Cut the labelled objects from nyu_depth_v2_labeled.mat, or from its folder."""
    path = source / FILE if source.is_dir() else source
    classes = wanted_classes(settings.classes)
    frames, words = list_nyuv2(path, settings.splits)
    named = {i: word.strip() for i, word in words.items()}
    if classes is not None:
        plain = {i: word.lower().replace("_", " ") for i, word in named.items()}
        named = {i: class_of(WORDS.get(word, word), classes) for i, word in plain.items()}
    kinds = {i: (words[i], name) for i, name in named.items() if name}
    if not kinds:
        raise InputError(f"{path}: none of its {len(words)} classes is one of --classes")
    floors = tuple(i for i, word in words.items() if word == "floor")
    return run_extract(
        frames,
        partial(cut_frame, path=path, settings=settings, kinds=kinds, floors=floors),
        output,
        settings={"extract": "extract_nyuv2", **recorded(settings, "splits", "classes")},
        class_names=classes or sorted({name for _, name in kinds.values()}),
        min_points=settings.cut.min_points,
    )


def list_nyuv2(path: Path, splits: Path | None = None) -> tuple[list[NyuFrame], dict[int, str]]:
    """List the frames of the file, and the word of each label; images are not read."""
    import h5py

    with reading(path, "NYU Depth v2", streamed=True), h5py.File(path, "r") as opened:
        file: Any = opened
        count = len(open_dataset(file, "labels"))
        words = dict(enumerate(_texts(file, "names"), start=1))
        scenes = _texts(file, "scenes")
        for name in _ARRAYS:
            open_dataset(file, name)
    beside = path.with_name(SPLITS)
    splits = splits or (beside if beside.is_file() else None)
    numbers = range(1, count + 1)
    parts = dict.fromkeys(numbers, "")
    if splits:
        listed = [(i, name) for name, frames in _read_splits(splits).items() for i in frames]
        if sorted(i for i, _ in listed) != [*numbers]:
            raise InputError(
                f"{splits}: its trainNdxs and testNdxs do not name all {count} frames, each once"
            )
        parts = dict(listed)
    return [NyuFrame(i, parts[i], scenes[i - 1]) for i in numbers], words


def _texts(file: Any, name: str) -> list[str]:
    """Return a MATLAB cell of text: references to arrays of characters."""
    texts = []
    for cell in np.ravel(open_dataset(file, name)):
        check_dataset(file[cell])
        texts.append("".join(map(chr, np.ravel(file[cell]))).strip("\0"))
    check_size(name, sum(map(len, texts)))
    return texts


def _read_splits(path: Path) -> dict[str, list[int]]:
    from scipy.io import loadmat

    names = {"train": "trainNdxs", "test": "testNdxs"}
    with reading(path, "a MAT file"):
        check_size("its content", DEFLATE * path.stat().st_size)
        table = loadmat(path, variable_names=list(names.values()))
        return {
            split: np.ravel(table.get(name, ())).astype(np.int64).tolist()
            for split, name in names.items()
        }


def cut_frame(
    frame: NyuFrame,
    path: Path,
    settings: Nyuv2Settings,
    kinds: Mapping[int, tuple[str, str]],
    floors: tuple[int, ...],
) -> Iterator[ExtractedCloud]:
    """Cut the objects of one frame.

    ``kinds`` has word and class of each label that is wanted, ``floors`` the labels of floors.
    """
    import h5py

    with reading(path, "NYU Depth v2", streamed=True), h5py.File(path, "r") as opened:
        file: Any = opened
        depth, labels, instances = (file[array][frame.number - 1].T[_MEASURED] for array in _ARRAYS)
    depth = np.where((depth > 0) & np.isfinite(depth), depth, np.nan).astype(np.float32)
    gate = CutSettings(settings.cut.near, settings.cut.far)
    rotation, rise, floor_ok = level(depth, keep_pixels(depth, np.isin(labels, floors), gate))
    wanted = np.isin(labels, list(kinds))
    pairs = np.unique(np.stack([labels[wanted], instances[wanted]], axis=1), axis=0)
    for label, number in pairs.tolist():
        mask = (labels == label) & (instances == number)
        seen = depth[keep := keep_pixels(depth, mask, settings.cut)]
        if len(seen) < settings.cut.min_points:
            continue
        word, class_name = kinds[label]
        points = turn(rotation, lift(depth, keep, CAMERA)) + np.array([0.0, 0.0, rise])
        facts = {
            "raw": word,
            "frame": frame.number,
            "scene": frame.scene,
            "pixels": int(mask.sum()),
            "points": len(points),
            "depth": float(np.median(seen)),
            "cut": sum(bool(edge.any()) for edge in (mask[0], mask[-1], mask[:, 0], mask[:, -1])),
            "floor_ok": floor_ok,
        }
        facts["strict"] = _strict(facts, points, class_name)
        if facts["strict"] or not settings.strict:
            cloud = as_cloud(points, frame.id)
            identifier = f"{frame.id}/{label:03d}_{number:02d}"
            yield ExtractedCloud(identifier, class_name, cloud, frame.split, facts)


def level(
    depth: Float[np.ndarray, "h w"], floor: Bool[np.ndarray, "h w"]
) -> tuple[Float[np.ndarray, "3 3"], float, bool]:
    """Return the rotation of camera points to z up, the shift of z, and whether a floor was found.

    The floor is the plane of the pixels that are labelled so, within 45° of level; without one the
    room's own surfaces decide (`plane.room_up`).
    """
    if floor.sum() >= _FLOOR:
        points = lift(depth, floor, CAMERA)
        plane = fit_plane(points, 0.03, _UP)
        if plane is not None and (np.abs(plane.heights(points)) <= 0.03).mean() >= 0.5:
            return upright(tuple(-plane.normal)), -plane.offset, True
    step = slice(None, None, 4)
    every = lift(np.nan_to_num(depth), np.ones(depth.shape, dtype=bool), CAMERA)
    every[every[:, 2] == 0] = np.nan
    up = room_up(every.reshape(*depth.shape, 3)[step, step], _UP)
    return upright(tuple(-up)), 0.0, False


def _strict(facts: Mapping[str, Any], points: Float[np.ndarray, "n 3"], class_name: str) -> bool:
    """Whether a view is whole, near and of a size of its class; half of the size is enough."""
    low, high = CLASS_SIZES.get(canonical(class_name), ((0.0, np.inf),))[0]
    longest = float(np.ptp(points, axis=0).max())
    whole = facts["floor_ok"] and not facts["cut"] and facts["pixels"] >= 2500
    return bool(whole and facts["depth"] < 5 and low / 2 <= longest <= 1.25 * high)
