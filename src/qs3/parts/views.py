"""A part as a camera sees it: points and normals of its outer surface, and views from all around.

Lengths are in metres and in the axes of the part's file as it stands on disk.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from qs3.meshes.normalising import sample_triangles
from qs3.meshes.simplifying import with_fewer_faces
from qs3.parts.field import Field, field_of
from qs3.parts.resting import resting_directions
from qs3.parts.symmetry import Symmetry, find_symmetry
from qs3.parts.visible import VIEWS, WIDE, directions, even_turns, frame_of, visible

if TYPE_CHECKING:
    import trimesh

SEEN = 160
"""Points of each view."""
LOOKED, _GLANCED = 96, 64
"""Those of them that an alignment looks at first, and those that judge a pose by a field."""
_DRAWN, _KEPT = 80_000, 9000
"""Random points of the surface, and about how many even ones are made of them."""
DISTANCE, _NEAREST = 0.6, 2.5
"""Metres from the camera of a view to the part, and the least in diameters of the part."""
_TWICE = 2
"""Views that see a point of the outer surface, at least: holes between points show some once."""
_TURNS = 36
"""Turns about the vertical of each pose on a table."""
_LEVEL, _ANY = 0.25, 0.1
"""Sine of the elevation from which on cameras look at parts on a table, and the share of parts that
do not lie as they fall."""
_CELLS = 256
"""Cells along the longest side of a large mesh, whose poses on a table are found so."""
_DEEP = 1.5
"""Standard deviations of the points of a view across the line of sight that those along it are."""
_MARGIN = 0.25
"""Margin of the field of distances in diameters."""


@dataclass(frozen=True, eq=False)
class Part:
    """One CAD file."""

    class_name: str
    cad: str
    """Id of the file in its folder."""
    scale: float
    """Metres of one unit of the file."""
    points: Float32[np.ndarray, "n 3"]
    """Even points of the surface that some camera sees."""
    normals: Float32[np.ndarray, "n 3"]
    spacing: float
    seen: Int32[np.ndarray, "v s"]
    """Points of each view, drawn evenly over its image."""
    cells: Int32[np.ndarray, "v"]
    """Cells that each view fills."""
    resting: Float32[np.ndarray, "r 3"]
    """Unit vectors that can point down when the part lies on a table."""
    likely: Float32[np.ndarray, "r"]
    """How often the part comes to lie so: shares."""
    symmetry: Symmetry
    times: float = 1.0
    """How many times larger it is than the file."""
    beyond: bool = False
    """Whether the parts of its class differ from the file by more than the tolerance."""
    file: "Part | None" = None
    """The part as large as the file, if it differs."""
    digest: str = ""
    """Checksum of the file (`qs3.store.manifest.mesh_sums`); empty if it is not known."""
    shape: str = ""
    """Checksum of the vertices, whatever the format of the file."""

    def scaled(self, times: float, beyond: bool = False) -> "Part":
        """Return the part, so many times larger than the file, about the origin of the file."""
        part = self if self.file is None else self.file
        if times == 1 and not beyond:
            return part
        symmetry = replace(part.symmetry, middle=part.symmetry.middle * times)
        points = part.points if times == 1 else part.points * np.float32(times)
        return replace(part, points=points, spacing=part.spacing * times, symmetry=symmetry,
                       times=times, beyond=beyond, file=part)  # fmt: skip

    @cached_property
    def middle(self) -> Float[np.ndarray, "3"]:
        """Middle of the box around the part."""
        low, high = self.points.min(axis=0), self.points.max(axis=0)
        return (low.astype(np.float64) + high) / 2

    @cached_property
    def corners(self) -> Float32[np.ndarray, "c 3"]:
        """The farthest points in many directions: one of them touches the table."""
        points = np.ascontiguousarray(self.points.T)
        # einsum, as threads of BLAS spend ten times the time on this product.
        far = [np.einsum("dk,kn->dn", some, points).argmax(axis=1)
               for some in np.split(directions(512).astype(np.float32), 8)]  # fmt: skip
        return self.points[np.unique(far)]

    @cached_property
    def diameter(self) -> float:
        """Diameter of the ball about the middle that holds the part."""
        return 2 * float(np.linalg.norm(self.points - self.middle, axis=1).max())

    @property
    def away(self) -> float:
        """Metres from the part to the camera of its views, and of a scan without a known one."""
        return max(DISTANCE, _NEAREST * self.diameter)

    @cached_property
    def lain(self) -> tuple[Float[np.ndarray, "h 3 3"], Float[np.ndarray, "h"]]:
        """Rotations that lay the part on a table, at each turn, and its origin's heights there."""
        flip = np.diag([1.0, -1.0, -1.0])  # z down
        lain = [flip @ frame_of(down).T for down in self.resting.astype(np.float64)]
        heights = (self.corners @ self.resting.T).max(axis=0).astype(np.float64)
        rotations = even_turns(_TURNS) @ np.reshape(lain, (-1, 1, 3, 3))
        return rotations.reshape(-1, 3, 3), heights.repeat(_TURNS)

    def odds(self, way: Float[np.ndarray, "3"]) -> float:
        """Return how much likelier a camera stands there than anywhere: a density on the sphere.

        Args:
            way: Unit vector to the camera, in the axes of the part.

        A part lies on something, as it falls, and the camera looks down on it, from `_LEVEL` on; or
        the part stands in any pose: `_ANY` of the cases.
        """
        if not len(self.resting):
            return 1.0
        up = np.clip((-(self.resting @ way) - _LEVEL) / _LEVEL + 0.5, 0, 1)
        return float(_ANY + (1 - _ANY) * 2 / (1 - _LEVEL) * (self.likely @ up))

    @cached_property
    def field(self) -> Field:
        """Distances around the part."""
        return field_of(self.points, _MARGIN * self.diameter)

    def gap(self, cells: int, kept: int) -> float:
        """Return the spacing of some points of a view: the root of the area of each."""
        return WIDE * self.spacing * float(np.sqrt(max(cells / kept, 1.0)))

    @cached_property
    def gaps(self) -> Float[np.ndarray, "v"]:
        """Spacing of the first `LOOKED` points of each view."""
        return np.array([self.gap(int(cells), LOOKED) for cells in self.cells])

    @cached_property
    def looks(self) -> Float32[np.ndarray, "v 3 few"]:
        """The first points of each view, as three rows, which loops over points read in order."""
        return np.ascontiguousarray(self.points[self.seen[:, :_GLANCED]].transpose(0, 2, 1))

    @cached_property
    def is_deep(self) -> Bool[np.ndarray, "v"]:
        """Whether a view is deeper than wide, as that of a rod from its end."""
        points = self.points[self.seen].astype(np.float64)
        depth = np.einsum("vsi,vi->vs", points, directions(VIEWS)).var(axis=1)
        return depth > _DEEP**2 / 2 * (points.var(axis=1).sum(axis=1) - depth)

    @cached_property
    def means(self) -> Float[np.ndarray, "v 3"]:
        """Mean point of each view."""
        return self.points[self.seen].astype(np.float64).mean(axis=1)

    @cached_property
    def fronts(self) -> Float[np.ndarray, "v 3"]:
        """`front_of` the points of each view."""
        points = self.points[self.seen].astype(np.float64)
        return front_of(points, directions(VIEWS))


