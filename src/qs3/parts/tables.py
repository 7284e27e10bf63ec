"""A pose of a CAD file as cells of a table and as plain values of a JSON."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from qs3.parts.locating import Candidate
    from qs3.parts.symmetry import Symmetry

POSE_CELLS = ["cad", "residual_mm", "visible", "explained", "misfit", "lost", "rotation",
              "translation"]  # fmt: skip
"""Columns about a CAD file in a scan: rotation, nine numbers by rows, and translation in metres."""


def pose_cells(found: "Candidate | None", lost: bool) -> dict[str, str]:
    """Return the cells of `POSE_CELLS`; a lost scan has no pose."""
    row = {"lost": str(lost).lower()}
    if found is None:
        return row
    row |= {"cad": found.cad, "residual_mm": f"{1000 * found.residual:.3f}"}
    row |= {"visible": f"{found.visible:.4f}", "explained": f"{found.explained:.4f}"}
    row |= {"misfit": f"{found.misfit:.3f}"}
    if not lost:
        row["rotation"] = " ".join(f"{x:.8f}" for x in found.pose[:3, :3].ravel())
        row["translation"] = " ".join(f"{x:.6f}" for x in found.pose[:3, 3])
    return row


def record_of(candidate: "Candidate") -> dict[str, object]:
    """Return a candidate as plain values; lengths in metres."""
    return {
        "class": candidate.class_name,
        "cad": candidate.cad,
        "pose": candidate.pose.tolist(),
        "symmetry": symmetry_values(candidate.symmetry),
        "residual": candidate.residual,
        "visible": candidate.visible,
        "explained": candidate.explained,
        "misfit": candidate.misfit,
    }


def symmetry_values(own: "Symmetry") -> dict[str, object]:
    """Return what turns the pose into its equals: x → turn (x − middle) + middle, in the file."""
    return {
        "middle": own.middle.tolist(),
        "turns": own.turns.tolist(),
        "axis": None if own.axis is None else own.axis.tolist(),
        "ball": own.ball,
    }
