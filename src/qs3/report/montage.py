"""One scan on one sheet: pattern, pair, disparity, depth, truth, error, and the cloud.

Convention:
    Images are in pixel coordinates, y down, pixel (0, 0) at the top left; NaN is drawn grey. The
    error is depth − true depth: red is too far, blue is too near.
"""

from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from jaxtyping import Float, Shaped
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from qs3.report.clouds import SIDES, draw_cloud
from qs3.report.figure import NO_VALUE, house_style, short, without_frame
from qs3.sensor.view import ViewImages

_MARGIN = 20
"""Pixels shown around the object."""
_LOST, _EXTRA = "#6e6e6e", "#ddaa33"


@house_style
def montage(
    images: ViewImages,
    clouds: Mapping[str, Float[np.ndarray, "_ 3"]],
    pattern: Shaped[np.ndarray, "ph pw"],
    unit: str,
    title: str = "",
) -> Figure:
    """Draw one scan: four pictures, four of its depth, and two clouds from three sides each.

    Args:
        images: The pictures of one view.
        clouds: The clouds of the whole scan, by title, z up.
        pattern: The projector's pattern, 0 to 1.
        unit: Unit of lengths.
        title: Title of the sheet.
    """
    figure = Figure(figsize=(12.0, 12.0), layout="constrained")
    upper, lower = figure.subfigures(2, 1, squeeze=False)[:, 0]
    if title:
        figure.suptitle(short(title, 90), fontsize=13)
    _draw_stages(list(upper.subplots(2, 4).flat), images, pattern, unit)
    whole = np.concatenate(list(clouds.values()))
    limits = (whole.min(axis=0), whole.max(axis=0)) if len(whole) else None  # all to one scale
    for (name, points), row in zip(clouds.items(), lower.subplots(2, 3), strict=True):
        for axes, (side, angles) in zip(row, SIDES.items(), strict=True):
            axes.set_title(f"{name} ({len(points)} points), {side}", fontsize=9.0)
            draw_cloud(axes, points, *angles, limits=limits)
    return figure


def _draw_stages(
    cells: Sequence[Axes], images: ViewImages, pattern: Shaped[np.ndarray, "ph pw"], unit: str
) -> None:
    """Draw the part of the pictures that shows the object, with a margin; all if none does."""
    true = np.where(images.mask, images.true_depth, np.nan)  # of the object alone
    y, x = np.isfinite(true).nonzero()
    shown = [slice(max(i.min() - _MARGIN, 0), i.max() + 1 + _MARGIN) for i in (y, x) if len(i)]
    part = tuple(shown) or (slice(None), slice(None))
    (y0, y1, _), (x0, x1, _) = (
        region.indices(size) for region, size in zip(part, true.shape, strict=True)
    )
    extent = (x0 - 0.5, x1 - 0.5, y1 - 0.5, y0 - 0.5)
    depth, true, disparity = images.depth[part], true[part], images.disparity[part]
    error = (depth - true).astype(np.float64)
    _pattern(cells[0], pattern)
    _picture(cells[1], images.left[part], "left image", extent)
    _picture(cells[2], images.right[part], "right image", extent)
    _field(cells[3], disparity, "disparity [px]", extent, _limits(disparity, 2.0))
    shared = _limits(true if np.isfinite(true).any() else depth, 0.0)
    _field(cells[4], depth, f"depth [{unit}]", extent, shared, "viridis_r")
    _field(cells[5], true, f"true depth [{unit}]", extent, shared, "viridis_r")
    _error(cells[6], error, depth, true, extent, unit)
    _histogram(cells[7], error, true, unit)
    cells[7].set_box_aspect(error.shape[0] / error.shape[1])


def _pattern(axes: Axes, pattern: Shaped[np.ndarray, "ph pw"]) -> None:
    # A whole pattern shrunk to a thumb shows moiré, not dots: show the middle, dot by dot.
    height, width = pattern.shape
    edge = min(height, width, 256)
    top, left = (height - edge) // 2, (width - edge) // 2
    middle = pattern[top : top + edge, left : left + edge]
    axes.imshow(middle, cmap="gray", vmin=0, vmax=1, interpolation="nearest")
    axes.set_title("pattern" if edge == max(height, width) else f"pattern (its middle {edge} px)")
    without_frame(axes)


