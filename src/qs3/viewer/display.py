"""From an object and the choices of the page to coloured points and words; no viser in here."""

import html
from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from qs3.io.clouds import CloudKind
from qs3.report.figure import class_colour
from qs3.viewer.colouring import RIGHT, WRONG, Colouring, by_error, by_height, by_view, flat
from qs3.viewer.distance import mesh_distance, spacing
from qs3.viewer.exhibits import KINDS, Answers, Exhibit

Mode = Literal["view", "height", "error", "predicted class", "right or wrong"]
"""What the colours of a cloud say."""


@dataclass(frozen=True)
class Display:
    """What the page shows."""

    points: Float[np.ndarray, "n 3"]
    """Points to draw."""
    colouring: Colouring
    """Their colours."""
    facts: tuple[tuple[str, str], ...]
    """Names and values to print."""

    def text(self) -> str:
        """The facts as HTML; everything is escaped, whatever a file calls itself."""
        return "".join(
            f'<div><span style="opacity:0.65">{html.escape(name)}</span> {html.escape(value)}</div>'
            for name, value in self.facts
        )


def modes(answers: Answers | None) -> tuple[Mode, ...]:
    """What colours can say.

    Example:
        >>> modes(None)
        ('view', 'height', 'error')
    """
    everything = get_args(Mode)
    if answers is None:
        return everything[:3]
    return everything if answers.truth is not None else everything[:4]


def compose(
    exhibit: Exhibit,
    kind: CloudKind,
    mode: Mode,
    answers: Answers | None = None,
    row: int = 0,
    limit: float | None = None,
) -> Display:
    """Choose points, colours and words.

    Args:
        exhibit: The object.
        kind: Which of its clouds; where it has no such, the first that it has.
        mode: What colours say; grey, with the reason, where that is not known.
        answers: Of a network, where there is one.
        row: The object's row in ``answers``.
        limit: Where the scale of errors ends; by default as the cloud needs it.
    """
    if kind not in exhibit.clouds:
        kind = next(iter(exhibit.clouds))
    points = exhibit.clouds[kind]
    facts = [("object", exhibit.name)]
    facts += [("class", exhibit.class_name)] if exhibit.class_name else []
    facts += [("cloud", f"{KINDS[kind]}, {len(points)} points")]
    if answers is not None:
        facts += answers.facts(row)
        if answers.truth is not None:
            facts += [("its answer", answers.verdict(row))]
    colouring = flat(len(points), f"{mode}: not known for this cloud")
    if mode == "error":
        colouring, measured = _error(exhibit, kind, limit, colouring)
        facts += measured
    elif mode == "view" and kind in exhibit.views:
        colouring = by_view(exhibit.views[kind])
    elif mode == "height":
        colouring = by_height(points)
    elif mode == "predicted class" and answers is not None:
        colour = class_colour(answers.best(row))
        named = ((colour, answers.class_names[answers.best(row)]),)
        colouring = flat(len(points), mode, colour, named)
    elif mode == "right or wrong" and answers is not None and answers.truth is not None:
        verdicts = ((RIGHT, "answer is the label"), (WRONG, "answer is another class"))
        colour, _ = verdicts[int(answers.wrong[row])]
        colouring = flat(len(points), answers.verdict(row), colour, verdicts)
    return Display(points, colouring, (*facts, *exhibit.facts))


def _error(
    exhibit: Exhibit, kind: CloudKind, limit: float | None, unknown: Colouring
) -> tuple[Colouring, list[tuple[str, str]]]:
    """Colours and facts of the distance to the truth; ``unknown`` where there is no truth."""
    points, unit = exhibit.clouds[kind], exhibit.unit
    facts: list[tuple[str, str]] = []
    if exhibit.mesh is not None and kind != "surface":
        truth, distance = "the mesh", mesh_distance(points, exhibit.mesh)
    elif kind == "points" and "clean" in exhibit.clouds:
        clean = exhibit.clouds["clean"]
        truth, distance = "the clean twin", KDTree(clean).query(points)[0]
        # A distance to a cloud is never below about half its spacing, however good the sensor.
        facts.append(("spacing of the clean twin", f"{spacing(clean):.3g}{unit}"))
    else:
        return unknown, facts
    half, most = np.percentile(distance, [50, 95])
    facts.insert(0, ("error", f"median {half:.3g}{unit}, 95 % below {most:.3g}{unit}"))
    return by_error(distance, truth, limit, unit), facts


def frame_of(exhibit: Exhibit) -> tuple[Float[np.ndarray, "3"], float]:
    """Middle and longest side of the box of an object: of its truth, where that is known.

    The page draws every object about the origin and one unit long, so that the camera always
    stands right. What is measured and printed stays in the unit of the data.
    """
    best: tuple[CloudKind, ...] = ("clean", "surface", "points")
    cloud = next(exhibit.clouds[kind] for kind in best if kind in exhibit.clouds)
    corners = cloud if exhibit.mesh is None else exhibit.mesh.vertices
    low, high = np.asarray(corners).min(axis=0), np.asarray(corners).max(axis=0)
    side = float((high - low).max())
    return np.asarray((low + high) / 2, dtype=np.float64), side if side > 0 else 1.0
