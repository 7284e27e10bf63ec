"""The score of a part: how sure it is, by what the picture says of it and of its rivals."""

from dataclasses import replace

import numpy as np
import pytest

from qs3.frames.camera_files import read_intrinsics
from qs3.objects.segment import SegmentSettings
from qs3.parts import FindSettings, Library, find
from qs3.parts.scenes.answering import answer_of
from qs3.parts.scenes.confidence import FEATURES, confidence, features, rival_of
from qs3.parts.scenes.picture import Picture, picture_of
from qs3.parts.scenes.proposing import Cluster, nudged
from qs3.parts.scenes.verifying import Hypothesis, bent, verify

from .tables import INTRINSICS, Shot, lain, shoot, smoothed

CAMERA = read_intrinsics(INTRINSICS)
SHOT = shoot(lain("block", 0.0, 0.0, 30), lain("pin", 0.1, 0.0))
AWAY = np.eye(4)
AWAY[0, 3] = 0.03


@pytest.fixture(scope="module")
def picture() -> Picture:
    return picture_of(SHOT.depth, CAMERA, SegmentSettings(gap=0.01, min_points=40))


@pytest.fixture(scope="module")
def block(library: Library, picture: Picture) -> Hypothesis:
    return held(library, picture, "block", SHOT.poses[0])


def held(library: Library, picture: Picture, name: str, pose: np.ndarray) -> Hypothesis:
    (part,) = (part for part in library if part.cad == name)
    return verify(picture, part, pose)


def odds(hypothesis: Hypothesis, picture: Picture) -> float:
    """Return how many times likelier a part is right than wrong."""
    p = confidence(hypothesis, [hypothesis], picture)
    return p / (1 - p)


def test_a_part_that_stands_alone_has_no_fault(picture: Picture, block: Hypothesis) -> None:
    values = dict(zip(FEATURES, features(block, [block], picture), strict=True))
    assert values.pop("bent") < 0.15
    assert max(values.values()) < 0.05
    assert confidence(block, [block], picture) > 0.95


@pytest.mark.parametrize("seed", range(3))
def test_a_camera_that_smooths_neither_bends_a_part_nor_goes_on_beyond_it(
    library: Library, seed: int
) -> None:
    """Its noise bends what it sees, and around a part it sees a ramp down to the table."""
    shot = shoot(lain("block", 0.0, 0.0, 70), noise=0, focal=600.0)
    camera = read_intrinsics("600,600,159.5,119.5")
    cutting = SegmentSettings(gap=0.01, min_points=40)
    picture = picture_of(smoothed(shot, seed), camera, cutting)
    hypothesis = held(library, picture, "block", shot.poses[0])
    assert hypothesis.continued < 0.15
    assert bent(hypothesis, picture) < 0.75 * bent(hypothesis, replace(picture, blur=0.0))