def _picture(axes: Axes, image: np.ndarray, title: str, extent: tuple) -> None:
    axes.imshow(image, cmap="gray", vmin=0, vmax=255, extent=extent, interpolation="antialiased")
    axes.set_title(title)
    _pixel_ticks(axes)


def _field(
    axes: Axes,
    values: Float[np.ndarray, "h w"],
    title: str,
    extent: tuple,
    limits: tuple[float, float],
    colours: str = "viridis",
    no_value: str = NO_VALUE,
) -> None:
    cmap = matplotlib.colormaps[colours].with_extremes(bad=no_value)
    style = {"vmin": limits[0], "vmax": limits[1], "interpolation": "nearest"}
    shown = axes.imshow(np.ma.masked_invalid(values), cmap=cmap, extent=extent, **style)
    axes.set_title(title)
    _pixel_ticks(axes)
    finite = values[np.isfinite(values)]
    below, above = bool((finite < limits[0]).any()), bool((finite > limits[1]).any())
    extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above]
    place = axes.inset_axes((1.03, 0.0, 0.05, 1.0))
    bar = axes.figure.colorbar(shown, cax=place, extend=extend)
    bar.ax.tick_params(labelsize=8)
    bar.locator = MaxNLocator(5)
    bar.update_ticks()


def _error(
    axes: Axes,
    error: Float[np.ndarray, "h w"],
    depth: Float[np.ndarray, "h w"],
    true: Float[np.ndarray, "h w"],
    extent: tuple,
    unit: str,
) -> None:
    """Signed error over a map of the pixels where it does not exist, by the reason."""
    errors = error[np.isfinite(error)]
    high = max(float(np.quantile(np.abs(errors), 0.95)), 1e-9) if len(errors) else 1.0
    reason = np.zeros(error.shape)
    reason[np.isfinite(true) & ~np.isfinite(depth)] = 1
    reason[np.isfinite(depth) & ~np.isfinite(true)] = 2
    back = ListedColormap([NO_VALUE, _LOST, _EXTRA])
    axes.imshow(reason, cmap=back, vmin=0, vmax=2, extent=extent, interpolation="nearest")
    _field(axes, error, f"depth error [{unit}]", extent, (-high, high), "RdBu_r", "none")
    legend = [Patch(color=_LOST, label="lost"), Patch(color=_EXTRA, label="beside the object")]
    small = {"fontsize": 8, "handlelength": 1, "handleheight": 1, "columnspacing": 1}
    axes.legend(handles=legend, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2, **small)


def _histogram(
    axes: Axes, error: Float[np.ndarray, "h w"], true: Float[np.ndarray, "h w"], unit: str
) -> None:
    errors = error[np.isfinite(error)]
    axes.set_title("distribution of the error")
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    axes.tick_params(labelsize=8)
    if not len(errors):
        axes.set_xticks([])
        axes.set_xlabel("no pixel has both depths", fontsize=9)
        return
    median = float(np.median(errors))
    sigma = 1.4826 * float(np.median(np.abs(errors - median)))
    reach = max(4.0 * sigma, float(np.quantile(np.abs(errors), 0.95)), 1e-9)
    axes.hist(np.clip(errors, -reach, reach), bins=60, range=(-reach, reach), color="#332288")
    axes.axvline(0.0, color="black", linewidth=0.8)
    seen = 100.0 * len(errors) / max(int(np.isfinite(true).sum()), 1)
    text = f"depth − true depth [{unit}]\nmedian {median:+.2g}, robust σ {sigma:.2g}\n"
    axes.set_xlabel(text + f"{seen:.0f} % of the object seen", fontsize=9)
    axes.locator_params(axis="x", nbins=3)


def _limits(values: Float[np.ndarray, "h w"], percent: float) -> tuple[float, float]:
    """Return the range of the finite values without ``percent`` at either end, never empty."""
    finite = values[np.isfinite(values)]
    if not len(finite):
        return 0.0, 1.0
    low, high = (float(x) for x in np.percentile(finite, [percent, 100.0 - percent]))
    return (low, high) if high > low else (low - 0.5, high + 0.5)


def _pixel_ticks(axes: Axes) -> None:
    axes.tick_params(labelsize=8, length=2)
    axes.locator_params(nbins=4, integer=True)
