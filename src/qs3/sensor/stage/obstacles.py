"""Checks that no camera or projector stands inside something, before rendering."""

from collections.abc import Mapping, Sequence

import numpy as np
import trimesh
from jaxtyping import Float

from qs3.errors import InputError
from qs3.sensor.light import Body
from qs3.sensor.presets import Sensor
from qs3.sensor.rig import Pose


def check_views(bodies: Mapping[str, Body], poses: Sequence[Pose], sensor: Sensor) -> None:
    """Refuse what no camera can stand in or light up, before anything is rendered."""
    rig = sensor.rig
    for index, pose in enumerate(poses):
        eyes = {"camera": pose, "right camera": rig.right(pose), "projector": rig.projector(pose)}
        for eye, stands in eyes.items():
            for name, body in bodies.items():
                if where := _blocked(stands.position, body, name):
                    raise InputError(
                        f"view {index}: the {eye} stands {where}; give placement a larger radius "
                        "or another elevation, or make object and neighbour smaller (object_size)"
                    )
    mesh = bodies["object"].mesh
    if sensor.light.projector > 0 and not any(_lit(mesh, sensor, pose) for pose in poses):
        raise InputError(
            f"the projector ({rig.projector_offset} baselines from the left camera) throws its "
            "pattern past the object in every view; bring it nearer (rig.projector_offset) or "
            "widen pattern.tan_half_width and tan_half_height"
        )


def _blocked(at: Float[np.ndarray, "3"], body: Body, name: str) -> str:
    if name in ("floor", "wall"):
        outside = float((at - body.mesh.vertices[0]) @ body.mesh.face_normals[0]) > 0
        return "" if outside else ("under the floor" if name == "floor" else "behind the wall")
    low, high = np.asarray(body.mesh.bounds)
    if ((at < low) | (at > high)).any():
        return ""
    from scipy.spatial import ConvexHull

    # The box of a turned block reaches far beyond it. Flat meshes have a hull with QJ alone.
    hull = ConvexHull([*body.mesh.vertices, at], qhull_options="QJ")
    return "" if len(body.mesh.vertices) in hull.vertices else f"inside the {name}'s hull"


def _lit(mesh: trimesh.Trimesh, sensor: Sensor, pose: Pose) -> bool:
    """Whether the projector's cone and the mesh may meet: no side of the cone parts them."""
    at = sensor.rig.projector(pose).camera_to_world
    x, y, z = ((mesh.vertices - at[:3, 3]) @ at[:3, :3]).T
    wide, high = sensor.pattern.tan_half_width * z, sensor.pattern.tan_half_height * z
    sides = (z > 0, x < wide, x > -wide, y < high, y > -high)
    return all(bool(side.any()) for side in sides)
