"""Pictures of frames: depth with the outline, class and score of each part that was found."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float32
from matplotlib.figure import Figure

from qs3.errors import InputError
from qs3.files import refuse_taken, write_bytes
from qs3.frames.intrinsics import Intrinsics
from qs3.geometry import transform_points
from qs3.objects.cut import pixels_of
from qs3.parts.library import Library
from qs3.parts.scenes.found import FoundParts
from qs3.parts.scenes.frames import FramePath, read_frame
from qs3.parts.scenes.picture import rectified
from qs3.report.figure import class_colour, house_style, png_bytes, short, without_frame


def check_pictures(folder: Path, frames: Sequence[FramePath]) -> None:
    """Refuse a folder that holds something or takes nothing, and two pictures of one name."""
    refuse_taken(folder)
    names = [_name(frame) for frame in frames]
    if twice := {name for name in names if names.count(name) > 1}:
        raise InputError(
            f"--pictures: two frames would write {min(twice)}; name one folder at once"
        )


def write_picture(folder: Path, frame: FramePath, found: FoundParts, library: Library) -> None:
    """Write the picture of a frame into a folder, by the frame's name."""
    figure = parts_figure(*rectified(*read_frame(frame)), found, library)
    write_bytes(folder / _name(frame), png_bytes(figure, dpi=110))


def _name(frame: FramePath) -> str:
    return f"{frame.name.replace('/', '_')}.png"


@house_style
def parts_figure(
    depth: Float32[np.ndarray, "h w"], camera: Intrinsics, found: FoundParts, library: Library
) -> Figure:
    """Draw the outlines of parts over depth; crosses mark what is unexplained."""
    height, width = depth.shape
    figure = Figure(figsize=(8, 8 * height / width), layout="constrained")
    axes = figure.subplots()
    low, high = np.nanquantile(depth, (0.01, 0.99)) if np.isfinite(depth).any() else (0, 1)
    axes.set_facecolor("#cfe2f3")  # no depth
    axes.imshow(depth, cmap="gray_r", vmin=low, vmax=high, interpolation="nearest")
    parts = {part.cad: part for part in library}
    names = list(library.class_names)
    for found_part in found.parts:
        part = parts[found_part.cad]
        points = transform_points(found_part.pose, part.points.astype(np.float64))
        mask = _filled(points, camera, (height, width))
        colour = class_colour(names.index(found_part.class_name))
        axes.contour(mask, [0.5], colors=[colour], linewidths=1.2)
        place = camera.matrix @ (found_part.pose[:3, :3] @ part.middle + found_part.pose[:3, 3])
        box = {"facecolor": "white", "alpha": 0.7, "linewidth": 0, "pad": 1}
        label = f"{short(found_part.class_name)} {found_part.score:.2f}"
        x, y = (place[:2] / place[2]).tolist()
        axes.text(x, y, label, fontsize=7, ha="center", bbox=box)
    for rest in found.unexplained:
        place = camera.matrix @ np.array(rest.centre)
        axes.plot(*place[:2] / place[2], "x", color="#cc3311")
    axes.set_xlim(-0.5, width - 0.5)
    axes.set_ylim(height - 0.5, -0.5)
    without_frame(axes)
    return figure


def _filled(
    points: np.ndarray, camera: Intrinsics, shape: tuple[int, int]
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of the silhouette of many points."""
    import cv2

    mask = np.zeros(shape, np.uint8)
    pixels = pixels_of(points, camera)
    u, v = np.rint(pixels).astype(int).T
    kept = (u >= 0) & (v >= 0) & (u < shape[1]) & (v < shape[0])
    mask[v[kept], u[kept]] = 1
    return cv2.morphologyEx(mask, cv2.MORPH_CLOSE, np.ones((7, 7), np.uint8)) > 0
