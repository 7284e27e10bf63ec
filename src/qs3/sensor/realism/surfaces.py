"""What surfaces do to the fill: dark and glancing ones (T6), mirror and glass (T7)."""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float

from qs3.sensor.materials import MATERIALS
from qs3.sensor.presets import changed
from qs3.sensor.realism.bench import Bench, central, distances, painted, plate, shoot_wall, wall
from qs3.sensor.realism.edges import NEAR, before_wall, edge_distances
from qs3.sensor.realism.rows import Judged, Row, row
from qs3.sensor.render import Body

ALBEDOS = (0.6, 0.2, 0.05, 0.02, 0.005)
DIM = 16
"""Grey levels of 255 that the brightest twentieth of a dim patch is brought to."""
ANGLES = (0.0, 30.0, 50.0, 65.0, 80.0)
_SAMPLES = 32  # rays a pixel where a mirror or glass makes path tracing needed


# T6


def fill(bench: Bench) -> Judged:
    """T6: fill of walls to 2 m, of a dark patch on a white wall, and of a turned wall.

    Walls are filled by 99 %; fill does not rise as a patch gets darker or a wall turns away, and
    falls over all (range against reflectance: Keselman et al. 2017). ``ad-census`` has no least
    texture, as Intel's default has none, and need not fall with albedo: a D415's own depth fills a
    floor of 16 grey levels. There a patch of albedo 0.3 must be filled by 97 %.

    The patch is a third of the picture that auto-exposure looks at: the wall around it sets the
    gain, as it does in a room.
    """
    sweep = distances(bench.sensor, 4 if bench.quick else 8)
    if bench.sensor.metric:
        sweep = [*(z for z in sweep if z <= 2), 2.0]
    share = 0.3 if bench.quick else 0.8
    filled = [rate(shoot_wall(bench, z, share).depth) for z in sweep]
    block, far = bench.sensor.matching.block_size, sweep[-1]
    focus, patch = central(bench.rig, 0.5, 0.5), central(bench.rig, 0.2, 0.35)
    # A block beyond the patch: what lies outside does not reach into it.
    size = [(side + 2 * block) * far / bench.rig.focal for side in (patch.width, patch.height)]
    sheet, behind = plate((0.0, far * 0.999), *size), painted(wall(far))
    by_albedo = [
        rate(bench.shoot([painted(sheet, albedo), behind], patch, focus=focus).depth)
        for albedo in ALBEDOS
    ]
    # Near walls: the slope of disparity across a turned wall is b·tan(angle)/z.
    near, narrow = edge_distances(bench)[0], central(bench.rig, 0.1, 0.5)
    by_angle = [rate(bench.shoot([painted(wall(near, turn))], narrow).depth) for turn in ANGLES]
    rows = [row(f"least fill of walls to {far:.3g} m", min(filled), 0.99)]
    dark = bench.sensor.matching.method != "ad-census"
    if not dark:
        dim = changed(bench.sensor, "exposure.auto", DIM / 255)
        faint = dataclasses.replace(bench, sensor=dim).shoot([painted(sheet, 0.3), behind], patch)
        rows.append(row(f"fill of albedo 0.3 at {DIM} grey levels", rate(faint.depth), 0.97))
    rows += fall_rows("albedo", ALBEDOS, by_albedo, patch.width * patch.height / block**2, dark)
    rows += fall_rows("angle", ANGLES, by_angle, narrow.width * narrow.height / block**2)
    curves = {"albedo": ALBEDOS, "fill_albedo": by_albedo, "angle": ANGLES, "fill_angle": by_angle}
    return rows, curves | {"z": sweep, "fill": filled}


def rate(depth: Float[np.ndarray, "h w"]) -> float:
    """Share of pixels that have a depth."""
    return float(np.isfinite(depth).mean())


def fall_rows(
    name: str, values: Sequence[float], rates: Sequence[float], blocks: float, falls: bool = True
) -> list[Row]:
    """Judge fill rates in the order in which they must fall.

    Whether pixels closer than a block are filled is decided by the same light, so that a picture
    counts as ``blocks`` trials. A rise counts where it exceeds two standard deviations of the
    difference of two binomial shares, each with one success and one failure added, which keeps
    the deviation of full and of empty pictures above 0.

    Args:
        name: What gets worse.
        values: Its values.
        rates: Fill rates.
        blocks: Number of matching blocks in a picture.
        falls: Whether the last rate must be below the first.
    """
    share = (np.asarray(rates) * blocks + 1) / (blocks + 2)
    variance = share * (1 - share) / (blocks + 2)
    noise = 2 * np.sqrt(variance[1:] + variance[:-1])
    rise = np.diff(rates)
    worst = int(np.argmax(rise - noise))
    words = f"from {values[worst]:g} to {values[worst + 1]:g}"
    fall = rates[0] - rates[-1]
    return [
        row(f"greatest rise with {name} ({words})", rise[worst], None, float(noise[worst])),
        row(f"fall over all of {name}", fall, float(noise.max()) if falls else None, strict=True),
    ]


# T7


def clear(bench: Bench) -> Judged:
    """T7: plates of mirror and glass before a wall, the mirror turned to a wall at the side.

    They have no depth of their own; what is measured there lies elsewhere (Sarbolandi et al. 2015).
    """
    import trimesh

    fine, rig = bench.refined(_SAMPLES), bench.rig
    near, far = edge_distances(bench)
    facing, room = before_wall(bench)
    width = 2 * rig.width * near / rig.focal
    mirror = Body(plate((0.0, near), width, width, 45.0), MATERIALS["mirror"])
    # As far to the left of the mirror's middle as the camera from it.
    side = plate((0.0, 0.0), 24 * near, 24 * near, 90.0).apply_translation([-near, 0.0, 0.0])
    extents = np.maximum(np.asarray(facing.mesh.extents), 0.01 * near)
    pane = trimesh.creation.box(extents=extents)
    pane.apply_translation(facing.mesh.bounds.mean(axis=0))
    rows = []
    for name, bodies, beyond in (
        ("mirror", (mirror, painted(side), room), 2 * near),
        ("glass", (Body(pane, MATERIALS["glass"]), room), far),
    ):
        view = fine.shoot(bodies, central(rig, 0.12, 0.2))
        own = np.where(view.mask, rig.disparity(view.true_depth), np.nan)
        behind = np.full(own.shape, float(rig.disparity(beyond)))
        rows += clear_rows(name, view.disparity, own, behind)
    return rows, {}


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
    measured, own, behind = disparity[on], own[on], behind[on]
    count = max(1, len(measured))
    own_share = (np.abs(measured - own) < NEAR).sum() / count if len(measured) else np.nan
    seen = (np.abs(measured - behind) < NEAR).sum() / count
    return [
        row(f"{name}: share with its own depth", own_share, None, 0.01),
        row(f"{name}: share with the depth seen in it", seen),
        row(f"{name}: share without depth", np.isnan(measured).sum() / count),
    ]
