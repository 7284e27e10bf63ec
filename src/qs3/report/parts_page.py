"""The page of answers about known parts: each scan under its CAD, the most doubtful first."""

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from qs3.files import write_text
from qs3.report.clouds import project, viewer_towards
from qs3.report.collect import named_below
from qs3.report.page import asset, base64_text, environment, even_points, in_unit_ball

if TYPE_CHECKING:
    from qs3.answers.answer import Answer

_EDGES = 500
_VIEWER = (30.0, 40.0)
"""Azimuth and elevation of the viewer if the camera's place is unknown, in degrees."""


def write_parts_page(
    path: Path,
    answers: "Sequence[Answer]",
    class_names: Sequence[str],
    below: Path | None = None,
    labels: Mapping[str, str] | None = None,
) -> None:
    """Write `parts_page` to ``path``, whole or not at all; equal answers give equal bytes."""
    write_text(Path(path), parts_page(answers, class_names, below, labels))


def parts_page(
    answers: "Sequence[Answer]",
    class_names: Sequence[str],
    below: Path | None = None,
    labels: Mapping[str, str] | None = None,
) -> str:
    """Return the page as text: answers sorted by doubt, counts by class, and a form for labels.

    A reader may choose one of ``class_names`` as the label of a scan; those of ``labels`` are
    chosen. Files are named as seen from the folder ``below``, as labels of a training are found.
    """
    ordered = sorted(answers, key=lambda answer: answer.order)
    rows = [_row(answer, named_below(answer.file, below)) for answer in ordered]
    for row in rows:
        row["label"] = (labels or {}).get(row["file"])
    counts = Counter(row["name"] for row in rows)
    return environment().from_string(asset("parts.html.jinja")).render(
        class_names=class_names,
        rows=rows,
        lost=sum(answer.lost for answer in answers),
        counts=[(name, counts[name]) for name in class_names],
        style=asset("page.css") + asset("parts.css"),
        script=asset("turning.js") + asset("parts.js"),
    )  # fmt: skip


def _row(answer: "Answer", file: str) -> dict[str, Any]:
    name, share = next(iter(answer.probabilities.items()), ("", 0.0))
    state = answer.fault or ("unknown" if answer.refused else "lost" if answer.lost else "")
    row = {"file": file, "name": name, "share": share, "state": state, "doubt": answer.in_doubt}
    return row | {"lost": answer.lost, "found": answer.found, "data": encode(answer)}


def encode(answer: "Answer") -> dict[str, str]:
    """Return points and edges as the viewer sees them, as base64 of 16-bit integers.

    Both are turned into the viewer's axes (right, up, towards the viewer) and scaled together into
    the unit ball; ``scale`` is the length of that ball's radius in millimetres.
    """
    points = np.zeros((0, 3)) if answer.points is None else even_points(answer.points)
    if not len(points):
        return {"points": "", "edges": "", "scale": "0"}
    drawn = answer.drawn()
    lines = np.zeros((0, 2, 3)) if drawn is None else drawn
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
    lines = lines[np.argsort(-length, kind="stable")[:_EDGES]].reshape(-1, 3)
    eye = answer.eye
    side = _VIEWER if eye is None else viewer_towards(eye - points.mean(axis=0))
    seen = project(np.concatenate([points, lines]), *side)
    whole, radius = in_unit_ball(seen)
    cloud, edges = (base64_text(rows) for rows in (whole[: len(points)], whole[len(points) :]))
    return {"points": cloud, "edges": edges, "scale": f"{1000 * radius:.2f}"}