def front_of(
    points: Float[np.ndarray, "*b n 3"], sight: Float[np.ndarray, "*b 3"]
) -> Float[np.ndarray, "*b 3"]:
    """Return the mean of points, but as near to the camera as the nearer half of them.

    Cameras see little of sides that recede, and the mean moves by what is missing.
    """
    mean, depth = points.mean(axis=-2), np.einsum("...ni,...i->...n", points, sight)
    near = np.sort(depth, axis=-1)[..., depth.shape[-1] // 2 :].mean(axis=-1)
    return mean + (near - (mean * sight).sum(axis=-1))[..., None] * sight


def view_of(mesh: "trimesh.Trimesh", scale: float, class_name: str, cad: str) -> Part:
    """Return what cameras see of a mesh; ``scale`` is the length of its unit in metres."""
    rng = np.random.default_rng(0)
    triangles = _triangles(mesh, scale)
    dense = sample_triangles(triangles, _DRAWN, rng)
    points, normals, spacing = _even(*dense, triangles)
    middle = (points.min(axis=0) + points.max(axis=0)).astype(np.float64) / 2
    radius = float(np.linalg.norm(points - middle, axis=1).max())
    away = max(DISTANCE, 2 * radius * _NEAREST)
    looks = [visible(points, spacing, middle + away * way, middle) for way in directions(VIEWS)]
    outer = np.bincount(np.concatenate(looks), minlength=len(points)) >= _TWICE
    if min(outer[look].sum() for look in looks) == 0:
        outer[:] = True
    number = np.cumsum(outer, dtype=np.int32) - np.int32(1)
    seen = np.stack([number[_drawn(look[outer[look]], rng)] for look in looks])
    lying = resting_directions(_triangles(with_fewer_faces(mesh, _CELLS), scale))
    cells = np.array([len(look) for look in looks], dtype=np.int32)
    points, normals = points[outer], normals[outer]
    field = field_of(points, _MARGIN * 2 * radius)
    symmetry = find_symmetry(points, normals, spacing, dense, field, 2 * radius)
    return Part(class_name, cad, scale, points, normals, spacing, seen, cells, *lying, symmetry)


def _triangles(mesh: "trimesh.Trimesh", scale: float) -> Float[np.ndarray, "f 3 3"]:
    return np.asarray(mesh.vertices, dtype=np.float64)[np.asarray(mesh.faces)] * scale


def _even(
    points: Float[np.ndarray, "d 3"],
    normals: Float[np.ndarray, "d 3"],
    triangles: Float[np.ndarray, "f 3 3"],
) -> tuple[Float32[np.ndarray, "n 3"], Float32[np.ndarray, "n 3"], float]:
    """Return points spread evenly over the surface, with normals, and their spacing.

    One is kept in each cube and of each direction of the normal, so that both sides of a sheet have
    points.
    """
    cross = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    spacing = float(np.sqrt(np.linalg.norm(cross, axis=1).sum() / 2 / _KEPT))
    cube = np.floor((points - points.min(axis=0)) / spacing).astype(np.int64)
    side = np.abs(normals).argmax(axis=1)
    side = 2 * side + (np.take_along_axis(normals, side[:, None], axis=1)[:, 0] > 0)
    wide = cube.max(axis=0) + 1
    key = ((cube[:, 0] * wide[1] + cube[:, 1]) * wide[2] + cube[:, 2]) * 6 + side
    kept = np.unique(key, return_index=True)[1]
    return points[kept].astype(np.float32), normals[kept].astype(np.float32), spacing


def _drawn(look: Int32[np.ndarray, "m"], rng: np.random.Generator) -> Int32[np.ndarray, "s"]:
    """Return as many points of a view as all views have, in random order."""
    order = rng.permutation(look)
    return np.resize(order, SEEN)
