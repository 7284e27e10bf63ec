"""One scan on one sheet: pattern, pair, disparity, depth, truth, error, and the cloud.

Convention:
    Images are in pixel coordinates, y down, pixel (0, 0) at the top left; NaN is drawn grey. The
    error is depth − true depth: red is too far, blue is too near.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import matplotlib
import numpy as np
from jaxtyping import Float, Shaped, UInt8
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.image import AxesImage
from matplotlib.patches import Patch
from matplotlib.ticker import MaxNLocator

from qs3.report.clouds import SIDES, draw_cloud
from qs3.report.figure import NO_VALUE, house_style, short, without_frame
from qs3.sensor.scan import Scan
from qs3.sensor.speckle import pattern_image

_MARGIN = 20
"""Pixels shown around the object."""
_LOST, _EXTRA = "#6e6e6e", "#ddaa33"


@dataclass(frozen=True)
class MontageView:
    """The pictures of one view and the clouds of the whole scan."""

    left: UInt8[np.ndarray, "h w"]
    right: UInt8[np.ndarray, "h w"]
    disparity: Float[np.ndarray, "h w"]
    """Disparity in pixels, NaN where there is no match."""
    depth: Float[np.ndarray, "h w"]
    """Depth along the optical axis, NaN where there is none."""
    true_depth: Float[np.ndarray, "h w"]
    """Depth of the z-buffer, NaN where the ray misses the object."""
    cloud: Float[np.ndarray, "n 3"]
    """The noisy cloud, z up."""
    clean: Float[np.ndarray, "m 3"]
    """Its clean twin."""
    pattern: Shaped[np.ndarray, "ph pw"] | None = None
    """The projector's pattern, 0 to 1 or 8-bit."""
    unit: str = "mesh units"
    """Unit of lengths."""


def montage_view(made: Scan) -> tuple[MontageView, int]:
    """Return the view that shows most of the object, and its index; the scan has images."""
    best = int(np.argmax([view.object_pixels for view in made.views]))
    images = made.images[best]
    true_depth = np.where(images.mask, images.true_depth, np.nan)  # of the object alone
    view = MontageView(
        left=images.left,
        right=images.right,
        disparity=images.disparity,
        depth=images.depth,
        true_depth=true_depth,
        cloud=made.points,
        clean=made.clean,
        pattern=pattern_image(made.sensor.pattern),
        unit="m" if made.sensor.metric else "mesh units",
    )
    return view, best


@house_style
def montage(view: MontageView, title: str = "") -> Figure:
    """Draw one scan: four pictures, four of its depth, and each cloud from three sides."""
    figure = Figure(figsize=(12.0, 12.0), layout="constrained")
    upper, lower = figure.subfigures(2, 1, squeeze=False)[:, 0]
    if title:
        figure.suptitle(short(title, 90), fontsize=13)
    _draw_stages(upper.subplots(2, 4).ravel(), view)
    _draw_clouds(lower.subplots(2, 3), view)
    return figure


def _draw_stages(places: Iterable[Axes], view: MontageView) -> None:
    """Draw the part of the pictures that shows the object, with a margin; all where none does."""
    cells = list(places)
    y, x = np.isfinite(view.true_depth).nonzero()
    shown = [(max(i.min() - _MARGIN, 0), i.max() + 1 + _MARGIN) for i in (y, x) if len(i)]
    part = tuple(slice(*ends) for ends in shown) or (slice(None), slice(None))
    (y0, y1, _), (x0, x1, _) = (
        own.indices(size) for own, size in zip(part, view.left.shape, strict=True)
    )
    extent = (x0 - 0.5, x1 - 0.5, y1 - 0.5, y0 - 0.5)
    depth, true = view.depth[part], view.true_depth[part]
    error = (depth - true).astype(np.float64)

    _pattern(cells[0], view.pattern)
    _picture(cells[1], view.left[part], "left image", extent)
    _picture(cells[2], view.right[part], "right image", extent)
    disparity = view.disparity[part]
    _field(cells[3], disparity, "disparity [px]", extent, _limits(disparity, 2.0))
    shared = _limits(true if np.isfinite(true).any() else depth, 0.0)
    _field(cells[4], depth, f"depth [{view.unit}]", extent, shared, "viridis_r")
    _field(cells[5], true, f"true depth [{view.unit}]", extent, shared, "viridis_r")
    _error(cells[6], error, depth, true, extent, view.unit)
    _histogram(cells[7], error, true, view.unit)
    cells[7].set_box_aspect(error.shape[0] / error.shape[1])


def _draw_clouds(places: Iterable[Iterable[Axes]], view: MontageView) -> None:
    """Draw each cloud from its sides, all to one scale."""
    clouds = [("noisy cloud", view.cloud), ("clean twin", view.clean)]
    frame = next((c for c in reversed(clouds) if len(c[1])), None)
    limits = None if frame is None else (frame[1].min(axis=0), frame[1].max(axis=0))
    for (name, points), row in zip(clouds, places, strict=True):
        for axes, (side, angles) in zip(row, SIDES.items(), strict=True):
            axes.set_title(f"{name} ({len(points)} points), {side}", fontsize=9.0)
            draw_cloud(axes, points, *angles, limits=limits)


def _pattern(axes: Axes, pattern: Shaped[np.ndarray, "ph pw"] | None) -> None:
    axes.set_title("pattern")
    if pattern is None:
        axes.text(0.5, 0.5, "none projected", ha="center", va="center")
        without_frame(axes)
        return
    # A whole pattern shrunk to a thumb shows moiré, not dots: show the middle, dot by dot.
    height, width = pattern.shape
    edge = min(height, width, 256)
    top, left = (height - edge) // 2, (width - edge) // 2
    if edge < max(height, width):
        axes.set_title(f"pattern (its middle {edge} px)")
    high = 255 if pattern.dtype == np.uint8 else 1
    middle = pattern[top : top + edge, left : left + edge].astype(np.float64)
    axes.imshow(middle, cmap="gray", vmin=0, vmax=high, interpolation="nearest")
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
    shown = axes.imshow(
        np.ma.masked_invalid(values),
        cmap=cmap,
        vmin=limits[0],
        vmax=limits[1],
        extent=extent,
        interpolation="nearest",
    )
    axes.set_title(title)
    _pixel_ticks(axes)
    _colour_bar(axes, shown, values, limits)


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
    axes.legend(
        handles=legend,
        loc="upper center",
        bbox_to_anchor=(0.5, -0.1),
        ncols=2,
        fontsize=8,
        handlelength=1,
        handleheight=1,
        columnspacing=1,
    )


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


def _colour_bar(
    axes: Axes, shown: AxesImage, values: Float[np.ndarray, "h w"], limits: tuple[float, float]
) -> None:
    finite = values[np.isfinite(values)]
    below = bool(len(finite)) and float(finite.min()) < limits[0]
    above = bool(len(finite)) and float(finite.max()) > limits[1]
    extend = {(0, 0): "neither", (1, 0): "min", (0, 1): "max", (1, 1): "both"}[below, above]
    bar = axes.figure.colorbar(shown, cax=axes.inset_axes((1.03, 0.0, 0.05, 1.0)), extend=extend)
    bar.ax.tick_params(labelsize=8)
    bar.locator = MaxNLocator(5)
    bar.update_ticks()


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
