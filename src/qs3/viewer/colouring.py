"""Colours of points, and the legend that says what they mean; no viser in here."""

import html
import math
from dataclasses import dataclass

import matplotlib
import numpy as np
from jaxtyping import Float, UInt8
from matplotlib.colors import to_hex

from qs3.report.figure import AFTER, NO_VALUE, PALETTE, class_colour

_MAP = matplotlib.colormaps["viridis"]
_STOPS = 8
RIGHT, WRONG = AFTER, PALETTE[6]
"""Colours of a right and of a wrong prediction; told apart by lightness too."""


@dataclass(frozen=True)
class Colouring:
    """Colours of a cloud's points and what they say."""

    colours: UInt8[np.ndarray, "n 3"]
    """Red, green and blue of each point."""
    title: str
    """What is coloured."""
    swatches: tuple[tuple[str, str], ...] = ()
    """Colour (#rrggbb) and meaning, where colours stand for names."""
    ends: tuple[str, str] | None = None
    """Lowest and highest value, where colours stand for values."""

    def legend(self) -> str:
        """The legend as HTML; names are escaped, whatever a file calls itself."""
        lines = [f"<b>{html.escape(self.title)}</b>"]
        if self.ends is not None:
            stops = ",".join(map(to_hex, _MAP(np.linspace(0, 1, _STOPS))))
            low, high = map(html.escape, self.ends)
            lines += [
                f'<div style="height:0.7em;background:linear-gradient(to right,{stops})"></div>',
                '<div style="display:flex;justify-content:space-between">'
                f"<span>{low}</span><span>{high}</span></div>",
            ]
        for colour, meaning in self.swatches:
            lines.append(
                f'<div><span style="display:inline-block;width:0.8em;height:0.8em;'
                f'background:{colour};margin-right:0.5em"></span>{html.escape(meaning)}</div>'
            )
        return "".join(lines)


def by_height(points: Float[np.ndarray, "n 3"]) -> Colouring:
    """Colour points by z, from the lowest to the highest.

    Example:
        >>> by_height(np.array([[0.0, 0, 1], [0, 0, 3]])).ends
        ('1', '3')
    """
    height = points[:, 2]
    low, high = float(height.min()), float(height.max())
    share = (height - low) / (high - low) if high > low else np.zeros(len(height))
    return Colouring(_viridis(share), "height", ends=(f"{low:.3g}", f"{high:.3g}"))


def by_view(view: UInt8[np.ndarray, "n"]) -> Colouring:
    """Colour points by the view that saw them; the ten colours come again after the tenth.

    Example:
        >>> [name for _, name in by_view(np.array([1, 0, 1], np.uint8)).swatches]
        ['view 1 (1 point)', 'view 2 (2 points)']
    """
    numbers, counts = np.unique(view, return_counts=True)
    swatches = tuple(
        (class_colour(number), f"view {number + 1} ({count} point{'s' * (count != 1)})")
        for number, count in zip(numbers.tolist(), counts.tolist(), strict=True)
    )
    palette = np.array([rgb(colour) for colour in PALETTE])
    return Colouring(palette[view % len(PALETTE)], "view", swatches)


def by_error(
    distance: Float[np.ndarray, "n"], truth: str, limit: float | None = None, unit: str = ""
) -> Colouring:
    """Colour points by their distance to the truth, from 0 to ``limit``; beyond it as at it.

    ``truth`` tells what it was measured to; the limit is by default that of `round_limit`.
    """
    limit = round_limit(distance) if limit is None else limit
    high = f"{limit:g}{unit} and more"
    return Colouring(_viridis(distance / limit), f"distance to {truth}", ends=(f"0{unit}", high))


def round_limit(distance: Float[np.ndarray, "n"]) -> float:
    """The 95th percentile, rounded up to 1, 2 or 5 times a power of ten, so that it seldom moves.

    Example:
        >>> round_limit(np.array([0.0, 0.013]))
        0.02
    """
    value = float(np.percentile(distance, 95)) if len(distance) else 0.0
    if not value > 0 or not math.isfinite(value):
        return 1.0
    power = 10.0 ** math.floor(math.log10(value))
    return float(f"{next((s for s in (1, 2, 5) if s * power >= value), 10) * power:.6g}")


def flat(
    count: int, title: str, colour: str = NO_VALUE, swatches: tuple[tuple[str, str], ...] = ()
) -> Colouring:
    """Colour all points of a cloud alike, by default grey.

    Example:
        >>> flat(2, "predicted class", "#332288", (("#332288", "chair"),)).colours.tolist()
        [[51, 34, 136], [51, 34, 136]]
    """
    return Colouring(np.tile(rgb(colour), (count, 1)), title, swatches)


def _viridis(share: Float[np.ndarray, "n"]) -> UInt8[np.ndarray, "n 3"]:
    return np.asarray(_MAP(np.clip(share, 0, 1), bytes=True))[:, :3]


def rgb(colour: str) -> UInt8[np.ndarray, "3"]:
    """Red, green and blue of a colour such as #332288."""
    return np.frombuffer(bytes.fromhex(colour[1:]), np.uint8)
