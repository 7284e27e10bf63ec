"""Which pixels of a mask are objects: numbers, palettes, colours, cut-outs and soft edges."""

import numpy as np
from jaxtyping import Bool, Int32, Shaped

from qs3.errors import InputError, say_once
from qs3.frames.png_and_tiff import Palette

_SCALES = (255, 65535)  # white
_VOID, _CREAM = 255, (224, 224, 192)  # Pascal VOC's number and colour of borders
_MANY = 8  # levels of a picture whose brightest is not white
_SOLID = 0.4  # of the bright pixels of a mask with soft edges are nearly white
_SPECK = 50  # pixels of an area of one level


def object_numbers(
    picture: Shaped[np.ndarray, "h w *c"] | Palette, instances: bool = False
) -> Int32[np.ndarray, "h w"]:
    """Return the number of the object at each pixel; 0 is background.

    Numbers are objects as they are, and so are the indices of a palette, whose background is its
    black or transparent entry; an object at index 0 takes the background's index. Of colours black
    is background, and the number is R + 256·G + 65536·B, as COCO's panoptic masks have it. Of a
    cut-out the opaque pixels are the object. 255 or 65535 beside 0, 1, 2 … of a palette, or with
    ``instances``, is background, with a warning: Pascal VOC marks borders so; 255 of its palette is
    beside any number. Soft edges are cut at half; then the object is 1.

    Raises:
        InputError: If the background cannot be known; or with ``instances``, if edges are soft.
    """
    if isinstance(picture, Palette):
        is_voc = len(picture.colours) > _VOID and (*picture.colours[_VOID, :3],) == _CREAM
        return _without_void(_of_palette(picture, instances), is_voc)
    if picture.ndim == 3:
        return _of_colours(picture, instances)
    return _of_numbers(picture, instances)


def _without_void(
    numbers: Int32[np.ndarray, "h w"], is_voc: bool = False
) -> Int32[np.ndarray, "h w"]:
    """Return a mask without the borders that Pascal VOC marks with 255, and others with 65535."""
    *values, void = np.unique(numbers).tolist()
    is_border = void in _SCALES and (is_voc or values == [*range(len(values))])
    if len(values) < 2 or not is_border:
        return numbers
    say_once(f"a mask: {void} beside {_listed(np.array(values))} is taken for no object")
    return np.where(numbers == void, 0, numbers)


def _of_numbers(numbers: Shaped[np.ndarray, "h w"], instances: bool) -> Int32[np.ndarray, "h w"]:
    if numbers.dtype.kind not in "iub":
        raise InputError("holds no whole numbers; a mask needs them")
    if numbers.dtype.kind == "b":
        numbers = numbers.astype(np.uint8)
    values = np.unique(numbers)
    if values[0] < -(2**31) or values[-1] >= 2**31:
        raise InputError("holds a number beyond 32 bits")
    if (values < 0).any():
        if values[0] < -1 or 0 in values:
            raise InputError(f"holds {values[0]}: is it background? Write 0 there")
        numbers = np.where(numbers < 0, 0, numbers)
    elif 0 not in values and len(values) > 1:
        if not instances:
            raise InputError(
                f"no pixel is 0, the background: it has {_listed(values)}; write 0 there"
            )
        say_once(f"a mask without a 0, the background: {_listed(values)} are objects each")
    corners = numbers[[0, 0, -1, -1], [0, -1, 0, -1]]
    if 0 in values and values[-1] and (corners == values[-1]).all():
        fault = f"{values[-1]} lies in all of its corners; if that is the background, write 0 there"
        if instances and values[-1] in _SCALES:
            raise InputError(fault)
        say_once(f"a mask: {fault}")
    if _is_soft(numbers):
        return _cut_soft(numbers, instances)
    if instances and _is_soft(numbers, least=2):
        say_once(
            "a mask: most of its numbers lie at edges only; if it was scaled, scale it by the "
            "nearest pixel"
        )
    numbers = numbers.astype(np.int32)
    return _without_void(numbers) if instances else numbers


