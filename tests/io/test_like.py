"""Measures of unlabelled scans replace the ranges of the recipe for parts."""

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.io.like import like, measure
from qs3.io.ply import ply_bytes
from qs3.store.scan_item import RECIPES

PARTS = RECIPES["parts"]


def write_scans(folder, count=21):
    """Clouds of 100 to 300 points, 5 to 7 cm long, each of them repeated once."""
    folder.mkdir()
    rng = np.random.default_rng(0)
    for number in range(count):
        share = number / (count - 1)
        points = rng.random((100 + round(200 * share), 3)) * 0.01
        points[:2, 0] = 0.0, 0.05 + 0.02 * share
        (folder / f"object_{number:03d}.ply").write_bytes(
            ply_bytes(np.tile(points, (2, 1)).astype(np.float32))
        )


def test_clouds_alone_give_points_and_sizes(tmp_path):
    write_scans(tmp_path / "scans")
    measured = measure(tmp_path / "scans")
    assert measured.scans == 21
    assert measured.points == (110, 290)
    assert measured.size == pytest.approx((0.051, 0.069), abs=1e-6)
    made = like(PARTS, measured)
    assert (made.num_points, made.distance) == (290, PARTS.distance)
    assert "do not record where the camera stood" in made.like
    assert made.as_dict()["like"] == made.like


def test_places_of_the_camera_replace_the_recipes(tmp_path):
    write_scans(tmp_path / "scans")
    rows = "".join(f"{0.5 + 0.01 * i},{40 + i}\n" for i in range(21)) + ",\n"
    (tmp_path / "scans" / "objects.csv").write_text("distance,elevation\n" + rows)
    made = like(PARTS, measure(tmp_path / "scans"))
    assert made.distance == pytest.approx((0.51, 0.69))
    assert made.elevation == pytest.approx((41, 59))
    assert made.make_sensor().placement.radius == made.distance
    with pytest.raises(InputError, match="goes with --recipe parts"):
        like(RECIPES["rooms"], measure(tmp_path / "scans"))


def test_millimetres_are_refused(tmp_path):
    (tmp_path / "scans").mkdir()
    cloud = np.random.default_rng(0).random((100, 3), dtype=np.float32) * 60
    (tmp_path / "scans" / "a.ply").write_bytes(ply_bytes(cloud))
    with pytest.raises(InputError, match="millimetres"):
        measure(tmp_path / "scans")
