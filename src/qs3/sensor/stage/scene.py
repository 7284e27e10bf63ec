"""Surroundings of the object: floor, wall, table, neighbour, or none as in the paper.

Convention:
    World: z up; the object stands about the origin. The first view defines the front: the wall
        stands behind the object, the neighbour in front or beside. The scene is the same for all
        views. With something in front or behind, the views stay on an arc about the first one; else
        they go all round.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Annotated

import numpy as np
from jaxtyping import Float

from qs3.checks import Bounds, NotNegative, Positive, check
from qs3.errors import InputError
from qs3.geometry import invert_rigid, rotation_z, transform_points
from qs3.sensor.light import Body
from qs3.sensor.light.materials import Material
from qs3.sensor.rig import Pose, StereoRig

if TYPE_CHECKING:
    import trimesh

LAYOUTS = ("alone", "floor", "wall", "room", "behind", "beside", "table")
_ARCED = {"wall", "behind"}  # with these the views stay on an arc
_SURVEY, _STEPS = 96, 25  # pixels and places at which a neighbour's cover is tried
_TABLE, _RIM = (0.7, 1.2, 0.03), 0.1  # least depth, width and thickness of a table's top; its rim
_LIFT = 1e-4  # of the object's size between it and the floor: equal planes would flicker


@dataclass(frozen=True)
class SceneSettings:
    """Settings of the surroundings. Distances are shares of the object's size."""

    layout: str = "alone"
    """``alone`` (the paper), on a ``floor``, before a ``wall``, in a ``room`` (both), ``behind``
    a neighbour that hides part of it, or ``beside`` one, on a ``table``; joined by + as in
    ``room+beside``."""
    floor: Material = field(default_factory=lambda: Material(albedo=0.5))
    """Surface of the floor and of the table's top."""
    wall: Material = field(default_factory=lambda: Material(albedo=0.6))
    """Surface of the wall."""
    neighbour: Material | None = None
    """Surface of the neighbour; None is the object's own."""
    wall_gap: NotNegative = 0.3
    """Between the wall and what stands before it."""
    neighbour_gap: NotNegative = 0.2
    """Between the object and its neighbour."""
    neighbour_size: Positive = 1.0
    """Size of the neighbour."""
    cover: Annotated[float, Bounds(high=1, above=True)] = 0.3
    """``behind``: share of what the first view sees of the object that the neighbour hides, as
    near as its shape allows."""
    table_height: Positive = 0.75
    """From the floor to the table's top, in the unit of the scene."""
    extent: Positive = 20.0
    """Side of the floor and of the wall."""
    arc: Annotated[float, Bounds(high=170)] = 120.0
    """Degrees within which the views stay if something stands in front or behind."""

    def __post_init__(self) -> None:
        unknown = [part for part in self.layout.split("+") if part not in LAYOUTS]
        if unknown:
            raise InputError(
                f"scene: no layout {unknown[0]!r}; choose of {', '.join(LAYOUTS)}, joined by +"
            )
        if "alone" in self.parts and len(self.parts) > 1:
            raise InputError(f"scene: alone does not go with others, as in {self.layout!r}")
        if {"behind", "beside"} <= self.parts:
            raise InputError("scene: the neighbour stands in front (behind) or beside, not both")
        check(self, "scene")

    @property
    def parts(self) -> frozenset[str]:
        """The layouts joined in ``layout``, a room as floor and wall."""
        return frozenset(self.layout.replace("room", "floor+wall").split("+"))

    @property
    def needs_neighbour(self) -> bool:
        """Return whether a second mesh is needed."""
        return bool(self.parts & {"behind", "beside"})

    def turns(self, views: int) -> list[float]:
        """Degrees about the vertical from the first view to each: all round, or along the arc."""
        if self.parts & _ARCED:
            return _along(self.arc, views)
        return [360.0 * index / views for index in range(views)]


def arrange(
    settings: SceneSettings,
    body: Body,
    poses: Sequence[Pose],
    size: float,
    neighbour: "trimesh.Trimesh | None",
    rng: np.random.Generator,
) -> tuple[dict[str, Body], list[Pose]]:
    """Put everything else about the object ``body`` at the origin, ``size`` large.

    ``poses`` are left cameras as drawn for an object alone; ``neighbour`` is another mesh about its
    own origin, whose turn about z and side are drawn.

    Returns:
        The bodies by name, the object first (then neighbour, table, wall, floor); and the views.
    """
    if settings.needs_neighbour != (neighbour is not None):
        wanted = "has no neighbour" if neighbour else "needs a neighbour: name its mesh (neighbour)"
        raise InputError(f"scene: layout {settings.layout!r} {wanted}")
    parts = settings.parts
    if parts & _ARCED:
        poses = _on_arc(poses, np.radians(settings.arc))
    bodies = {"object": body}
    front, up = _front(poses[0]), np.array([0.0, 0.0, 1.0])
    across = np.array([-front[1], front[0], 0.0])
    half = settings.extent * size / 2
    base = float(body.mesh.vertices[:, 2].min())
    ground = base - _LIFT * size
    if neighbour is not None:
        turn, side = rng.uniform(0, 2 * np.pi), rng.choice([-1.0, 1.0])
        turned = neighbour.copy()
        turned.vertices = turned.vertices @ rotation_z(turn).T
        gap = settings.neighbour_gap * size
        if "behind" in parts:
            turned.vertices += _before(body.mesh, turned, poses[0], side, gap, settings.cover)
        else:  # on the same ground
            shift = side * across * _apart(body.mesh, turned, side * across, gap)
            shift[2] = base - turned.vertices[:, 2].min()
            turned.vertices += shift
        if "floor" in parts:
            turned.vertices[:, 2] += max(0.0, ground - turned.vertices[:, 2].min())
        bodies["neighbour"] = Body(turned, settings.neighbour or body.material)
    if "table" in parts:
        top = _table_top([b.mesh for b in bodies.values()], front, across)
        top.vertices += up * ground
        bodies["table"] = Body(top, settings.floor)
        ground -= settings.table_height
    if "wall" in parts:
        reach = max(float((b.mesh.vertices @ -front).max()) for b in bodies.values())
        centre = -front * (reach + settings.wall_gap * size)
        if "floor" in parts:  # it stands on the floor
            centre = centre + up * (ground + half)
        bodies["wall"] = Body(rectangle(centre, across * half, up * half), settings.wall)
    if "floor" in parts:
        bodies["floor"] = Body(rectangle(up * ground, front * half, across * half), settings.floor)
    return bodies, list(poses)