def _of_colours(picture: Shaped[np.ndarray, "h w c"], instances: bool) -> Int32[np.ndarray, "h w"]:
    colours = picture[..., :3]
    if picture.shape[2] == 4:
        alpha = picture[..., 3]
        top = alpha.max()
        if not top:
            raise InputError("is transparent everywhere; a mask needs an object")
        if not alpha.min():
            opaque = 2 * alpha.astype(np.int64) >= top
            if not instances or not colours[opaque].any():
                return opaque.astype(np.int32)
            colours = np.where(opaque[..., None], colours, 0)
    if (colours == colours[..., :1]).all():
        return _of_numbers(colours[..., 0], instances)
    if colours.dtype != np.uint8:
        raise InputError(
            "a colour picture of 16 bits per channel; save the mask with 8, or as grey"
        )
    codes = colours.astype(np.int32) @ np.array([65536, 256, 1], dtype=np.int32)  # blue is first
    if _is_soft(codes, least=4):
        return _cut_soft(colours.max(axis=2), instances)
    if codes.all() and np.ptp(codes):
        raise InputError("no pixel is black or transparent, so its background is unknown")
    return codes


def _of_palette(picture: Palette, instances: bool) -> Int32[np.ndarray, "h w"]:
    indices = picture.indices
    used = np.unique(indices)
    if used[-1] >= len(picture.colours):
        raise InputError(f"index {used[-1]} is not in its palette of {len(picture.colours)}")
    colours = picture.colours[used]
    clear = colours[:, 3] < 128
    if clear.all():
        raise InputError("is transparent everywhere; a mask needs an object")
    brightness = picture.colours[:, :3].max(axis=1)[indices]
    if _is_soft(brightness) or _is_soft(indices, least=4):
        return _cut_soft(brightness, instances)
    if len(np.unique(colours[:, :3], axis=0)) == 1 and not clear.any():
        return indices.astype(np.int32)  # its colours say nothing, its numbers do
    background = used[clear] if clear.any() else used[~colours[:, :3].any(axis=1)]
    if len(background) != 1 and not clear.any():
        which = f"{_listed(background)} of its palette are both" if len(background) else "none is"
        raise InputError(
            f"its background is unknown: of the indices {_listed(used)}, {which} black; save it as "
            "a grey picture with 0 as background"
        )
    numbers = np.where(np.isin(indices, background), 0, indices)
    if 0 not in background:
        numbers[indices == 0] = background[0]
    return numbers.astype(np.int32)


def _is_soft(picture: Shaped[np.ndarray, "h w"], least: int = 1) -> bool:
    """Return whether most levels between 0 and the brightest lie at edges only, never in areas."""
    values, top = np.unique(picture), picture.max()
    between = values[(values > 0) & (values < top)]
    if len(between) < (least if top in _SCALES or least > 1 else _MANY):
        return False
    areas = np.unique(picture[_flat(picture)])
    return bool(2 * np.isin(between, areas).sum() < len(between))


def _cut_soft(picture: Shaped[np.ndarray, "h w"], instances: bool) -> Int32[np.ndarray, "h w"]:
    """Cut soft edges at half of the brightest; refuse a photograph, and areas of other levels."""
    if instances:
        raise InputError(
            "has soft edges, so its numbers are no instances; save it without anti-aliasing"
        )
    level = picture.astype(np.float64) / picture.max()
    middle = (level > 0.1) & (level < 0.9)
    _, sizes = np.unique(picture[middle & _flat(picture)], return_counts=True)
    if (level >= 0.9).sum() < _SOLID * (level > 0.1).sum() or sizes.max(initial=0) >= _SPECK:
        raise InputError(
            "has many levels of grey, as a photograph does; a mask has one number per object, and "
            "0 elsewhere"
        )
    return (level >= 0.5).astype(np.int32)


def _flat(picture: Shaped[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Return which pixels equal their four neighbours."""
    wide = np.pad(picture, 1, mode="edge")
    around = (wide[:-2, 1:-1], wide[2:, 1:-1], wide[1:-1, :-2], wide[1:-1, 2:])
    return np.logical_and.reduce([picture == other for other in around])


def _listed(values: np.ndarray) -> str:
    few = ", ".join(map(str, values[:5].tolist()))
    return few if len(values) <= 5 else f"{few} and {len(values) - 5} more"
