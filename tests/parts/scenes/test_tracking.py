"""From frame to frame: parts are refined from their last poses, and their poses do not flip."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from trimesh.transformations import rotation_matrix, translation_matrix

from qs3.evaluation.poses import adds
from qs3.frames.camera_files import read_intrinsics
from qs3.geometry import invert_rigid
from qs3.parts import Library, find
from qs3.parts.scenes import answering, finding, searching

from ...objects.depth_scene import looking_down, photograph
from ...stores import view_once
from .tables import INTRINSICS, MATRIX, PARTS, SHAPE, lain, shoot, solid

CAMERA = read_intrinsics(INTRINSICS)


@pytest.fixture
def searches(monkeypatch):
    """Masks of all searches from here on."""
    masks, explained = [], searching._explained

    def counted(library, picture, mask, settings):
        masks.append(mask)
        return explained(library, picture, mask, settings)

    monkeypatch.setattr(searching, "_explained", counted)
    return masks


def turned(one: np.ndarray, other: np.ndarray) -> float:
    """Return the angle between two poses in degrees."""
    cosine = (np.trace(one[:3, :3].T @ other[:3, :3]) - 1) / 2
    return float(np.degrees(np.arccos(np.clip(cosine, -1, 1))))


def test_a_part_that_comes_is_found_and_one_that_goes_is_gone(library, searches) -> None:
    block, pin = lain("block", 0.1, 0.0, 70), lain("pin", -0.05, 0.05)
    found = find(library, shoot(block).depth, CAMERA)
    searches.clear()
    found = find(library, shoot(block, pin, seed=1).depth, CAMERA, before=found)
    assert sorted(part.class_name for part in found.parts) == ["block", "pin"]
    part = next(part for part in found.parts if part.class_name == "block")
    assert 0 < sum(int(mask.sum()) for mask in searches) < part.points  # the pin's pixels alone
    searches.clear()
    found = find(library, shoot(pin, seed=2).depth, CAMERA, before=found)
    assert [part.class_name for part in found.parts] == ["pin"]
    assert searches == []


def test_a_part_that_jumps_is_searched_again(library) -> None:
    found = find(library, shoot(lain("bracket", -0.1, 0.0, 20)).depth, CAMERA)
    shot = shoot(lain("bracket", 0.1, 0.05, 160), seed=1)
    (part,) = find(library, shot.depth, CAMERA, before=found).parts
    assert adds(part.pose, shot.poses[0], np.asarray(PARTS["bracket"].vertices)) < 0.002


def test_a_foreign_object_is_searched_once(library, searches) -> None:
    def of(seed: int):
        return shoot(lain("block", 0.1, 0.0, 70), lain("ball", -0.06, 0.0), seed=seed).depth

    found = find(library, of(0), CAMERA)
    searches.clear()
    for seed in (1, 2):
        found = find(library, of(seed), CAMERA, before=found)
        assert [part.class_name for part in found.parts] == ["block"]
        assert len(found.unexplained) == 1
    assert searches == []


@pytest.mark.parametrize(("score", "doubted"), [(0.49, True), (0.26, True), (0.24, False)])
def test_a_part_that_is_nearly_sure_is_searched_again_on_a_still_table(
    library, searches, monkeypatch, score, doubted
) -> None:
    """The noise of the first frame decides nothing for those after it."""
    first, second = (
        shoot(lain("block", 0.1, 0.0, 70), lain("pin", -0.05, 0.05), seed=seed) for seed in (0, 1)
    )
    plain = answering.confidence

    def doubts(h, *more):
        return score if h.part.class_name == "pin" else plain(h, *more)

    with monkeypatch.context() as patched:
        patched.setattr(answering, "confidence", doubts)
        found = find(library, first.depth, CAMERA)
    assert [part.class_name for part in found.parts] == ["block"]
    assert any(rest.doubted for rest in found.unexplained) == doubted
    searches.clear()
    after = find(library, second.depth, CAMERA, before=found)
    assert bool(searches) == doubted
    assert sorted(part.class_name for part in after.parts) == ["block", "pin"][: 1 + doubted]


def test_an_empty_tray_is_searched_as_a_side_of_a_part_once(library, monkeypatch) -> None:
    """It is smaller than a part; what lies higher on it is another plane."""
    bare, plain = [], finding.picture_of

    def counted(*args, table=True):
        bare.append(not table)
        return plain(*args, table=table)

    monkeypatch.setattr(finding, "picture_of", counted)
    found, (v, u) = None, np.mgrid[-120:120, -160:160]
    for seed, height, searches in ((0, 0.0, 1), (1, 0.0, 0), (2, 0.02, 1)):
        depth = np.where(np.hypot(v, u) < 26, shoot(seed=seed).depth - np.float32(height), 0)
        found = find(library.only(["bracket"]), depth, CAMERA, before=found)
        assert not found.parts
        assert sum(bare) == searches
        bare.clear()


@pytest.mark.parametrize(("first", "known"), [("plate+pin", ["pin"]), ("disc", [])])
def test_a_part_that_is_its_own_table_is_found_after_another_scene(first, known) -> None:
    """While a pin lies on it, a plate is its table; a foreign disc is as high."""
    plate = solid(
        trimesh.creation.box((0.16, 0.11, 0.012)),
        trimesh.creation.box((0.02, 0.11, 0.03)).apply_translation((0.07, 0, -0.015)),
    )
    pin = PARTS["pin"].copy().apply_transform(rotation_matrix(np.pi / 2, (0, 1, 0)))
    pin.apply_translation((-0.01, 0, 0.026))
    things = {"plate": plate, "pin": pin, "disc": trimesh.creation.cylinder(0.05, 0.012)}
    meshes = {"plate": plate, "pin": PARTS["pin"]}
    library = Library(tuple(view_once(mesh, 1.0, name, name) for name, mesh in meshes.items()))
    found, seen, camera = None, [], looking_down(75.0, (0.0, -0.1, 0.42))
    for seed, names in enumerate([first, "plate"]):
        shown = solid(*(things[name] for name in names.split("+")))
        depth, _ = photograph(shown, camera, MATRIX, SHAPE)
        depth += (depth > 0) * np.random.default_rng(seed).normal(scale=0.0005, size=SHAPE)
        found = find(library, depth.astype(np.float32), CAMERA, before=found)
        seen.append([part.class_name for part in found.parts])
    assert seen == [known, ["plate"]]


def test_of_equal_poses_it_is_the_one_nearest_to_the_last(library) -> None:
    shot = shoot(lain("block", 0.05, 0.0, 30))
    found = find(library, shot.depth, CAMERA)
    (part,) = found.parts
    for equal in part.symmetry.equals():
        pose = part.pose @ equal
        pose[:3, :3] *= 1 + 1e-6  # rounding, which must not grow from frame to frame
        last = replace(found, parts=(replace(part, pose=pose),))
        (after,) = find(library, shot.depth, CAMERA, before=last).parts
        assert turned(after.pose, last.parts[0].pose) < 5
        turn = after.pose[:3, :3]
        np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-12)


def test_the_whole_table_may_move(library, searches) -> None:
    """As of a camera that is pushed: the same shift for all parts."""
    shot = shoot(lain("bracket", -0.1, 0.0, 20), lain("block", 0.1, 0.0, 70))
    push = translation_matrix((0.004, 0.0, 0.0)) @ rotation_matrix(0.01, (0, 0, 1))
    found = find(library, shot.depth, CAMERA)
    pushed = replace(found, parts=tuple(replace(p, pose=push @ p.pose) for p in found.parts))
    searches.clear()
    again = find(library, shot.depth, CAMERA, before=pushed)
    by_name = {part.class_name: part for part in again.parts}
    assert len(by_name) == len(found.parts) == 2
    for one in found.parts:
        other = by_name[one.class_name]
        assert np.abs((invert_rigid(one.pose) @ other.pose)[:3, 3]).max() < 0.002
    assert searches == []


@pytest.mark.parametrize("step", [0.0, 0.002])
def test_poses_do_not_jump_over_many_frames_that_need_no_search(library, searches, step) -> None:
    """On a table that stands still, and while the parts move; each frame has its own noise."""
    found, last = None, {}
    for k in range(8):
        shot = shoot(lain("bracket", -0.1 + step * k, 0.0, 20 + 500 * step * k),
                     lain("pin", 0.0, 0.06 - step * k), lain("block", 0.1, step * k, 70),
                     noise=0.001, seed=k)  # fmt: skip
        found = find(library, shot.depth, CAMERA, before=found)
        assert bool(searches) == (k == 0)
        searches.clear()
        by_name = {part.class_name: part.pose for part in found.parts}
        assert len(found.parts) == len(by_name) == 3
        for name, true in zip(shot.names, shot.poses, strict=True):
            assert adds(by_name[name], true, np.asarray(PARTS[name].vertices)) < 0.003
            if last:
                moved = np.linalg.norm((by_name[name] - last[name])[:3, 3])
                assert moved < 0.002 + step
                assert turned(by_name[name], last[name]) < 6 + 500 * step
        last = by_name
