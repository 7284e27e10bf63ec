"""Scanned objects: distances of their points from their faces (T10), and strays (T11).

An error δ of disparity moves a point along its ray by z²·δ/(f·b) of depth. With r the ray of
length 1 along the optical axis and n the face's unit normal, the point is then |r·n|·z²·δ/(f·b)
off the face. With the sub-pixel RMS σ_d that T1 measures on a facing wall at the same distance, a
point's distance from its face divided by |r·n|·z²·σ_d/(f·b) has median 0 and a median absolute
deviation (MAD) of 1/1.4826, if its noise is that of the wall.
"""

import dataclasses
from collections.abc import Sequence

import numpy as np
from jaxtyping import Bool, Float

from qs3.geometry import rotation_z
from qs3.sensor.light.raycast import DepthCaster
from qs3.sensor.rig import StereoRig
from qs3.sensor.statistics import radius_ratio
from qs3.sensor.view import ViewImages

from .bench import VIEW, Bench, painted
from .metrics import Row, row
from .walls import wall_noise

MOST_DEGREES = 60.0
_TILT = 25.0  # degrees by which the object is looked down upon
_GOLDEN = 0.381966  # of a full turn: any number of turns is spread evenly


def scanned(bench: Bench) -> list[Row]:
    """T10: a cabinet from many sides over the placement's distances, and walls there.

    Errors are alike within a block of the matcher, so that a view has but a few dozen independent
    ones: the median needs many views to come out at 0.
    """
    sensor, count = bench.sensor, 12
    near, far = sensor.placement.radius
    half = 0.9 * sensor.object_size
    walls = np.geomspace(max(near - half, 1.05 * sensor.depth.near), far + half, 3)
    # The middle of the frame, where the object is: the metric divides by the length of the ray.
    sigma = [wall_noise(bench, z, 0.3)[1] for z in walls.tolist()]
    parts = []
    for index in range(count):
        distance = near + (far - near) * (index + 0.5) / count
        view = shoot_object(bench, distance, 360 * _GOLDEN * index, index)
        parts.append(off_faces(view, bench.rig, sensor.matching.block_size, walls, sigma))
    return scan_rows(np.concatenate(parts))


def shoot_object(bench: Bench, distance: float, turn: float, index: int) -> ViewImages:
    """Photograph a cabinet looked down upon, turned by ``turn`` degrees; with normals."""
    import trimesh

    from qs3 import shapes
    from qs3.meshes import normalise

    mesh = normalise(shapes.make("cabinet", seed=1), "box")
    points = np.asarray(mesh.vertices) * bench.sensor.object_size
    tilt = np.radians(_TILT)
    lean = np.array([[1, 0, 0], [0, np.cos(tilt), -np.sin(tilt)], [0, np.sin(tilt), np.cos(tilt)]])
    points = points @ rotation_z(np.radians(turn)).T @ lean.T + np.array([0.0, distance, 0.0])
    body = painted(trimesh.Trimesh(points, mesh.faces, process=False))
    region = bench.rig.region_of(np.asarray(body.mesh.bounds), VIEW, 16)
    cast = DepthCaster(body.mesh).cast(bench.rig, VIEW, region, normals=True)
    return dataclasses.replace(bench.shoot([body], region, index), normals=cast.normals)


def off_faces(
    view: ViewImages, rig: StereoRig, block: int, walls: Float[np.ndarray, "w"], sigma: list[float]
) -> Float[np.ndarray, "n"]:
    """Return signed distances from the faces in units of the law; positive is away from the camera.

    Only points count whose face fills half the matcher's ``block`` around them and is seen at 60°
    or less. ``sigma`` are the sub-pixel RMS of facing walls at the distances ``walls``; the view
    needs normals.
    """
    cx, cy = rig.principal_point
    y, x = np.indices(view.depth.shape)
    x, y = (view.region.x + x - cx) / rig.focal, (view.region.y + y - cy) / rig.focal
    ray, normals = np.stack([x, y, np.ones(x.shape)], axis=-1), np.asarray(view.normals)
    cosine = np.abs(np.einsum("ijk,ijk->ij", ray, normals)) / np.linalg.norm(ray, axis=-1)
    kept = inside_faces(view, ray, block // 2 + 2) & np.isfinite(view.depth)
    kept &= cosine > np.cos(np.radians(MOST_DEGREES))
    z = view.true_depth[kept]
    law = z**2 * np.interp(z, walls, sigma) / (rig.focal * rig.baseline)
    # Both the distance and the law have the factor |r·n|, which cancels.
    return (view.depth[kept] - z) / law


def inside_faces(
    view: ViewImages, ray: Float[np.ndarray, "h w 3"], reach: int
) -> Bool[np.ndarray, "h w"]:
    """Pixels around which all pixels within ``reach`` show the same plane."""
    import cv2

    normals = np.asarray(view.normals)
    offset = np.einsum("ijk,ijk->ij", ray, normals) * view.true_depth
    plane = np.concatenate([normals, offset[..., None]], axis=-1)
    plane = np.where(np.isfinite(plane), plane, 1e3).astype(np.float32)
    square = np.ones((2 * reach + 1, 2 * reach + 1), np.uint8)
    apart = cv2.dilate(plane, square) - cv2.erode(plane, square)
    return (np.abs(apart).max(axis=-1) < 1e-4) & view.mask


def scan_rows(ratio: Float[np.ndarray, "n"]) -> list[Row]:
    """Judge signed distances in units of the law."""
    if len(ratio) < 100:
        return [row("points", float(len(ratio)), 100.0)]
    median = float(np.median(ratio))
    mad = float(np.median(np.abs(ratio - median)))
    return [
        row("|median| over MAD", abs(median) / mad, None, 0.2, strict=True),
        row("1.4826 MAD over the law", 1.4826 * mad, 0.75, 1.25),
    ]


REAL = {0.05: 0.40, 0.25: 0.60, 0.50: 0.70}
"""Least `radius_ratio` by quantile. Single-view objects of three real sets have 0.40 to 0.66, 0.58
to 0.76 and 0.69 to 0.80 (NYU Depth v2, SUN RGB-D, ScanNet)."""


def strays(bench: Bench) -> list[Row]:
    """T11: one view of objects of all ten classes in a room, cut out by their masks."""
    from qs3 import shapes
    from qs3.sensor.scan import scan

    ratios = []
    for index in range(4 * len(shapes.CLASSES)):
        number, label = divmod(index, len(shapes.CLASSES))
        shot = scan(
            shapes.make(shapes.CLASSES[label], seed=number),
            sensor=bench.sensor,
            renderer=bench.renderer,
            views=1,
            scene="room",
            crop="mask",
            seed=bench.seed + index,
        )
        ratios.append(radius_ratio(shot.points))
    return ratio_rows(ratios)


def ratio_rows(ratios: Sequence[float]) -> list[Row]:
    """Judge the radius ratios of scans."""
    return [
        row(f"radius ratio, {100 * share:.0f} % quantile", np.quantile(ratios, share), least)
        for share, least in REAL.items()
    ]
