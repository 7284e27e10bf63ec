"""The page of answers about known parts: each scan under its CAD, the most doubtful first."""

import base64
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float

from qs3.answers.answer import DOUBT
from qs3.files import write_text
from qs3.report.clouds import project
from qs3.report.collect import named_below
from qs3.report.page import asset, environment

if TYPE_CHECKING:
    from qs3.answers.answer import Answer

PARTS = "parts.html"
_POINTS, _EDGES = 1024, 500
_FRONT, _AHEAD = 30.0, 40.0
"""Azimuth and elevation of the viewer if the camera's place is unknown, in degrees."""


@dataclass(frozen=True)
class PartRow:
    """A scan and its answer; lengths in metres."""

    file: str
    class_name: str = ""
    """Answered class; empty if there is none."""
    cad: str = ""
    """CAD file that was aligned with the scan."""
    confidence: float = 0.0
    state: str = ""
    """Why the answer is in doubt: unknown, lost, or the fault of a file; empty if it is not."""
    residual: float | None = None
    visible: float | None = None
    """Share of the CAD's visible surface that the scan shows."""
    points: Float[np.ndarray, "n 3"] | None = None
    edges: Float[np.ndarray, "e 2 3"] | None = None
    """Ends of the CAD's edges, in the frame of the scan."""
    camera: Float[np.ndarray, "3"] | None = None
    """Place of the camera in the frame of the scan, if known."""


@dataclass(frozen=True)
class PartsPage:
    """The contents of a page."""

    title: str
    summary: str
    class_names: tuple[str, ...]
    """Classes that a reader may choose as the label of a scan."""
    rows: Sequence[PartRow]
    sure: float = DOUBT
    """Confidence below which an answer is in doubt."""


def page_of(
    answers: "Sequence[Answer]", class_names: Sequence[str], below: Path | None = None
) -> PartsPage:
    """Return the page of answers with their points and poses.

    Files are named as seen from the folder ``below``, as labels of a training are found.
    """
    rows = []
    for one in answers:
        name, share = next(iter(one.probabilities.items()), ("", 0.0))
        state = one.fault or ("unknown" if one.refused else "lost" if one.lost else "")
        row = PartRow(named_below(one.file, below), name, confidence=share, state=state)
        if one.found is not None:
            row = replace(row, cad=one.found.cad, residual=one.found.residual)
            row = replace(row, visible=one.found.visible, edges=one.drawn())
        camera = None if one.place is None or one.place.camera is None else one.place.camera
        rows.append(replace(row, points=one.points,
                            camera=None if camera is None else np.array(camera)))  # fmt: skip
    lost = sum(row.state == "lost" for row in rows)
    text = f"{len(rows)} scans, {lost} of them lost: no pose of any CAD agrees with them."
    return PartsPage("Parts in their scans", text, tuple(class_names), rows)


def write_parts_page(path: Path, page: PartsPage) -> None:
    """Write the page to ``path``, whole or not at all; equal contents give equal bytes."""
    write_text(Path(path), render_parts_page(page))


def render_parts_page(page: PartsPage) -> str:
    """Return the page as text: rows sorted by doubt, counts by class, and a form for labels."""
    rows = sorted(page.rows, key=lambda row: (not row.state, row.confidence, row.file))
    named = [row.class_name for row in rows if row.class_name and not row.state]
    counts = Counter(named)
    template = environment().from_string(asset("parts.html.jinja"))
    return template.render(
        page=page,
        rows=rows,
        doubtful=[is_doubtful(row, page.sure) for row in rows],
        counts=[(name, counts[name]) for name in page.class_names],
        encode=encode_row,
        style=asset("page.css") + asset("parts.css"),
        script=asset("parts.js"),
    )


def is_doubtful(row: PartRow, sure: float) -> bool:
    """Return whether a person should look at an answer."""
    return bool(row.state) or row.confidence < sure


def encode_row(row: PartRow) -> dict[str, str]:
    """Return points and edges as the viewer sees them, as base64 of 16-bit integers.

    Both are turned into the viewer's axes (right, up, towards the viewer) and scaled together into
    the unit ball; ``scale`` is the length of that ball's radius in millimetres.
    """
    if row.points is None or not np.isfinite(row.points).all(axis=1).any():
        return {"points": "", "edges": "", "scale": "0"}
    points = np.asarray(row.points, np.float64)[np.isfinite(row.points).all(axis=1)]
    rows = np.linspace(0, len(points) - 1, min(len(points), _POINTS)).astype(np.int64)
    points = points[rows]
    lines = np.zeros((0, 2, 3)) if row.edges is None else np.asarray(row.edges, np.float64)
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
    lines = lines[np.argsort(-length, kind="stable")[:_EDGES]].reshape(-1, 3)
    azimuth, elevation = _FRONT, _AHEAD
    if row.camera is not None:
        x, y, z = np.asarray(row.camera, np.float64) - points.mean(axis=0)
        azimuth = float(np.degrees(np.arctan2(x, -y)))
        elevation = float(np.degrees(np.arctan2(z, np.hypot(x, y))))
    seen = project(np.concatenate([points, lines]), azimuth, elevation)
    seen = seen - (seen.min(axis=0) + seen.max(axis=0)) / 2
    radius = max(float(np.linalg.norm(seen, axis=1).max()), 1e-12)
    whole = np.round(seen / radius * 32767).astype("<i2")
    first, second = whole[: len(points)], whole[len(points) :]
    encoded = [base64.b64encode(part.tobytes()).decode("ascii") for part in (first, second)]
    return {"points": encoded[0], "edges": encoded[1], "scale": f"{1000 * radius:.2f}"}
