"""Parts that lie on the table: low ones are seen, none is under it, and votes find their poses."""

import numpy as np
import pytest
import trimesh

from qs3.evaluation.poses import adds
from qs3.frames.camera_files import read_intrinsics
from qs3.objects.segment import SegmentSettings
from qs3.parts import Library, find
from qs3.parts.scenes import lying as room
from qs3.parts.scenes import searching
from qs3.parts.scenes.lying import lying
from qs3.parts.scenes.picture import Picture, picture_of
from qs3.parts.scenes.verifying import verify

from ...stores import view_once
from .tables import INTRINSICS, PARTS, lain, shoot

CAMERA = read_intrinsics(INTRINSICS)
DISCS = {f"disc{h}": trimesh.creation.cylinder(0.016, h / 1000) for h in (8, 13, 18)}
"""Metres: discs of one diameter, and of these heights in millimetres."""


@pytest.fixture(autouse=True)
def discs(monkeypatch) -> None:
    for name, mesh in DISCS.items():
        monkeypatch.setitem(PARTS, name, mesh)


def cut(depth: np.ndarray) -> Picture:
    return picture_of(depth, CAMERA, SegmentSettings(gap=0.01, min_points=40))


def library(*names: str) -> Library:
    return Library(tuple(view_once(PARTS[name], 1.0, name, name) for name in names))


@pytest.mark.parametrize("seed", range(3))
def test_a_part_as_low_as_the_noise_of_the_table_is_cut_out(seed) -> None:
    """Its top lies at four standard deviations: hardly a pixel is surely off the table, but all."""
    placed = lain("disc8", 0.0, 0.0)
    noise = 0.0022
    depth = shoot(placed, noise=noise, seed=seed).depth
    top = shoot(noise=0).depth - shoot(placed, noise=0).depth > 0.007
    picture = cut(depth)
    assert top.sum() > 300
    assert (picture.cluster[top] >= 0).mean() > 0.85
    assert picture.clusters == 1
    assert cut(shoot(noise=noise, seed=seed).depth).clusters == 0


def test_height_on_the_table_is_measured_and_costs() -> None:
    """A part lies on the table; under it or over it by millimetres costs, under it costs more."""
    shot = shoot(lain("block", 0.0, 0.0))
    picture, (part,) = cut(shot.depth), library("block")
    (pose,) = shot.poses
    up = np.linalg.inv(shot.camera)[:3, 2]
    poses = np.tile(pose, (3, 1, 1))
    poses[:, :3, 3] += np.outer((-0.0025, 0, 0.0025), up)
    under, on, over = (verify(picture, part, one) for one in poses)
    np.testing.assert_allclose([under.low, on.low, over.low], [-0.0025, 0, 0.0025], atol=6e-4)
    costs = [h.gains.sum() - h.value - h.refuted - 0.25 * h.unknown - 0.1 * h.hidden
             - 0.5 * h.continued * h.area for h in (under, on, over)]  # fmt: skip
    assert costs[0] > 2 * costs[2] > 10 * abs(costs[1])


@pytest.mark.parametrize("name", ["disc13", "disc18"])
@pytest.mark.parametrize("seed", range(2))
def test_parts_of_one_outline_are_told_apart_by_their_height(name, seed) -> None:
    """The table bears them: the other disc would lie in it, or over it."""
    shot = shoot(lain(name, 0.05, 0.02), noise=0.0015, seed=seed)
    (part,) = find(library("disc13", "disc18"), shot.depth, CAMERA).parts
    assert part.class_name == name


@pytest.mark.parametrize("name", ["bracket", "pin", "block"])
@pytest.mark.parametrize("degrees", [10, 130])
def test_votes_find_a_part_that_touches_another(name, degrees, monkeypatch) -> None:
    """The pairs of points are not asked."""
    monkeypatch.setattr(searching, "propose_all", lambda *args: [])
    shot = shoot(lain(name, 0.0, 0.0, degrees), lain("block", 0.082, 0.0, 20))
    known = library(*{name, "block"})
    found = find(known, shot.depth, CAMERA).parts
    assert sorted(part.class_name for part in found) == sorted(shot.names)
    points = {part.cad: part.points for part in known}
    for true, pose in zip(shot.names, shot.poses, strict=True):
        errors = [adds(one.pose, pose, points[true]) for one in found if one.class_name == true]
        assert min(errors) < 0.002


def test_no_point_has_no_pose() -> None:
    shot = shoot(lain("block", 0.0, 0.0))
    picture, (part,) = cut(shot.depth), library("block")
    few = np.zeros((1, 3), np.float32)
    assert picture.camera_from_table is not None
    for points in (few + 9, few[:0]):
        turns, shifts = lying(part, points, points, picture.camera_from_table, 0.001, 24, 1.0)
        assert len(turns) == len(shifts) == 0


def test_small_parts_tile_no_foreign_thing(monkeypatch) -> None:
    """Each of many blocks along a slab's edge would explain what its neighbours are joined to."""
    monkeypatch.setitem(PARTS, "slab", trimesh.creation.box((0.12, 0.08, 0.03)))
    monkeypatch.setitem(PARTS, "crumb", trimesh.creation.box((0.02, 0.014, 0.008)))
    shot = shoot(lain("slab", -0.05, 0.0), lain("crumb", 0.12, 0.0))
    found = find(library("crumb"), shot.depth, CAMERA)
    (part,) = found.parts
    assert np.linalg.norm(part.pose[:3, 3] - shot.poses[1][:3, 3]) < 0.005
    assert len(found.unexplained) == 1


@pytest.mark.parametrize("away", [0.0, 1.0, 40.0])
def test_the_votes_of_a_cluster_as_large_as_a_hall_fit_into_memory(monkeypatch, away) -> None:
    shot = shoot(lain("block", 0.0, 0.0))
    picture, (part,) = cut(shot.depth), library("block")
    way = picture.camera_from_table
    assert way is not None
    far = (way @ (away, away, 0.0, 1.0))[None, :3]
    points = np.concatenate([picture.points(picture.cluster == 0), far]).astype(np.float32)
    boards, vote = [], room._voted

    def voted(*arguments):
        boards.append(vote(*arguments))
        return boards[-1]

    monkeypatch.setattr(room, "_voted", voted)
    level = np.tile(way[:3, 2].astype(np.float32), (len(points), 1))
    turns, _ = room.lying(part, points, level, way, 0.001, 24, 1.0)
    assert len(turns)
    assert max(board.nbytes for board in boards) < 10e6
