"""A pose of a CAD file as cells of a table and as plain values of a JSON."""

from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from qs3.parts.locating import Candidate
    from qs3.parts.symmetry import Symmetry

POSE_CELLS = ["cad", "residual_mm", "visible", "explained", "misfit", "lost", "rotation",
              "translation"]  # fmt: skip
"""Columns about a CAD file in a scan: rotation, nine numbers by rows, and translation in metres."""


def best_of(candidates: "Iterable[Candidate]", class_name: str | None) -> "Candidate | None":
    """Return the first candidate of a class: its best one, if they are in order."""
    return next((found for found in candidates if found.class_name == class_name), None)


def agreement_cells(residual: float, visible: float) -> list[str]:
    """Return a residual, in metres, and a visible share as they are printed."""
    return [f"residual {1000 * residual:.1f} mm", f"visible {visible:.0%}"]


def pose_columns(found: "Iterable[Candidate | None]") -> list[str]:
    """Return `POSE_CELLS`, and ``scale`` if a part differs from its CAD."""
    scaled = any(candidate is not None and candidate.scale != 1 for candidate in found)
    return [*POSE_CELLS, "scale"] if scaled else POSE_CELLS


def pose_cells(found: "Candidate | None", lost: bool, columns: "Sequence[str]") -> dict[str, str]:
    """Return the cells of some of `pose_columns`; a lost scan has no pose."""
    row = {"lost": str(lost).lower()}
    if found is None:
        return row
    row |= {"cad": found.cad, "residual_mm": f"{1000 * found.residual:.3f}"}
    row |= {"visible": f"{found.visible:.4f}", "explained": f"{found.explained:.4f}"}
    row |= {"misfit": f"{found.misfit:.3f}", "scale": f"{found.scale:g}"}
    if not lost:
        row["rotation"] = " ".join(f"{x:.8f}" for x in found.pose[:3, :3].ravel())
        row["translation"] = " ".join(f"{x:.6f}" for x in found.pose[:3, 3])
    return {name: row[name] for name in columns if name in row}


def scan_record(
    found: "Candidate | None", lost: bool, candidates: "Iterable[Candidate]"
) -> dict[str, object]:
    """Return what CAD says of a scan as plain values: the answer, and all candidates.

    A lost scan has no pose (null). Candidates keep their best one, and each says whether it is
    lost.
    """
    best = {"pose": None} if found is None else record_of(found)
    best |= {"lost": True, "pose": None} if lost else {"lost": False}
    return {**best, "candidates": [record_of(candidate) for candidate in candidates]}


def record_of(candidate: "Candidate") -> dict[str, object]:
    """Return a candidate as plain values; lengths in metres, and a scale if it is not 1."""
    scale = {} if candidate.scale == 1 else {"scale": candidate.scale}
    return {
        "class": candidate.class_name,
        "cad": candidate.cad,
        "lost": candidate.lost,
        "pose": candidate.pose.tolist(),
        **scale,
        "symmetry": symmetry_values(candidate.symmetry),
        "residual": candidate.residual,
        "visible": candidate.visible,
        "explained": candidate.explained,
        "misfit": candidate.misfit,
    }


def symmetry_values(symmetry: "Symmetry") -> dict[str, object]:
    """Return what turns the pose into its equals: x → turn (x − middle) + middle, in the file."""
    return {
        "middle": symmetry.middle.tolist(),
        "turns": symmetry.turns.tolist(),
        "axis": None if symmetry.axis is None else symmetry.axis.tolist(),
        "ball": symmetry.ball,
    }
