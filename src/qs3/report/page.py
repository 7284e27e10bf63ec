"""The report of a run as one HTML file that needs no network and no other file."""

import base64
import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import jinja2
import numpy as np
from jaxtyping import Float, Int16

from qs3.errors import InputError
from qs3.evaluation.records import Scores
from qs3.files import check_output, is_page, write_text
from qs3.report.figure import png_bytes
from qs3.report.plots import Curve, confusion_heatmap, selection_counts, training_curves

if TYPE_CHECKING:
    from qs3.runs.rounds import RoundRecord

_POINTS = 1024  # of a cloud that the reader can turn
_ENDINGS = ".html", ".htm"


@dataclass(frozen=True)
class Cloud:
    """A cloud that the reader can turn, z up, with a text below it."""

    points: Float[np.ndarray, "n 3"]
    class_name: str
    note: str = ""


@dataclass(frozen=True)
class Report:
    """The contents of a page; empty parts are left out of it."""

    title: str
    summary: str
    class_names: tuple[str, ...]
    """Classes of the run, by label; scores may have others (`qs3 evaluate --map`)."""
    scores: Mapping[str, Scores] = field(default_factory=dict)
    """Scores by name: of the network before adaptation, if known, and of the run's network."""
    notes: tuple[str, ...] = ()
    """Remarks below the scores."""
    clouds: Mapping[str, Sequence[Cloud]] = field(default_factory=dict)
    """Clouds to turn, by domain."""
    curves: tuple[Curve, ...] = ()
    marks: tuple[float, ...] = ()
    """Epochs at which rounds begin."""
    rounds: "tuple[RoundRecord, ...]" = ()
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings, data and versions; mappings inside become dotted names."""
    faults: tuple[str, ...] = ()
    """Faults of clouds that are left out of the page."""
    total: int = 0
    """Number of clouds that were answered, or have a fault."""


def write_report(path: Path, report: Report) -> None:
    """Write the page to ``path``, whole or not at all.

    The same report gives the same bytes: the page holds no time, no host and no path of its own.
    """
    write_text(Path(path), render(report))


def check_page(path: Path) -> None:
    """Refuse a page (``--out``) that cannot be written, or would replace one that is not ours."""
    check_output(path, "--out", *_ENDINGS)
    if not path.exists() and path.suffix.lower() not in _ENDINGS:
        raise InputError(f"--out {path}: name a .html file")
    if path.is_file() and path.stat().st_size and not is_page(path):
        raise InputError(
            f"--out {path}: is there already and is no page of qs3; move it, or name another page"
        )


def render(report: Report) -> str:
    """Return the page as text."""
    present = {cloud.class_name for domain in report.clouds.values() for cloud in domain}
    shown = [name for name in report.class_names if name in present]
    return _template().render(report=report, shown=shown)


def environment() -> jinja2.Environment:
    """Return the settings of every template of a page: text of data is escaped."""
    created = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    created.globals["digest"] = _digest
    return created


@cache
def _template() -> jinja2.Template:
    templates = environment()
    templates.globals |= {
        "style": asset("page.css"),
        "script": asset("turning.js") + asset("viewer.js"),
        "png": lambda figure: base64.b64encode(png_bytes(figure)).decode("ascii"),
        "leaves": leaves,
        "encode_points": encode_points,
        "confusion_heatmap": confusion_heatmap,
        "selection_counts": selection_counts,
        "training_curves": training_curves,
    }
    return templates.from_string(asset("page.html.jinja"))


def leaves(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Return the leaves of nested mappings by dotted name, in their order.

    Example:
        >>> leaves({"seed": 1, "sensor": {"views": 5, "names": ("a", "b")}})
        {'seed': 1, 'sensor.views': 5, 'sensor.names': ('a', 'b')}
    """
    flat: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{prefix}{key}"
        flat |= leaves(value, f"{name}.") if isinstance(value, Mapping) else {name: value}
    return flat


def encode_points(points: Float[np.ndarray, "n 3"]) -> str:
    """Return points scaled into the unit ball as base64 of little-endian 16-bit integers.

    Rows that are not finite are left out; of many points evenly spaced rows are kept.

    Example:
        >>> np.frombuffer(base64.b64decode(encode_points(np.eye(3)[:2])), "<i2").tolist()
        [23170, -23170, 0, -23170, 23170, 0]
    """
    return base64_text(in_unit_ball(even_points(points))[0])


def even_points(points: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "m 3"]:
    """Return the finite points; of more than 1,024 evenly spaced rows."""
    points = np.asarray(points[np.isfinite(points).all(axis=1)], np.float64)
    rows = np.linspace(0, len(points) - 1, min(len(points), _POINTS)).astype(np.int64)
    return points[rows]


def in_unit_ball(points: Float[np.ndarray, "n 3"]) -> tuple[Int16[np.ndarray, "n 3"], float]:
    """Return points about the middle of their box, 32767 being the farthest, and its distance."""
    if not len(points):
        return points.astype("<i2"), 0.0
    points = points - (points.min(axis=0) + points.max(axis=0)) / 2
    radius = max(float(np.linalg.norm(points, axis=1).max()), 1e-12)
    return np.round(points / radius * 32767).astype("<i2"), radius


def base64_text(values: Int16[np.ndarray, "n 3"]) -> str:
    """Return little-endian 16-bit integers as base64."""
    return base64.b64encode(values.tobytes()).decode("ascii")


def asset(name: str) -> str:
    """Return the text of a file beside this one."""
    return resources.files("qs3.report").joinpath(name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"sha256-{base64.b64encode(digest).decode('ascii')}"
