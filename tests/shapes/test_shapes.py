"""Laws that every procedural object keeps."""

from collections.abc import Callable

import numpy as np
import pytest
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import ConvexHull
from trimesh.ray.ray_pyembree import RayMeshIntersector

from qs3 import shapes
from qs3.errors import InputError
from qs3.meshes import collect
from qs3.shapes._dice import Dice
from qs3.shapes._solids import Solid, assemble, ball, block

FAMILIES = [(name, family) for name in shapes.CLASSES for family in shapes.families(name)]

# Least and greatest longest side and height in metres, from furniture catalogues, with some room.
SIZES = {
    "bathtub": ((1.1, 2.4), (0.4, 1.2)),
    "bed": ((1.15, 3.1), (0.25, 2.4)),
    "bookshelf": ((0.3, 2.6), (0.1, 2.6)),
    "cabinet": ((0.36, 3.2), (0.25, 2.5)),
    "chair": ((0.29, 1.7), (0.28, 1.45)),
    "lamp": ((0.15, 2.2), (0.03, 2.2)),
    "monitor": ((0.24, 1.8), (0.15, 1.6)),
    "plant": ((0.1, 2.3), (0.08, 2.3)),
    "sofa": ((0.9, 4.6), (0.4, 1.3)),
    "table": ((0.3, 3.8), (0.25, 1.3)),
}
# These hang, or owe their balance to a foot or pot that is heavier than its surface tells.
NOT_BALANCED = {
    ("bookshelf", "ladder"),
    ("lamp", "arc"),
    ("lamp", "desk_arm"),
    *(("plant", family) for family in shapes.families("plant")),
    ("bookshelf", "wall_board"),
    ("lamp", "ceiling"),
    ("lamp", "chandelier"),
    ("lamp", "pendant"),
    ("monitor", "wall"),
}


def solids(mesh: trimesh.Trimesh) -> np.ndarray:
    """Index of the solid (connected by shared vertices) that each vertex belongs to."""
    edges = mesh.edges
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(len(mesh.vertices),) * 2)
    return connected_components(graph, directed=False)[1]


def touching_groups(mesh: trimesh.Trimesh, reach: float = 5e-4) -> int:
    """Number of groups of solids that touch, overlap or contain each other.

    Two solids whose surfaces cross have an edge of the one that pierces a face of the other; so
    every edge, made longer by ``reach`` at both ends, is cast as a ray against the whole mesh.
    A solid wholly inside another has its vertices within it, told by the parity of a ray.
    """
    solid = solids(mesh)
    count = int(solid.max()) + 1
    if count == 1:
        return 1
    caster = RayMeshIntersector(mesh)
    edges = mesh.edges_unique
    start, end = mesh.vertices[edges[:, 0]], mesh.vertices[edges[:, 1]]
    length = np.linalg.norm(end - start, axis=1)
    keep = length > 1e-9
    edges, start, length = edges[keep], start[keep], length[keep]
    ahead = (end[keep] - start) / length[:, None]
    start = start - reach * ahead
    face, ray, place = caster.intersects_id(
        start, ahead, multiple_hits=True, return_locations=True, max_hits=60
    )
    near = np.linalg.norm(place - start[ray], axis=1) <= length[ray] + 2 * reach
    pairs = [(solid[edges[ray[near], 0]], solid[mesh.faces[face[near], 0]])]
    first = np.unique(solid, return_index=True)[1]
    up = np.broadcast_to([0.123, 0.077, 0.989], (count, 3))
    face, ray, _ = caster.intersects_id(
        mesh.vertices[first] + 1e-7, up, multiple_hits=True, return_locations=True, max_hits=60
    )
    table = np.zeros((count, count), dtype=int)
    np.add.at(table, (ray, solid[mesh.faces[face, 0]]), 1)
    inside = (table % 2 == 1) & ~np.eye(count, dtype=bool)
    pairs.append(np.nonzero(inside))
    rows, columns = (np.concatenate([pair[i] for pair in pairs]) for i in range(2))
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    return connected_components(graph, directed=False)[0]


def check(name: str, family: str, seed: int) -> trimesh.Trimesh:
    mesh = shapes.make(name, seed, family)
    where = f"{name} {family} {seed}"
    assert np.isfinite(mesh.vertices).all(), where
    assert mesh.faces.min() >= 0 and mesh.faces.max() < len(mesh.vertices), where
    (short, long), (low, high) = SIZES[name]
    assert short <= mesh.extents.max() <= long, f"{where}: {mesh.extents}"
    assert low <= mesh.extents[2] <= high, f"{where}: {mesh.extents}"
    assert mesh.is_watertight, f"{where}: a sheet without thickness"
    assert (mesh.area_faces > 0).all(), where
    assert touching_groups(mesh) == 1, f"{where}: a part floats"
    if (name, family) not in NOT_BALANCED:
        ground = mesh.vertices[mesh.vertices[:, 2] < 0.012][:, :2]
        hull = ConvexHull(ground)
        centre = mesh.triangles_center * mesh.area_faces[:, None]
        balance = (centre.sum(axis=0) / mesh.area)[:2]
        outside = (hull.equations[:, :2] @ balance + hull.equations[:, 2]).max()
        assert outside < 0.02, f"{where}: it would tip over"
    return mesh


