import dataclasses
import inspect

import numpy as np
import pytest

from qs3.clouds.types import PointClouds, UnlabelledClouds
from qs3.errors import InputError
from qs3.runs.checks import require_unlabelled


def clouds(rng) -> PointClouds:
    points = rng.random((3, 4, 3), dtype=np.float32)
    return PointClouds(points, np.array([0, 1, 1]), ("bed", "sofa"), ("a", "b", "c"), "sum")


def test_the_type_of_a_target_has_no_room_for_a_label(rng):
    bare = clouds(rng).without_labels()
    names = {field.name for field in dataclasses.fields(UnlabelledClouds)}
    assert names == {"points", "ids", "checksum", "origin"}
    assert bare.ids == ("000000", "000001", "000002")
    assert bare.checksum == "sum"


def test_a_labelled_target_is_refused(rng):
    require = inspect.unwrap(require_unlabelled)  # without the check of types by the tests
    require(clouds(rng).without_labels())
    with pytest.raises(InputError, match=r"not PointClouds; use \.without_labels\(\)"):
        require(clouds(rng))


def test_select_takes_indices_and_masks_in_their_order(rng):
    whole = clouds(rng)
    assert whole.select(np.array([2, 0])).ids == ("c", "a")
    assert whole.select(np.array([False, True, True])).labels.tolist() == [1, 1]


def test_lengths_and_labels_must_agree(rng):
    points = rng.random((2, 4, 3), dtype=np.float32)
    with pytest.raises(ValueError, match="1 ids, 2 clouds and 2 labels"):
        PointClouds(points, np.array([0, 0]), ("bed",), ("a",))
    with pytest.raises(ValueError, match="beyond"):
        PointClouds(points, np.array([0, 1]), ("bed",), ("a", "b"))
    with pytest.raises(ValueError, match="ids"):
        UnlabelledClouds(points, ("a",))
