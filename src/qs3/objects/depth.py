"""Objects from depth images of any camera, with masks, or from scenes in BOP's layout."""

import dataclasses
from collections.abc import Iterable
from functools import partial
from glob import escape
from pathlib import Path

from qs3.errors import InputError
from qs3.escapes import nfc, utf8
from qs3.frames.camera_files import camera_beside, camera_of_images
from qs3.frames.images import DEPTH_FILES, find_mask, list_images
from qs3.frames.intrinsics import Intrinsics
from qs3.objects.bop import MASKS, TRUTH, bop_scenes, list_bop_frames
from qs3.objects.cut import upright
from qs3.objects.listing import DepthImageSettings, Frame, FrameObject, check_names, cut_frame
from qs3.objects.run import ExtractReport, OutputSettings, recorded, run_extract
from qs3.reading import reading

_OF_SCENE = ("intrinsics", "mask", "depth_scale", "instances")


def extract_depth(
    source: Path, output: OutputSettings, settings: DepthImageSettings
) -> ExtractReport:
    """Cut objects from depth images of any camera, or from scenes in BOP's layout.

    The source is a depth image (16-bit PNG, TIFF, npy), a folder of them, or a scene in BOP's
    layout or a folder of such scenes, such as the frames/ of qs3 scan --frames. A camera's file
    beside the depth images, as qs3 capture writes it, is read without --intrinsics.

    Convention:
        Metres; the camera is the origin, axes as in `cut.upright`. For BOP see `bop`.
    """
    names = {} if settings.names is None else read_names(settings.names)
    names = {nfc(name): nfc(kind) for name, kind in names.items()}
    axes = ""
    if bop_scenes(source):
        for name in _OF_SCENE:
            if getattr(settings, name):
                flag = name.replace("_", "-")
                raise InputError(f"--{flag}: a scene in BOP's layout has its own; leave it out")
        frames, axes = list_bop_frames(source, settings, names)
        classes = {item.class_name for frame in frames for item in frame.objects}
        models = sorted({str(item.source["obj_id"]) for each in frames for item in each.objects})
        rows = [(f"obj_{model:0>6}", model) for model in models]
        check_names(settings.names, names, rows)
        if not classes:
            raise InputError(f"{source}: no object in any image ({TRUTH})")
        record = {"extract": "extract_bop", **recorded(settings, *_OF_SCENE, "depth_folder")}
        record |= {"frame": axes, "depth": settings.depth_folder, "mask": MASKS}
    else:
        if settings.frame not in ("auto", "camera"):
            raise InputError(
                f"--frame {settings.frame}: is for scenes in BOP's layout; use --gravity"
            )
        lens = settings.intrinsics or camera_beside(source)
        if not lens:
            raise InputError(
                "--intrinsics: give fx,fy,cx,cy or a file; depth alone makes no points"
            )
        if settings.mask is None:
            raise InputError("depth: name the object by --mask FILE|DIR")
        camera = camera_of_images(source, lens, settings.depth_scale)
        frames = list_frames(source, camera, settings.mask, settings.gravity)
        images = (_rows_of(nfc(frame.id), names, settings.instances) for frame in frames)
        check_names(settings.names, names, images)
        settings = dataclasses.replace(settings, class_name=settings.class_name or "object")
        classes = {settings.class_name, *names.values()}
        record = {"extract": "extract_depth", "camera": recorded(camera)}
        record |= recorded(settings, "intrinsics", "mask", "frame", "depth_folder")
    report = run_extract(
        frames,
        partial(cut_frame, settings=settings, names=names),
        output,
        settings={**record, "names": names},
        class_names=sorted(classes),
        planned=None if settings.instances else sum(len(frame.objects) for frame in frames),
        min_points=settings.cut.min_points,
    )
    return dataclasses.replace(report, axes=axes if settings.frame == "auto" else "")


def list_frames(
    source: Path, camera: Intrinsics, mask: Path, gravity: tuple[float, float, float]
) -> list[Frame]:
    """List the depth images of a file or folder, each with the mask of the same name."""
    for path in (source, mask):
        if not path.exists():
            raise InputError(f"{path}: no such file or folder")
    paths = list_images(source) if source.is_dir() else {source.stem: source}
    if not paths:
        raise InputError(
            f"{source}: no depth image ({', '.join(DEPTH_FILES)}) and no scene of BOP's layout "
            "(scene_camera.json) in it"
        )
    if mask.is_dir():
        masks = {name: find_mask(mask, path) for name, path in paths.items()}
        owners: dict[Path, Path] = {}
        for name, path in paths.items():
            if not masks[name].is_file():
                other = next((each.name for each in sorted(mask.glob(f"{escape(name)}.*"))), "")
                fault = f"; {other} is none of {', '.join(DEPTH_FILES)}" if other else ""
                raise InputError(f"{mask}: no mask {name}.png for {path}{fault}")
            if (other := owners.setdefault(masks[name], path)) is not path:
                raise InputError(f"{other} and {path} have the same mask; give each its own")
    elif len(paths) > 1:
        raise InputError(f"{mask}: one mask for {len(paths)} depth images; name a folder")
    elif mask.resolve() in [path.resolve() for path in paths.values()]:
        raise InputError(f"{mask}: is the depth image and no mask of it")
    else:
        masks = dict.fromkeys(paths, mask)
    level = upright(gravity)
    frames = []
    for name, path in paths.items():
        item = FrameObject(utf8(name), masks[name], level, source={"image": utf8(path.name)})
        frames.append(Frame(item.id, path, camera, (item,)))
    return frames


def _rows_of(image: str, names: Iterable[str], instances: bool) -> list[str]:
    """Return the names that rows of an image may have; its instances are not known yet."""
    if not instances:
        return [image]
    return [image, *(name for name in names if name.startswith(("*/", f"{image}/")))]


def read_names(path: Path) -> dict[str, str]:
    """Read the class of each image, instance or object from a CSV with columns name and class."""
    from qs3.meshes.labels_csv import read_table  # most sources need no table

    table = read_table(path, ("name", "class"))
    with reading(path, "a CSV with the columns name,class"):
        names, kinds = (table[column] for column in ("name", "class"))
        if table.empty or "" in {*names, *kinds} or names.duplicated().any():
            raise InputError("needs a name, none twice, and a class in each of its rows")
    return dict(zip(names, kinds, strict=True))