@pytest.mark.parametrize(("name", "family"), FAMILIES)
def test_objects_are_sound(name: str, family: str) -> None:
    extents = np.stack([check(name, family, seed).extents for seed in range(3)])
    assert (np.ptp(extents, axis=0) > 1e-3).all(), f"{name} {family}: draws of one size"


@pytest.mark.slow
@pytest.mark.parametrize(("name", "family"), FAMILIES)
def test_many_objects_are_sound(name: str, family: str) -> None:
    for seed in range(3, 40):
        check(name, family, seed)


def test_the_touching_law_can_fail() -> None:
    apart = [
        block((0, 1), (0, 1), (0, 1)),
        block((0, 1), (0, 1), (1.002, 2)),
        ball(0.1, (5.0, 0.0, 0.0)),
    ]
    assert touching_groups(assemble(apart)) == 3
    flush = [apart[0], block((0, 1), (0, 1), (1.0, 2))]
    assert touching_groups(assemble(flush)) == 1
    inside = [apart[0], ball(0.1, (0.5, 0.5, 0.5))]
    assert touching_groups(assemble(inside)) == 1


@pytest.mark.parametrize("name", shapes.CLASSES)
def test_same_seed_same_vertices_other_seed_other_vertices(name: str) -> None:
    first, again, other = (shapes.make(name, seed) for seed in (7, 7, 8))
    assert np.array_equal(first.vertices, again.vertices)
    assert np.array_equal(first.faces, again.faces)
    assert first.vertices.shape != other.vertices.shape or not np.allclose(
        first.vertices, other.vertices
    )


def test_draws_reach_every_family_and_none_is_rare(monkeypatch: pytest.MonkeyPatch) -> None:
    drawn = []

    def recorder(name: str) -> Callable[[Dice], list[Solid]]:
        def build(dice: Dice) -> list[Solid]:
            drawn.append(name)
            return [block((0, 1), (0, 1), (0, 1))]

        build.__name__ = name
        return build

    names = shapes.families("chair")
    monkeypatch.setitem(shapes._FAMILIES, "chair", tuple(map(recorder, names)))
    for seed in range(400):
        shapes.make("chair", seed)
    assert min(drawn.count(name) for name in names) > 0.4 * 400 / len(names)


def test_convention_stands_on_the_ground_and_faces_minus_y() -> None:
    for seed in range(10):
        chair = shapes.make("chair", seed, "four_legs")
        assert chair.bounds[0, 2] == 0.0
        np.testing.assert_allclose(chair.bounds[:, :2].sum(axis=0), 0.0, atol=1e-9)
        above = chair.triangles_center[:, 2] > 0.75 * chair.extents[2]
        assert chair.triangles_center[above, 1].mean() > 0  # the backrest is at the rear


def test_classes_are_pointda10() -> None:
    assert list(shapes.CLASSES) == sorted(shapes.CLASSES)
    assert len(shapes.CLASSES) == 10
    assert min(len(shapes.families(name)) for name in shapes.CLASSES) >= 3


def test_bad_requests_name_the_choices() -> None:
    with pytest.raises(InputError, match=r"choose one of bathtub, bed.*table"):
        shapes.make("piano")
    with pytest.raises(InputError, match="four_legs"):
        shapes.make("chair", family="throne")
    with pytest.raises(InputError, match="from 0 up"):
        shapes.make("chair", seed=-1)


def test_a_new_part_leaves_the_others_as_they_are(monkeypatch):
    names = (*shapes.PARTS, *shapes.CLASSES)
    before = {name: shapes.make(name, seed=3).vertices for name in names}
    drawn = collect("parts", per_class=2, seed=5) + collect("shapes", per_class=2, seed=5)
    (build,) = shapes._FAMILIES["bolt"]
    monkeypatch.setattr(shapes, "_FAMILIES", {"clamp": (build,), **shapes._FAMILIES})
    monkeypatch.setattr(shapes, "PARTS", ("clamp", *shapes.PARTS))
    monkeypatch.setattr(shapes, "_NAMES", ("clamp", *shapes._NAMES))
    for name in names:
        np.testing.assert_array_equal(shapes.make(name, seed=3).vertices, before[name])
    later = collect("parts", per_class=2, seed=5) + collect("shapes", per_class=2, seed=5)
    assert [item for item in later if item.class_name != "clamp"] == drawn
    assert len({item.shape_seed for item in later}) == len(later)


def test_a_new_family_takes_its_share_of_the_seeds_and_leaves_the_others(monkeypatch):
    def extra(dice):
        return shapes._FAMILIES["bolt"][0](dice)

    known = shapes._FAMILIES["lamp"]
    before = [shapes.make("lamp", seed=seed).vertices for seed in range(60)]
    monkeypatch.setitem(shapes._FAMILIES, "lamp", (extra, *known))
    after = [shapes.make("lamp", seed=seed).vertices for seed in range(60)]
    same = [np.array_equal(a, b) for a, b in zip(before, after, strict=True)]
    taken = [
        np.array_equal(a, shapes.make("lamp", s, "extra").vertices) for s, a in enumerate(after)
    ]
    assert np.logical_xor(same, taken).all()
    assert 0 < sum(taken) < 3 * 60 / (len(known) + 1)