def _on_arc(poses: Sequence[Pose], arc: float) -> list[Pose]:
    azimuths = [math.atan2(pose.position[1], pose.position[0]) for pose in poses]
    spread = max(abs(math.remainder(a - azimuths[0], 2 * math.pi)) for a in azimuths)
    if spread <= arc / 2 + 1e-9:  # copies of one pose stay as they are
        return list(poses)
    turned = []
    for pose, azimuth, offset in zip(poses, azimuths, _along(arc, len(poses)), strict=True):
        matrix, rotation = pose.camera_to_world.copy(), rotation_z(azimuths[0] + offset - azimuth)
        matrix[:3] = rotation @ matrix[:3]
        turned.append(Pose(matrix))
    return turned


def _along(arc: float, count: int) -> list[float]:
    step = arc / count
    return [step * ((index + 1) // 2) * (1 if index % 2 else -1) for index in range(count)]


def _front(pose: Pose) -> Float[np.ndarray, "3"]:
    """Horizontal direction from the object to the camera; from above, the image's downward one."""
    front = np.array([*pose.position[:2], 0.0])
    if np.linalg.norm(front) < 1e-3 * np.linalg.norm(pose.position):
        front = np.array([*pose.camera_to_world[:2, 1], 0.0])
    return front / np.linalg.norm(front)


def _apart(
    mesh: "trimesh.Trimesh", other: "trimesh.Trimesh", along: Float[np.ndarray, "3"], gap: float
) -> float:
    return float((mesh.vertices @ along).max() - (other.vertices @ along).min()) + gap


def _before(
    mesh: "trimesh.Trimesh",
    other: "trimesh.Trimesh",
    pose: Pose,
    side: float,
    gap: float,
    cover: float,
) -> Float[np.ndarray, "3"]:
    """Place on the line of sight of ``pose``, moved aside until the wanted share is covered.

    NOTE: it hovers there. A neighbour of the object's height that stood on the ground would hide
    nothing from a camera that looks down by more than some 40°.
    """
    from qs3.sensor.light.raycast import DepthCaster

    sight = pose.position / np.linalg.norm(pose.position)
    shift = sight * _apart(mesh, other, sight, gap)
    if float(((other.vertices + shift) @ sight).max()) >= np.linalg.norm(pose.position):
        raise InputError(
            "scene: no room for a neighbour between the first view's camera and the object; give "
            "placement a larger radius, or make the neighbour smaller (neighbour_size)"
        )
    x, y, z = transform_points(invert_rigid(pose.camera_to_world), np.asarray(mesh.vertices)).T
    reach = float(np.abs([x / z, y / z]).max())
    rig = StereoRig(width=_SURVEY, height=_SURVEY, focal=_SURVEY / 2 / reach)
    seen = DepthCaster(mesh).cast(rig, pose, rig.full_frame).mask
    moved = other.copy()
    moved.vertices = moved.vertices + shift
    caster, along = DepthCaster(moved), pose.camera_to_world[:3, 0]
    # Far enough to be clear of the object, then inwards until both are in line.
    width = float(np.ptp((moved.vertices - pose.position) @ along))
    best, error = 0.0, math.inf
    for offset in side * np.linspace(width / 2 + reach * float(z.max()), 0.0, _STEPS):
        # The neighbour moved to the right looks as from a camera moved to the left.
        hidden = caster.cast(rig, pose.shifted(-offset), rig.full_frame).mask & seen
        miss = abs(float(hidden.sum()) / max(int(seen.sum()), 1) - cover)
        if miss < error:
            best, error = float(offset), miss
    return shift + along * best


def _table_top(
    meshes: "Sequence[trimesh.Trimesh]",
    front: Float[np.ndarray, "3"],
    across: Float[np.ndarray, "3"],
) -> "trimesh.Trimesh":
    import trimesh

    axes = np.stack([front, across])
    points = np.concatenate([mesh.vertices for mesh in meshes]) @ axes.T
    low, high = points.min(axis=0) - _RIM, points.max(axis=0) + _RIM
    sides = np.maximum(high - low, _TABLE[:2])
    slab = trimesh.creation.box((*sides, _TABLE[2]))
    corners = np.asarray(slab.vertices) + np.append((low + high) / 2, -_TABLE[2] / 2)
    turned = corners[:, :2] @ axes + corners[:, 2:] * [0.0, 0.0, 1.0]
    return trimesh.Trimesh(vertices=turned, faces=slab.faces, process=False)


def rectangle(
    centre: Float[np.ndarray, "3"], a: Float[np.ndarray, "3"], b: Float[np.ndarray, "3"]
) -> "trimesh.Trimesh":
    """A rectangle of two triangles with half its sides a and b, its normal along a × b."""
    import trimesh

    corners = np.array([centre - a - b, centre + a - b, centre + a + b, centre - a + b])
    return trimesh.Trimesh(vertices=corners, faces=[[0, 1, 2], [0, 2, 3]], process=False)
