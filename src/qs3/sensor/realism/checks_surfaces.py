"""What surfaces do to the fill: dark and glancing ones (T6), mirror and glass (T7)."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import trimesh
from jaxtyping import Float

from qs3.sensor.materials import MATERIALS
from qs3.sensor.realism.checks_edges import before_wall, edge_distances
from qs3.sensor.realism.checks_wall import Plain, distances, shoot_wall
from qs3.sensor.realism.results import Row, result, row
from qs3.sensor.realism.stage import Stage, central, painted, plate, wall
from qs3.sensor.render import Body

ALBEDOS = (0.6, 0.2, 0.05, 0.02, 0.005)
ANGLES = (0.0, 30.0, 50.0, 65.0, 80.0)
_NEAR = 1.0  # pixels of disparity within which a match is one of a surface
_SAMPLES = 32  # rays a pixel where a mirror or glass makes path tracing needed


# T6


def fill(stage: Stage, seed: int, quick: bool) -> Plain:
    """T6: fill of walls to 2 m, of a dark patch on a white wall, and of a turned wall.

    The patch is a third of the picture that auto-exposure looks at: the wall around it sets the
    gain, as it does in a room.
    """
    sweep = [z for z in distances(stage.sensor, 4 if quick else 8) if z <= 2 or not _metric(stage)]
    if _metric(stage):
        sweep = [*sweep, 2.0]
    share = 0.3 if quick else 0.8
    filled = [rate(shoot_wall(stage, z, share, seed).depth) for z in sweep]
    block = stage.sensor.matching.block_size
    far = sweep[-1]
    focus, patch = central(stage.rig, 0.5, 0.5), central(stage.rig, 0.2, 0.35)
    # A block beyond the patch: what lies outside does not reach into it.
    size = [(side + 2 * block) * far / stage.rig.focal for side in (patch.width, patch.height)]
    by_albedo = [
        rate(stage.shoot([painted(plate((0.0, far * 0.999), *size), a), painted(wall(far))],
                         patch, seed, focus=focus).depth)
        for a in ALBEDOS
    ]  # fmt: skip
    # Near walls: the slope of disparity across a turned wall is b·tan(angle)/z.
    near = edge_distances(stage)[0]
    narrow = central(stage.rig, 0.1, 0.5)
    by_angle = [rate(stage.shoot([painted(wall(near, t))], narrow, seed).depth) for t in ANGLES]
    rows = [row(f"least fill of walls to {far:.3g} m", min(filled), 0.99)]
    for name, at, seen, part in (
        ("albedo", ALBEDOS, by_albedo, patch),
        ("angle", ANGLES, by_angle, narrow),
    ):
        rows += fall_rows(name, at, seen, part.width * part.height / block**2)
    return result(
        "T6",
        rows,
        {"albedo": ALBEDOS, "fill_albedo": by_albedo, "angle": ANGLES, "fill_angle": by_angle}
        | {"z": sweep, "fill": filled},
    )


def _metric(stage: Stage) -> bool:
    return stage.sensor.metric


def rate(depth: Float[np.ndarray, "h w"]) -> float:
    """Share of pixels that have a depth.

    Example:
        >>> rate(np.array([[1.0, np.nan]]))
        0.5
    """
    return float(np.isfinite(depth).mean())


def fall_rows(name: str, at: Sequence[float], seen: Sequence[float], blocks: float) -> list[Row]:
    """Judge fill rates in the order in which they must fall.

    Whether pixels closer than a block are filled is decided by the same light, so that a picture
    counts as ``blocks`` trials. A rise counts where it exceeds two standard deviations of the
    difference of two binomial shares, each with one success and one failure added, which keeps
    the deviation of full and of empty pictures above 0.

    Args:
        name: What gets worse.
        at: Its values.
        seen: Fill rates.
        blocks: Number of matching blocks in a picture.
    """
    share = (np.asarray(seen) * blocks + 1) / (blocks + 2)
    variance = share * (1 - share) / (blocks + 2)
    noise = 2 * np.sqrt(variance[1:] + variance[:-1])
    rise = np.diff(seen)
    worst = int(np.argmax(rise - noise))
    words = f"from {at[worst]:g} to {at[worst + 1]:g}"
    return [
        row(f"greatest rise with {name} ({words})", rise[worst], None, float(noise[worst])),
        row(f"fall over all of {name}", seen[0] - seen[-1], float(noise.max()), strict=True),
    ]


# T7


def clear(stage: Stage, seed: int, quick: bool) -> Plain:
    """T7: plates of mirror and glass before a wall, the mirror turned to a wall at the side."""
    fine = stage.refined(_SAMPLES)
    near, far = edge_distances(stage)
    region = central(stage.rig, 0.12, 0.2)
    rows = []
    facing = before_wall(stage)
    width = 2 * stage.rig.width * near / stage.rig.focal
    turned = plate((0.0, near), width, width, 45.0)
    side = trimesh.Trimesh(*_side_wall(near), process=False)
    scenes = {
        "mirror": (Body(turned, MATERIALS["mirror"]), painted(side), facing[1]),
        "glass": (Body(_pane(facing[0].mesh, near), MATERIALS["glass"]), facing[1]),
    }
    for name, bodies in scenes.items():
        shot = fine.shoot(bodies, region, seed)
        own = np.where(shot.body == 0, stage.rig.disparity(shot.true_depth), np.nan)
        behind = np.full(own.shape, float(stage.rig.disparity(far)))
        if name == "mirror":
            # The side wall stands as far from the mirror's middle as the mirror from the camera.
            behind = np.full(own.shape, float(stage.rig.disparity(2 * near)))
        rows += clear_rows(name, shot.disparity, own, behind)
    return result("T7", rows)


def clear_rows(
    name: str,
    disparity: Float[np.ndarray, "h w"],
    own: Float[np.ndarray, "h w"],
    behind: Float[np.ndarray, "h w"],
) -> list[Row]:
    """Judge what is measured on a surface that cannot be seen.

    Args:
        name: The surface.
        disparity: What is measured.
        own: Disparity of the surface itself, NaN beside it.
        behind: Disparity of what is seen through it or in it.
    """
    on = np.isfinite(own)
    count = max(1, int(on.sum()))
    own_share = (np.abs(disparity - own) < _NEAR)[on].sum() / count if on.any() else np.nan
    seen = (np.abs(disparity - behind) < _NEAR)[on].sum() / count
    none = np.isnan(disparity)[on].sum() / count
    return [
        row(f"{name}: share with its own depth", own_share, None, 0.01),
        row(f"{name}: share with the depth seen in it", seen),
        row(f"{name}: share without depth", none),
    ]


def _side_wall(distance: float) -> tuple[Any, Any]:
    """A wall along the line of sight, ``distance`` to the left of the camera."""
    size = 12 * distance
    corners = [
        (-distance, y, z) for y, z in ((-size, -size), (size, -size), (size, size), (-size, size))
    ]
    return np.array(corners), np.array([[0, 1, 2], [0, 2, 3]])


def _pane(sheet: trimesh.Trimesh, distance: float) -> trimesh.Trimesh:
    """A pane of the sheet's size, 1/100 of its distance thick."""
    extents = np.maximum(np.asarray(sheet.extents), 0.01 * distance)
    return trimesh.creation.box(extents=extents).apply_translation(sheet.bounds.mean(axis=0))
