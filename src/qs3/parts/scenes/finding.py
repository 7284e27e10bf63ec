"""What `qs3 find` asks: the parts in one depth picture, and the clusters that no part explains."""

from dataclasses import replace
from pathlib import Path

import numpy as np
from jaxtyping import Float32, Int32
from numpy.typing import ArrayLike

from qs3.checks import array_of, check_kind
from qs3.errors import InputError, say_once
from qs3.frames.camera_files import read_intrinsics
from qs3.frames.intrinsics import Intrinsics
from qs3.objects.segment import NoPlaneError, SegmentSettings, no_plane
from qs3.parts.library import Library
from qs3.parts.scenes.answering import answer_of
from qs3.parts.scenes.found import FindSettings, FoundParts, Unexplained
from qs3.parts.scenes.picture import Picture, picture_of
from qs3.parts.scenes.searching import chosen_in

_SIDE = 0.5
"""Share of a part that is visible, at least, if its side was taken for the table."""


def find(
    library: Library,
    depth: ArrayLike,
    intrinsics: Intrinsics | str | Path,
    settings: FindSettings = FindSettings(),  # noqa: B008
    masks: ArrayLike | None = None,
    before: FoundParts | None = None,
) -> FoundParts:
    """Find the parts on a table in a depth picture: class, CAD file and pose of each.

    Args:
        library: The parts that may be there.
        depth: Metres along the optical axis, floating point, [h, w]; NaN or 0 if unknown.
        intrinsics: The camera of the picture, or what ``--intrinsics`` takes: fx,fy,cx,cy or a
            file.
        settings: See `FindSettings`.
        masks: Whole numbers of objects from a detector, 0 for none; they replace the segmentation.
        before: Answer for the last frame of a camera. Its parts are refined from their poses, and
            only what they no longer explain is searched, unless it has not changed.

    Raises:
        NoPlaneError: If the picture shows neither a table nor, searched without one, a part.
        InputError: If the picture is not in metres, has no depth, or another size than the camera
            or the masks.
    """
    check_kind("find", library, Library)
    check_kind("find", settings, FindSettings)
    if before is not None:
        check_kind("find", before, FoundParts)
    if not isinstance(intrinsics, Intrinsics):
        intrinsics = read_intrinsics(intrinsics)
    depth, masks = array_of("depth", depth), None if masks is None else array_of("masks", masks)
    if depth.ndim != 2 or depth.dtype.kind != "f":
        raise InputError(
            f"depth is {depth.dtype} of shape {list(depth.shape)}; give metres of shape [h, w] as "
            "floating-point numbers: millimetres times 0.001"
        )
    if masks is not None and (masks.ndim != 2 or masks.dtype.kind not in "biu"):
        raise InputError(
            f"masks are {masks.dtype} of shape {list(masks.shape)}; give whole numbers of shape "
            "[h, w], 0 for no object"
        )
    if masks is not None and masks.shape != depth.shape:
        raise InputError(
            f"the masks are {masks.shape[1]}×{masks.shape[0]} pixels, the depth picture "
            f"{depth.shape[1]}×{depth.shape[0]}"
        )
    numbers = None if masks is None else masks.astype(np.int32)
    depth = depth.astype(np.float32)
    return find_cut(library, depth, intrinsics, settings.cutting, settings, numbers, before)


def find_cut(
    library: Library,
    depth: Float32[np.ndarray, "rows columns"],
    intrinsics: Intrinsics,
    cutting: SegmentSettings,
    settings: FindSettings,
    masks: Int32[np.ndarray, "rows columns"] | None = None,
    before: FoundParts | None = None,
) -> FoundParts:
    """Find the parts as `find` does, in a picture that is cut by settings of one's own.

    A picture without a table is searched without one, and a warning gives the reason once. So is
    one in which nothing is found on a plane that is no larger than a part and ends within the
    picture: a side of it.
    """
    found = None
    try:
        picture = picture_of(depth, intrinsics, cutting, masks)
        found = find_in(library, picture, settings, before)
        if found.parts or _is_table(library, picture):
            return found
        side = Unexplained.of(picture.points(picture.cluster == -1))
        if before is not None and before.side is not None and before.side.is_still(side):
            return replace(found, side=before.side)  # it was searched then
        found = replace(found, side=side)
        fault = no_plane("its plane is no larger than a part", cutting)
    except NoPlaneError as error:
        fault = error
    picture = picture_of(depth, intrinsics, cutting, masks, table=False)
    bare = find_in(library, picture, settings, before)
    # A part that is much larger than the picture would take the table for its side.
    if bare.parts and (found is None or bare.parts[0].visible >= _SIDE):
        more = f"no table: {fault.fault}, so it is searched without one"
        say_once(str(no_plane(more, cutting)), "no table")
        return bare
    if found is None:
        raise no_plane(f"{fault.fault}, and no part is found without a table", cutting) from fault
    return found


def _is_table(library: Library, picture: Picture) -> bool:
    """Return whether the table is larger than each part, or goes on beyond the picture."""
    table = picture.cluster == -1
    size = np.ptp(picture.points(table), axis=0).max()
    rim = np.concatenate([table[0], table[-1], table[:, 0], table[:, -1]])
    return bool(size > max((part.diameter for part in library), default=0.0) or rim.mean() > 0.5)


def find_in(
    library: Library,
    picture: Picture,
    settings: FindSettings,
    before: FoundParts | None = None,
) -> FoundParts:
    """Find the parts in a picture that is cut already, as `find` does."""
    chosen = chosen_in(library, picture, settings, before)
    return answer_of(chosen, picture, settings, () if before is None else before.parts)