def test_a_part_that_is_unlikely_explains_nothing_beside_another(
    picture: Picture, block: Hypothesis
) -> None:
    """Else many that tile a foreign thing would vouch for each other."""
    joined = np.arange(block.outline // 4, dtype=np.int32)
    doubtful = replace(block, joined=joined)
    few = np.zeros(len(joined))
    likely = replace(block, pixels=joined, gains=few, errors=few)
    unlikely = replace(likely, continued=1.0, rival=1.0)
    alone, beside, explained = (
        answer_of([doubtful, *more], picture, FindSettings(), ()).parts
        for more in ((), (unlikely,), (likely,))
    )
    assert alone[0].score == beside[0].score < explained[-1].score
    assert len(beside) == 1


def test_a_part_that_is_small_by_what_the_camera_smooths_over_is_doubted(
    picture: Picture, block: Hypothesis
) -> None:
    size = block.part.diameter * CAMERA.fx / block.pose[2, 3]
    alone, large, small = (
        confidence(block, [block], replace(picture, blur=share / 2 * size))
        for share in (0, 0.15, 0.5)
    )
    assert large >= alone > 0.95
    assert small < 0.1


def test_every_feature_speaks_against_a_part(picture: Picture, block: Hypothesis) -> None:
    alone = features(block, [block], picture)
    faults = {
        "bent": {"errors": block.errors + picture.tolerance(0.5)},
        "continued": {"continued": 0.4},
        "free": {"joined": np.arange(block.outline // 2, dtype=np.int32)},
        "rival": {"rival": 1.0},
        "unknown": {"unknown": block.agreed},
        "refuted": {"refuted": block.agreed},
        "hidden": {"beyond": block.area},
    }
    assert (*faults,) == FEATURES
    for place, fault in enumerate(faults.values()):
        worse = replace(block, **fault)
        values = features(worse, [worse], picture)
        others = np.delete(np.arange(len(FEATURES)), place)
        assert values[place] > alone[place] + 0.2
        if FEATURES[place] != "hidden":
            others = others[:-1]  # what the picture does not confirm is hidden, too
        np.testing.assert_allclose(values[others], alone[others], atol=1e-9)
        assert odds(worse, picture) < 0.8 * odds(block, picture)


def test_equal_poses_of_a_symmetric_part_are_no_rivals(
    library: Library, picture: Picture, block: Hypothesis
) -> None:
    equals = [held(library, picture, "block", block.pose @ equal)
              for equal in block.part.symmetry.equals()]  # fmt: skip
    assert len(equals) > 1
    assert rival_of(block, [block, *equals]) == 0


def test_a_rival_explains_the_same_pixels_otherwise(
    library: Library, picture: Picture, block: Hypothesis
) -> None:
    """By its value: another part there, or the same beside it; a part elsewhere is none."""
    near = held(library, picture, "block", AWAY @ block.pose)
    other = replace(block, part=library.parts[0], gains=block.gains / 2)
    pin = held(library, picture, "pin", SHOT.poses[1])
    assert pin.value > 0
    assert rival_of(block, [block, pin]) == 0
    assert rival_of(block, [near, block, pin, other]) == pytest.approx(other.value / block.value)
    shifted = replace(block, pose=near.pose)
    assert rival_of(block, [shifted, other]) == pytest.approx(1)
    assert odds(replace(block, rival=1.0), picture) < 0.8 * odds(block, picture)


def test_what_is_joined_and_unexplained_speaks_against_a_part(library: Library) -> None:
    """A block beside another block: its score falls if nothing explains the other."""
    shot: Shot = shoot(lain("block", 0.0, 0.0), lain("block", 0.0, 0.0455))
    picture = picture_of(shot.depth, CAMERA, SegmentSettings(gap=0.01, min_points=40))
    one, two = (held(library, picture, "block", pose) for pose in shot.poses)
    assert len(one.joined) > 0.1 * one.outline
    place = FEATURES.index("free")
    assert features(one, [one, two], picture)[place] < 0.05
    assert features(one, [one], picture)[place] > 0.1
    assert confidence(one, [one], picture) < confidence(one, [one, two], picture)


def test_what_joins_a_part_among_its_copies_is_likely_another(
    picture: Picture, block: Hypothesis
) -> None:
    joined = replace(block, joined=np.arange(block.outline // 3, dtype=np.int32))
    free = FEATURES.index("free")
    few, many, more = (features(joined, [joined], picture, copies) for copies in (0, 5, 50))
    assert few[free] == pytest.approx(1 / 3, abs=0.02)
    assert many[free] == more[free] == pytest.approx(few[free] / 2)
    np.testing.assert_array_equal(np.delete(many, free), np.delete(few, free))


def test_a_part_aligned_anew_comes_nearer(library: Library, picture: Picture) -> None:
    cluster = Cluster.of(picture, picture.cluster >= 0)
    turned = SHOT.poses[0].copy()
    turned[:3, 3] += 0.004  # an alignment that ended beside the best pose
    worse = held(library, picture, "block", turned)
    better = nudged(worse, cluster, 0)
    assert better.value > worse.value
    assert np.linalg.norm((better.pose - SHOT.poses[0])[:3, 3]) < 0.002
    best = nudged(better, cluster, 1)
    assert best is better or best.value > better.value


def test_a_part_that_is_followed_keeps_its_rival(library: Library) -> None:
    found = find(library, SHOT.depth, CAMERA)
    doubted = replace(found, parts=tuple(replace(part, rival=0.9) for part in found.parts))
    after = find(library, SHOT.depth, CAMERA, before=doubted)
    assert [part.rival for part in after.parts] == [0.9, 0.9]
    assert max(part.score for part in after.parts) < min(part.score for part in found.parts)
