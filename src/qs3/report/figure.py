"""Style, colours and bytes of every picture; the bytes depend on the input alone."""

import io
import re
import warnings
from pathlib import Path

import matplotlib
import matplotlib.style
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qs3.errors import InputError
from qs3.files import write_bytes

_MUTED = "#332288 #88ccee #44aa99 #117733 #999933 #ddcc77 #cc6677 #882255 #aa4499 #c4c4c4"
PALETTE = tuple(_MUTED.split())
"""Paul Tol's `muted` scheme, distinct for colour-blind readers (https://personal.sron.nl/~pault);
its pale grey is a shade darker here, to be seen on white."""

MARK = "qs3 sheet"
"""Stands in every picture that `check_picture` lets go."""

NO_VALUE = "#c9c9c9"
"""Grey of pixels without a value; it is in none of the colour maps used."""

_STYLE = {
    "font.family": "DejaVu Sans",
    "font.size": 10.0,
    "axes.titlesize": 10.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": False,
    "text.parse_math": False,  # a class may be called "a$b$"
    "legend.frameon": False,
    "figure.constrained_layout.w_pad": 0.08,
    "figure.constrained_layout.h_pad": 0.08,
    "figure.facecolor": "white",
    "savefig.facecolor": "white",
}

house_style = matplotlib.style.context(["default", _STYLE])
"""Decorator: runs a drawing function under this style, whatever matplotlibrc the user has."""


@house_style
def png_bytes(figure: Figure, dpi: int = 150, mark: str | None = None) -> bytes:
    """Return the figure as PNG; equal figures give equal bytes (no version, no time inside).

    A ``mark`` is written into the file, for `check_picture`.

    Example:
        >>> png_bytes(Figure(figsize=(1, 1)))[1:4]
        b'PNG'
    """
    buffer = io.BytesIO()
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Glyph .* missing from")  # an emoji in a user's name
        figure.savefig(buffer, format="png", dpi=dpi, metadata={"Software": None, "Source": mark})
    return buffer.getvalue()


def check_picture(path: Path, mark: str = MARK) -> None:
    """Refuse to replace a file without the mark of `write_png` and `qs3 figure`."""
    if not path.exists():
        return
    if path.is_file():
        with path.open("rb") as file:
            if re.search(rb"(tEXtSource\0|<dc:source>)" + mark.encode(), file.read(1000)):
                return
    raise InputError(f"{path}: is no such picture of qs3; move it, or name another place")


@house_style
def svg_bytes(figure: Figure) -> bytes:
    """Return the figure as SVG with its text as text, and our mark; equal ones give equal bytes.

    Example:
        >>> b"<svg" in svg_bytes(Figure(figsize=(1, 1)))
        True
    """
    buffer = io.BytesIO()
    with matplotlib.rc_context({"svg.hashsalt": "qs3", "svg.fonttype": "none"}):
        facts = {"Date": None, "Creator": None, "Source": MARK}
        figure.savefig(buffer, format="svg", metadata=facts)
    return buffer.getvalue()


def write_png(path: Path, figure: Figure, dpi: int = 150, mark: str = MARK) -> None:
    """Write the figure to ``path`` as PNG with our mark, whole or not at all."""
    write_bytes(Path(path), png_bytes(figure, dpi, mark))


def class_colour(index: int) -> str:
    """Return the colour of the class at ``index``; after ten they repeat.

    Example:
        >>> class_colour(0) == class_colour(10)
        True
    """
    return PALETTE[index % len(PALETTE)]


def short(name: str, length: int = 16) -> str:
    """Return a name cut to ``length`` characters, so that no name crowds out its picture.

    Example:
        >>> short("chair"), short("a chair with a very long name")
        ('chair', 'a chair with a …')
    """
    return name if len(name) <= length else name[: length - 1] + "…"


def without_frame(axes: Axes) -> None:
    """Remove ticks and frame from ``axes``, but keep the title."""
    axes.set(xticks=[], yticks=[])
    axes.spines[:].set_visible(False)
