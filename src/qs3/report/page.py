"""The report of a run as one HTML file that needs no network and no other file."""

import base64
import hashlib
from collections.abc import Sequence
from functools import cache
from importlib import resources
from pathlib import Path

import jinja2
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from qs3.files import write_text
from qs3.report.clouds import gallery
from qs3.report.contents import Cloud, Report
from qs3.report.embedding import feature_map
from qs3.report.figure import png_bytes
from qs3.report.lines import leaves
from qs3.report.montage import montage_columns
from qs3.report.plots import class_accuracy, confusion_heatmap, selection_counts, training_curves
from qs3.report.verdict import Verdict, judge

_COLUMNS = 4  # sample clouds of a class
_MISTAKES = "What the network is surest of and gets wrong, the surest first."
_NEAREST = (
    "Nearest by the network's features: what it takes a scan for, it sees in that one. A nearest "
    "scan of another class, or one that looks unlike, tells what the source lacks."
)
_POINTS = 1024  # of a cloud that the reader can turn


def write_report(path: Path, report: Report) -> Verdict | None:
    """Write the page to ``path``, whole or not at all, and return its verdict.

    The same report gives the same bytes: the page holds no time, no host and no path of its own.

    Returns:
        What the numbers say of adaptation; None where there are not two networks to compare.
    """
    write_text(Path(path), render(report))
    return _verdict(report)


def render(report: Report) -> str:
    """Return the page as text."""
    compared = (report.clouds, report.mistakes, report.nearest)
    present = {c.class_name for columns in compared for own in columns.values() for c in own}
    rules = dict.fromkeys(rule for line in report.scores for rule in line.choices)
    return _template().render(
        report=report,
        verdict=_verdict(report),
        networks=report.networks,
        shown=[name for name in report.class_names if name in present],
        tables=[
            ("By class", "", report.clouds),
            ("Most confident mistakes", _MISTAKES, report.mistakes),
            ("Beside the nearest source scan", _NEAREST, report.nearest),
        ],
        samples=_samples,
        rules=sorted(rules, key=lambda rule: rule == "oracle"),  # that one apart, at the end
    )


@cache
def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.globals |= {
        "style": _asset("page.css"),
        "script": _asset("viewer.js"),
        "digest": _digest,
        "png": _png,
        "leaves": leaves,
        "encode_points": encode_points,
        "radius": lambda points: f"{_unit_ball(points)[1]:.4g}",
        "class_accuracy": class_accuracy,
        "confusion_heatmap": confusion_heatmap,
        "feature_map": feature_map,
        "montage_columns": montage_columns,
        "selection_counts": selection_counts,
        "training_curves": training_curves,
    }
    return environment.from_string(_asset("page.html.jinja"))


def _verdict(report: Report) -> Verdict | None:
    if report.before is None or report.after is None:
        return None
    return judge(report.before, report.after)


def _samples(clouds: Sequence[Cloud], class_names: Sequence[str]) -> Figure:
    """The first clouds of each class."""
    classes = {
        name: [cloud.points for cloud in clouds if cloud.class_name == name][:_COLUMNS]
        for name in class_names
    }
    return gallery(classes, columns=max(3, *map(len, classes.values())))


def _png(figure: Figure) -> str:
    """A picture in base64."""
    return base64.b64encode(png_bytes(figure)).decode("ascii")


def encode_points(points: Float[np.ndarray, "n 3"]) -> str:
    """Return points scaled into the unit ball as base64 of little-endian 16-bit integers.

    Rows that are not finite are left out; of many points evenly spaced rows are kept.

    Example:
        >>> np.frombuffer(base64.b64decode(encode_points(np.eye(3)[:2])), "<i2").tolist()
        [23170, -23170, 0, -23170, 23170, 0]
    """
    whole = np.round(_unit_ball(points)[0] * 32767).astype("<i2")
    return base64.b64encode(whole.tobytes()).decode("ascii")


def _unit_ball(points: Float[np.ndarray, "n 3"]) -> tuple[Float[np.ndarray, "m 3"], float]:
    """The points kept, about the middle of their box and in the unit ball, and its radius."""
    points = np.asarray(points[np.isfinite(points).all(axis=1)], np.float64)
    if len(points) > _POINTS:
        points = points[np.linspace(0, len(points) - 1, _POINTS).astype(np.int64)]
    if not len(points):
        return points, 1.0
    points = points - (points.min(axis=0) + points.max(axis=0)) / 2.0
    radius = max(float(np.linalg.norm(points, axis=1).max()), 1e-12)
    return points / radius, radius


def _asset(name: str) -> str:
    return resources.files("qs3.report").joinpath(name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"sha256-{base64.b64encode(digest).decode('ascii')}"
