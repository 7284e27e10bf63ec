"""GraspNetPC-10: ten objects, rendered and seen by two real cameras.

``<train|test>/<Synthetic|Real>/<kinect|realsense>/<0-9>/*.xyz``, 1,024 points a cloud. The three
domains of the customary tasks are Synthetic (both cameras together), Real/kinect, Real/realsense.

Convention:
    Points are in the camera's frame of the release and are read as they are: no axis is turned.
    The folder's digit is the label.

Source: Shen et al., "Domain Adaptation on Point Clouds via Geometry-Aware Implicits", CVPR 2022.
"""

from functools import partial
from pathlib import Path

from qs3.errors import InputError
from qs3.io.class_folders import SPLITS, CloudFile, choose_split, read_files
from qs3.io.layouts.format import Format
from qs3.io.layouts.point_folders import write_files
from qs3.io.ragged import RaggedClouds
from qs3.meshes.classes import map_labels

CLASSES = (
    "box",
    "can",
    "banana",
    "power drill",
    "scissors",
    "pear",
    "dish",
    "camel",
    "mouse",
    "shampoo",
)
POINTS = 1024
_CAMERAS = ("kinect", "realsense")
_DIGITS = tuple(str(digit) for digit in range(len(CLASSES)))


def read_domain(root: Path, split: str | None, kind: str, cameras: tuple[str, ...]) -> RaggedClouds:
    """Read one domain.

    Args:
        root: Folder that holds train and test.
        split: ``train`` or ``test``; None takes both.
        kind: ``Synthetic`` or ``Real``.
        cameras: Folders below it.

    Raises:
        InputError: where the folder holds no such domain, a class folder is no digit, or a file is
            bad.
    """
    if not root.is_dir():
        raise InputError(f"{root}: no such folder")
    files = []
    for part in SPLITS:
        for camera in cameras:
            files += _domain_files(root / part / kind / camera, part)
    if not files:
        where = " or ".join(f"{kind}/{camera}" for camera in cameras)
        raise InputError(f"{root}: no cloud in <train|test>/{where}/<0-9>/*.xyz")
    return read_files(root, choose_split(root, files, split), CLASSES)


def _domain_files(folder: Path, part: str) -> list[CloudFile]:
    if not folder.is_dir():
        return []
    found = []
    for inner in sorted(path for path in folder.iterdir() if not path.name.startswith(".")):
        if not inner.is_dir():
            continue
        if inner.name not in _DIGITS:
            raise InputError(f"{inner}: class folders are 0 to {len(CLASSES) - 1} in this layout")
        paths = sorted(path for path in inner.iterdir() if path.suffix.lower() == ".xyz")
        name = CLASSES[int(inner.name)]
        found += [CloudFile(path, name, part) for path in paths if not path.name.startswith(".")]
    return found


def write_domain(root: Path, clouds: RaggedClouds, kind: str, camera: str) -> None:
    """Write one domain of one camera.

    Args:
        root: Folder to make.
        clouds: What to write, of GraspNetPC-10's classes only.
        kind: ``Synthetic`` or ``Real``.
        camera: ``kinect`` or ``realsense``.

    Raises:
        InputError: where there are no labels, a class is none of the ten, a cloud has no split or
            another number of points.
    """
    if clouds.labels is None:
        raise InputError("this layout needs labels, and the clouds have none")
    if not clouds.splits or any(split not in SPLITS for split in clouds.splits):
        raise InputError("this layout needs train or test for every cloud, and some have neither")
    labels, _ = map_labels(clouds.class_names, clouds.labels, CLASSES)
    for cloud, name in zip(clouds.clouds, clouds.ids, strict=True):
        if len(cloud) != POINTS:
            raise InputError(
                f"{name}: has {len(cloud)} points, and this layout has {POINTS}; add --num-points "
                f"{POINTS}"
            )
    folders = [
        f"{split}/{kind}/{camera}/{label}"
        for split, label in zip(clouds.splits, labels.tolist(), strict=True)
    ]
    write_files(root, clouds, folders, ".xyz")


def _detect(kind: str, cameras: tuple[str, ...], path: Path) -> bool:
    return all(any((path / part / kind / camera).is_dir() for part in SPLITS) for camera in cameras)


def _read(kind: str, cameras: tuple[str, ...], path: Path, split: str | None) -> RaggedClouds:
    return read_domain(path, split, kind, cameras)


def _write(kind: str, camera: str, path: Path, clouds: RaggedClouds) -> None:
    write_domain(path, clouds, kind, camera)


def _format(kind: str, cameras: tuple[str, ...]) -> Format:
    one = len(cameras) == 1
    below = cameras[0] if one else f"<{'|'.join(cameras)}>"
    return Format(
        name="-".join(("graspnetpc10", kind.lower(), *(cameras if one else ()))),
        layout=f"GraspNetPC-10: <train|test>/{kind}/{below}/<0-9>/*.xyz, {POINTS} points",
        detect=partial(_detect, kind, cameras),
        read=partial(_read, kind, cameras),
        write=partial(_write, kind, cameras[0]) if one else None,
    )


FORMATS = (
    _format("Synthetic", _CAMERAS),
    _format("Synthetic", ("kinect",)),
    _format("Synthetic", ("realsense",)),
    _format("Real", ("kinect",)),
    _format("Real", ("realsense",)),
)
