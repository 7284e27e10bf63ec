"""DepthScanNet-like clouds: objects of ScanNet fused from raw depth frames.

QS3 tests on objects "taken directly from" ScanNet's depth frames, which keep the sensor's noise;
how many frames it fused and how it cut objects out is unpublished. Steps:

1. Every ``every``-th frame with a pose is read; depth beyond ``near`` and ``far`` is left out.
2. A point belongs to the object whose instance mask (shrunk by ``erode``) it falls on, through the
   calibration of both cameras. Without masks it belongs to the object of its nearest mesh vertex,
   if that is within ``distance``.
3. Of the frames that see ``min_pixels`` of an object, ``max_frames`` drawn at random are fused by
   their poses: a few frames and the drift between them, as a robot would gather, and not the haze
   of hundreds.
4. Each voxel keeps one measured point at random: even density, unaveraged noise (`ObjectFusion`).

Convention:
    Metres, z up: the scene's axisAlignment if it has one, else the scene's own frame. The box's
    middle is at x = y = 0 and its lowest point at z = 0; ``source["origin"]`` leads back.

Source: Chen et al., "Quasi-Balanced Self-Training on Noise-Aware Synthesis of Object Point Clouds",
ECCV 2022; Dai et al., "ScanNet", CVPR 2017.
"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple
from zipfile import ZipFile

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from qs3.errors import InputError
from qs3.io.extract.depth_images import decode_image
from qs3.io.extract.fuse import ObjectFusion
from qs3.io.extract.plane import find_floor
from qs3.io.extract.run import ExtractedCloud
from qs3.io.extract.scannet_scene import (
    NO_OBJECT,
    ScanNetScene,
    SceneObject,
    axis_alignment,
    object_seed,
    read_objects,
    read_scene_mesh,
    rest,
)
from qs3.io.extract.scannet_settings import ScanNetSettings
from qs3.io.extract.sens import SensHeader, read_depth_frames, read_sens_header
from qs3.reading import naming, reading

_THINNED = 97  # of so many pixels one tells where the floor is
_MASKS = "_2d-instance-filt.zip"


class Seen(NamedTuple):
    """Points that the depth camera measured in one frame."""

    frame: int
    """Its number."""
    points: Float[np.ndarray, "n 3"]
    """In the depth camera, metres."""
    pixels: Int[np.ndarray, "n"]
    """Their pixels."""
    pose: Float[np.ndarray, "4 4"]
    """Camera to world."""


Owners = Callable[[Seen], Int[np.ndarray, "n"] | None]
"""Gives each point of a frame its object; −1 is no object, None that the frame has no mask."""


def cut_scene(scene: ScanNetScene, settings: ScanNetSettings) -> Iterator[ExtractedCloud]:
    """Yield the objects of one scene, fused from its raw depth frames.

    One frame is in memory at a time, and of each object no more than ``max_frames`` ×
    ``max_points`` points, however long the scene; only the index of the masks' zip file grows, by
    less than 1 kB a frame. Nothing is yielded before the last frame is read.
    """
    objects = read_objects(scene, settings.class_names)
    align = axis_alignment(scene)
    sens = scene.file(".sens")
    header = read_sens_header(sens)
    fusions = {
        item.objectId: ObjectFusion(
            settings.voxel,
            settings.max_points,
            settings.max_frames,
            object_seed(settings.seed, scene, item.objectId),
        )
        for item, _ in objects
    }
    if not objects:
        return
    rays = _rays(header)
    unmasked, masked = 0, 0
    scattered = []
    steps = [value * header.depth_shift for value in (settings.near, settings.far)]
    with ExitStack() as stack:
        owners = _owners(scene, settings, header, objects, stack)
        for frame in read_depth_frames(sens, settings.every):
            if frame.camera_to_world is None:
                continue
            flat = frame.steps.reshape(-1)
            pixels = np.flatnonzero((flat >= max(steps[0], 1)) & (flat <= steps[1]))
            points = rays[pixels] * (flat[pixels] / header.depth_shift)[:, None]
            owner = owners(Seen(frame.index, points, pixels, frame.camera_to_world))
            if owner is None:
                unmasked += 1
                continue
            masked += 1
            to_scene = align @ frame.camera_to_world
            scattered.append(_moved(to_scene, points[::_THINNED]))
            for number, fusion in fusions.items():
                own = np.flatnonzero(owner == number)
                if len(own) >= settings.min_pixels:
                    placed = _moved(to_scene, points[own]).astype(np.float32)
                    fusion.add(frame.index, placed, pixels[own])
    if unmasked and not masked:
        raise InputError(f"{scene.file(_MASKS)}: has no mask of any frame read; it is incomplete")
    floor = find_floor(np.concatenate(scattered)) if scattered else np.nan
    for item, class_name in objects:
        fusion = fusions.pop(item.objectId)
        cloud = fusion.points()
        if len(cloud) < settings.min_points:
            continue
        points, origin = rest(cloud)
        source = {
            "label": item.label,
            "frames": fusion.frames,
            "frames_seen": fusion.offered,
            "measured": fusion.measured,
            "origin": origin,
        }
        identifier = f"{scene.id}/{item.objectId}"
        yield ExtractedCloud(identifier, class_name, points, scene.split, source,
                             floor - origin[2])  # fmt: skip


def _rays(header: SensHeader) -> Float[np.ndarray, "n 3"]:
    """Point at depth 1 of each pixel of the depth camera, row by row."""
    width, height = header.depth_size
    v, u = np.mgrid[:height, :width].reshape(2, -1)
    pixels = np.stack([u, v, np.ones(len(u))], axis=1)
    return pixels @ np.linalg.inv(header.depth_intrinsic).T


def _moved(
    matrix: Float[np.ndarray, "4 4"], points: Float[np.ndarray, "n 3"]
) -> Float[np.ndarray, "n 3"]:
    """Matrix times points, written out: no thread is started, and every machine rounds alike."""
    x, y, z = points.T
    return np.stack([x * a + y * b + z * c + d for a, b, c, d in matrix[:3]], axis=1)


def _owners(
    scene: ScanNetScene,
    settings: ScanNetSettings,
    header: SensHeader,
    objects: Sequence[tuple[SceneObject, str]],
    stack: ExitStack,
) -> Owners:
    masks = scene.file(_MASKS)
    if settings.cut == "masks" or (settings.cut == "auto" and masks.is_file()):
        with reading(masks, streamed=True):
            archive = stack.enter_context(ZipFile(masks))
        return _by_masks(archive, header, settings.erode)
    if settings.cut == "auto" and not scene.file("_vh_clean_2.ply").is_file():
        raise InputError(
            f"{scene.folder}: has neither {masks.name} nor {scene.id}_vh_clean_2.ply with its "
            "segments to cut objects out by; download one of them"
        )
    return _by_mesh(scene, objects, settings.distance)


def _by_masks(archive: ZipFile, header: SensHeader, radius: int) -> Owners:
    """Objects by the mask's pixel that each point falls on."""
    # A pixel at depth z falls on the homogeneous pixel z · through + shift of the colour image.
    to_color = header.color_intrinsic @ header.depth_to_color[:3]
    through = _rays(header) @ to_color[:, :3].T
    shift = to_color[:, 3]
    # Cameras apart: what the depth camera sees beside an object may lie behind it for the other.
    apart = np.linalg.norm(header.depth_to_color[:3, 3]) > 1e-3

    def owners(seen: Seen) -> Int[np.ndarray, "n"] | None:
        mask = read_mask(archive, seen.frame, (header.color_size, header.depth_size))
        if mask is None:
            return None
        height, width = mask.shape
        mask = erode(mask, round(radius * width / header.depth_size[0]))
        if (width, height) != header.color_size:
            return mask.reshape(-1)[seen.pixels].astype(np.int64) - 1
        moved = through[seen.pixels] * seen.points[:, 2:] + shift
        depth = np.maximum(moved[:, 2], 1e-6)
        u, v = np.rint(moved[:, 0] / depth), np.rint(moved[:, 1] / depth)
        inside = (moved[:, 2] > 0) & (u >= 0) & (u < width) & (v >= 0) & (v < height)
        owner = np.full(len(seen.pixels), NO_OBJECT, dtype=np.int64)
        rows, columns = v[inside].astype(np.int64), u[inside].astype(np.int64)
        objects = mask[rows, columns].astype(np.int64) - 1
        if apart:
            cell = -(-width // header.depth_size[0])
            objects[_hidden(rows, columns, depth[inside], cell)] = NO_OBJECT
        owner[inside] = objects
        return owner

    return owners


def read_mask(
    archive: ZipFile, frame: int, sizes: Sequence[tuple[int, int]]
) -> UInt8[np.ndarray, "h w"] | None:
    """Return the mask of a frame, of one of some sizes (w, h); None if there is none.

    ``<scene>_2d-instance-filt.zip`` holds ``instance-filt/<frame>.png``, 8 bits, the ``objectId`` +
    1 of each pixel, 0 if it has no object: the annotated mesh as the colour camera sees it from the
    frame's pose, filtered, at the colour image's size (1296×968).
    """
    name = f"instance-filt/{frame}.png"
    if name not in archive.NameToInfo:
        return None
    with reading(Path(str(archive.filename)), "a mask", streamed=True), naming(name):
        entry = archive.getinfo(name)
        if entry.file_size > 2 * max(width * height for width, height in sizes) + 2**16:
            raise InputError(f"would unpack to {entry.file_size} bytes")
        mask = decode_image(archive.read(entry))
        if mask.shape[::-1] not in sizes or mask.dtype != np.uint8:
            expected = " or ".join(f"{w}×{h}" for w, h in dict.fromkeys(sizes))
            raise InputError(f"{mask.dtype} of shape {mask.shape}; expected 8 bits, {expected}")
    return mask


def erode(mask: UInt8[np.ndarray, "h w"], radius: int) -> UInt8[np.ndarray, "h w"]:
    """Clear every pixel that has another value within ``radius`` pixels, corners included.

    The image's own border takes nothing away: what goes on beyond it is not known to differ.

    Example:
        >>> erode(np.array([[1, 1, 2, 2]], dtype=np.uint8), 1).tolist()
        [[1, 0, 0, 2]]
    """
    # Imported here: scenes cut by their mesh do without.
    import cv2

    if radius == 0:
        return mask
    window = np.ones((2 * radius + 1, 2 * radius + 1), dtype=np.uint8)
    same = cv2.erode(mask, window) == cv2.dilate(mask, window)
    return np.where(same, mask, 0).astype(np.uint8)


def _hidden(
    rows: Int[np.ndarray, "n"],
    columns: Int[np.ndarray, "n"],
    depth: Float[np.ndarray, "n"],
    cell: int,
) -> Bool[np.ndarray, "n"]:
    """Whether points lie a twentieth of their depth behind others in the same cell of pixels."""
    # Imported here: scenes cut by their mesh do without.
    import cv2

    down, across = rows // cell, columns // cell
    front = np.full((down.max(initial=0) + 1, across.max(initial=0) + 1), np.inf)
    np.minimum.at(front, (down, across), depth)
    front = cv2.erode(front, np.ones((3, 3), np.uint8))
    return depth > 1.05 * front[down, across]


def _by_mesh(
    scene: ScanNetScene, objects: Sequence[tuple[SceneObject, str]], distance: float
) -> Owners:
    """Objects by the nearest vertex of the annotated mesh, other objects' and the floor's too."""
    # Imported here: scenes cut by masks need no k-d tree.
    from scipy.spatial import KDTree

    vertices, owner_of = read_scene_mesh(scene, objects)
    tree = KDTree(vertices)
    wanted = vertices[owner_of != NO_OBJECT]
    low = wanted.min(axis=0, initial=np.inf) - distance
    high = wanted.max(axis=0, initial=-np.inf) + distance

    def owners(seen: Seen) -> Int[np.ndarray, "n"] | None:
        world = _moved(seen.pose, seen.points)
        owner = np.full(len(seen.pixels), NO_OBJECT, dtype=np.int64)
        near = np.flatnonzero(((world >= low) & (world <= high)).all(axis=1))
        reach, vertex = map(np.asarray, tree.query(world[near], distance_upper_bound=distance))
        reached = np.isfinite(reach)
        owner[near[reached]] = owner_of[vertex[reached]]
        return owner

    return owners
