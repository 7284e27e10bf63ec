"""What ``qs3 extract`` does with its options: list what is there, run, tell."""

import dataclasses
import functools
import math
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

from qs3.cli.extract import CutOptions, DepthOptions, OutOptions, ScanNetOptions, SunOptions
from qs3.errors import InputError
from qs3.io.extract.clouds import ExtractedCloud, Unit
from qs3.io.extract.depth import CutSettings
from qs3.io.extract.run import run_extract
from qs3.meshes.classes import POINTDA10


def depth(options: DepthOptions) -> int:
    """Cut objects from depth images or scenes in BOP's layout."""
    from qs3.io.extract import bop, plain
    from qs3.io.extract.intrinsics import read_intrinsics

    names = plain.read_names(options.names) if options.names else {}
    common: dict[str, Any] = {
        "gravity": options.gravity,
        "names": names,
        "split": options.split,
        "cut": _cut(options.cut),
    }
    if bop.is_bop(options.source):
        for flag in ("intrinsics", "mask", "box", "depth_scale", "instances"):
            if getattr(options, flag):
                word = flag.replace("_", "-")
                raise InputError(f"--{word}: a scene in BOP's layout tells it; leave it out")
        frames = bop.list_bop_frames(options.source)
        chosen = options.frame
        if chosen == "auto":
            chosen = "world" if bop.has_world(frames) else "camera"
            print(f"clouds in the axes of the {chosen}", file=sys.stderr)
        settings = bop.BopSettings(
            frame=chosen, depth=options.depth_folder, class_name=options.class_name, **common
        )
        classes = {settings.class_of(item.obj_id) for frame in frames for item in frame.objects}
        count = sum(len(frame.objects) for frame in frames)
        if not count:
            raise InputError(f"{options.source}: no object in any image (scene_gt.json)")
        return _run(frames, bop.extract_bop, settings, sorted(classes), options.output, count)
    if options.frame not in ("auto", "camera"):
        raise InputError(f"--frame {options.frame}: is for scenes in BOP's layout; use --gravity")
    if not options.intrinsics:
        raise InputError("--intrinsics: give fx,fy,cx,cy or a file; depth alone makes no points")
    if options.mask is None and options.box is None:
        raise InputError("depth: name the object by --mask FILE|DIR or --box u0 v0 u1 v1")
    if options.instances and options.mask is None:
        raise InputError("--instances: needs --mask, whose numbers it means")
    images = plain.list_depth_images(options.source, options.mask)
    settings = plain.DepthSettings(
        camera=read_intrinsics(options.intrinsics),
        box=options.box,
        instances=options.instances,
        depth_scale=options.depth_scale,
        class_name=options.class_name or "object",
        **common,
    )
    classes = sorted({settings.class_name, *names.values()})
    count = None if options.instances else len(images)
    return _run(images, plain.extract_depth, settings, classes, options.output, count)


def sunrgbd(options: SunOptions) -> int:
    """Cut objects from SUN RGB-D."""
    from qs3.io.extract.sunrgbd import SunSettings, extract_sunrgbd
    from qs3.io.extract.sunrgbd_boxes import list_sunrgbd, rename_to

    wanted = _classes(options.classes)
    settings = SunSettings(margin=options.margin, cut=_cut(options.cut))
    frames = list_sunrgbd(
        options.root, options.boxes, options.splits, options.depth, rename_to(wanted)
    )
    classes = wanted or sorted({box.class_name for frame in frames for box in frame.boxes})
    count = sum(len(frame.boxes) for frame in frames)
    more = {"depth": options.depth}
    return _run(frames, extract_sunrgbd, settings, classes, options.output, count, more)


def scannet(options: ScanNetOptions) -> int:
    """Cut objects from ScanNet."""
    from qs3.io.extract.scannet import (
        extract_scene,
        list_scenes,
        read_splits,
    )
    from qs3.io.extract.scannet_mesh import extract_mesh_scene
    from qs3.io.extract.scannet_settings import ScanNetSettings

    classes = _classes(options.classes)
    if classes is None:
        raise InputError("--classes all: ScanNet's labels are free words; name the classes")
    settings = ScanNetSettings(
        class_names=tuple(classes),
        every=options.every,
        near=options.near,
        far=options.far,
        cut=options.cut,
        erode=options.erode,
        max_frames=options.max_frames,
        min_pixels=options.min_pixels,
        voxel=options.voxel,
        min_points=options.min_points,
        seed=options.seed,
        mesh_points=options.output.num_points,
    )
    splits = read_splits(options.splits_train, options.splits_test) or None
    scenes = list_scenes(options.root, options.scenes or None, splits)
    make = extract_mesh_scene if options.from_mesh else extract_scene
    more = {"from_mesh": options.from_mesh}
    return _run(scenes, make, settings, classes, options.output, None, more)


def _cut(options: CutOptions) -> CutSettings:
    return CutSettings(**{field.name: getattr(options, field.name)
                          for field in dataclasses.fields(CutSettings)})  # fmt: skip


def _classes(given: tuple[str, ...]) -> tuple[str, ...] | None:
    """The classes to map onto; None keeps the source's own."""
    if given in (("all",), ()):
        return None
    if given == ("pointda10",):
        return POINTDA10
    if len(set(given)) < len(given):
        raise InputError(f"--classes {' '.join(given)}: a class comes twice")
    return given


def _run(
    units: Sequence[Unit],
    extract_one: Callable[..., Iterable[ExtractedCloud]],
    settings: Any,
    classes: Sequence[str],
    options: OutOptions,
    planned: int | None,
    more: Mapping[str, Any] | None = None,
) -> int:
    """Extract, tell what was done and what comes next; failures are an error."""
    from qs3.io.layouts.contents import info
    from qs3.store.failures import FAILURES, read_failures

    if options.num_points < 1:
        raise InputError(f"--num-points {options.num_points}: must be at least 1")
    if options.workers < 0:
        raise InputError(f"--workers {options.workers}: must be 0 or more")
    report = run_extract(
        units,
        functools.partial(extract_one, settings=settings),
        options.out,
        settings={"extract": extract_one.__name__, **_plain(settings), **(more or {})},
        class_names=classes,
        num_points=options.num_points,
        workers=options.workers,
        retry_failed=options.retry_failed,
    )
    there = info(options.out)["rows"]
    print(options.out)
    failures = read_failures(options.out)
    left = ""
    if planned is not None and not failures:
        left = f" of {planned}, {planned - there} had fewer than {_least(settings)} points"
    print(
        f"{there} objects{left}; {report.units} frames or scenes done, {report.skipped} were there "
        f"before, {len(failures)} failed. Next: qs3 train --method qbst --source DATA --target "
        f"{options.out} --out RUN",
        file=sys.stderr,
    )
    if failures:
        first = failures[0]
        raise InputError(
            f"{options.out}/{FAILURES}: {len(failures)} failed; the first: {first['id']}: "
            f"{first['reason']}; all others are there, --retry-failed does these again"
        )
    return 0


def _least(settings: Any) -> int:
    return settings.cut.min_points


def _plain(settings: Any) -> Any:
    """Settings as JSON has them; infinity, which it has not, becomes null."""
    if dataclasses.is_dataclass(settings):
        return {f.name: _plain(getattr(settings, f.name)) for f in dataclasses.fields(settings)}
    if isinstance(settings, Mapping):
        return {str(key): _plain(value) for key, value in settings.items()}
    if isinstance(settings, tuple | list):
        return [_plain(value) for value in settings]
    return None if isinstance(settings, float) and math.isinf(settings) else settings
