"""Measures of unlabelled scans replace the ranges of the recipe for parts."""

from dataclasses import replace

import numpy as np
import pytest

from qs3.clouds.files import read_placed
from qs3.clouds.ply_writer import ply_bytes
from qs3.errors import InputError
from qs3.points.grid import on_grid
from qs3.store.scan_item import RECIPES
from qs3.workflow.like import like, measure, measure_clouds

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
    simulated = like(PARTS, measured)
    assert (simulated.num_points, simulated.distance) == (290, PARTS.distance)
    assert "do not record where the camera stood" in simulated.like
    assert simulated.as_dict()["like"] == simulated.like


def test_places_of_the_camera_replace_the_recipes(tmp_path):
    write_scans(tmp_path / "scans")
    rows = "".join(f"{0.5 + 0.01 * i},{40 + i}\n" for i in range(21)) + ",\n"
    (tmp_path / "scans" / "objects.csv").write_text("distance,elevation\n" + rows)
    simulated = like(PARTS, measure(tmp_path / "scans"))
    assert simulated.distance == pytest.approx((0.51, 0.69))
    assert simulated.elevation == pytest.approx((41, 59))
    assert simulated.make_sensor().placement.radius == simulated.distance
    (tmp_path / "scans" / "objects.csv").write_text("distance,elevation\n" + "0.5,90\n" * 21)
    assert like(PARTS, measure(tmp_path / "scans")).make_sensor().placement.elevation == (89, 89)
    with pytest.raises(InputError, match="goes with --recipe parts"):
        like(RECIPES["rooms"], measure(tmp_path / "scans"))


def test_scans_are_cut_as_high_above_the_table_as_these(tmp_path):
    """Half of the clouds begin 4 to 6 mm above z = 0, the others overhang; strays do not count."""
    folder, rng = tmp_path / "scans", np.random.default_rng(0)
    folder.mkdir()
    assert measure_like(folder, rng, [0.004 + 0.0001 * i for i in range(21)] + [0.02] * 19)
    simulated = like(PARTS, measure(folder))
    assert simulated.table_cut == pytest.approx((0.0042, 0.0059), abs=8e-4)
    assert "cut 4" in simulated.like
    (folder / "objects.csv").unlink()  # no table is known
    assert like(PARTS, measure(folder)).table_cut == PARTS.table_cut == (0.0, 0.01)


def measure_like(folder, rng, heights):
    """Write clouds that begin at heights, one stray below each, with their places."""
    rows = ["file,distance,elevation"]
    for number, height in enumerate(heights):
        points = rng.uniform((0, 0, height), (0.03, 0.03, height + 0.02), (500, 3))
        points[0, 2] = -0.01
        name = f"object_{number:03d}.ply"
        (folder / name).write_bytes(ply_bytes(points.astype(np.float32)))
        rows.append(f"{name},0.5,45")
    return (folder / "objects.csv").write_text("\n".join(rows) + "\n")


def test_only_the_places_of_these_scans_count_also_by_links(tmp_path):
    folder, links = tmp_path / "scans", tmp_path / "links"
    write_scans(folder)
    rows = [f"object_{i:03d}.ply,{0.5 + 0.01 * i},{40 + i}\n" for i in range(21)]
    (folder / "objects.csv").write_text("file,distance,elevation\n" + "".join(rows))
    for i in range(11, 21):  # no objects, but noise
        (folder / f"object_{i:03d}.ply").unlink()
    measured = measure(folder)
    assert measured.distance == pytest.approx((0.505, 0.595))
    links.mkdir()
    for file in folder.glob("*.ply"):
        (links / f"2_{file.name}").symlink_to(file)
    assert measure(links) == measured
    files = sorted(folder.glob("*.ply"))
    clouds = [read_placed(file)[0] for file in files]
    assert measure_clouds(clouds, files, files) == measured


@pytest.mark.parametrize("stride", [1, 2, 3])
@pytest.mark.parametrize("sensor", ["d435", "d415", "kinect-v1"])
def test_the_stride_of_the_scans_is_found_in_them(tmp_path, sensor, stride):
    """A plate, tilted by 40°, of which every stride-th row and column is kept, with noise."""
    scan = replace(PARTS, sensor=sensor)
    focal, folder = scan.make_sensor().rig.focal, tmp_path / "scans"
    folder.mkdir()
    rng, rows = np.random.default_rng(0), ["file,distance,elevation"]
    for number, away in enumerate((0.5, 0.6, 0.8)):
        u, v = np.mgrid[-60:61:stride, -60:61:stride].reshape(2, -1) / focal
        z = away / (1 - v * np.tan(np.radians(40))) + rng.normal(scale=0.0005, size=len(u))
        name = f"object_{number:03d}.ply"
        (folder / name).write_bytes(
            ply_bytes((np.column_stack([u, v, np.ones_like(u)]) * z[:, None]).astype(np.float32))
        )
        rows.append(f"{name},{away},50")
    (folder / "objects.csv").write_text("\n".join(rows) + "\n")
    found = like(scan, measure(folder))
    assert found.stride == found.make_sensor().depth.stride == stride
    assert "mrad" in found.like


def test_without_a_distance_every_pixel_is_kept_as_segment_does(tmp_path):
    write_scans(tmp_path / "scans")
    assert like(PARTS, measure(tmp_path / "scans")).stride == PARTS.stride == 1


def test_scans_on_a_grid_are_simulated_on_one(tmp_path):
    folder, rng = tmp_path / "scans", np.random.default_rng(0)
    folder.mkdir()
    for number in range(4):
        ball = rng.normal(size=(5000, 3))
        ball *= 0.02 / np.linalg.norm(ball, axis=1, keepdims=True)
        cloud = on_grid(ball, 0.0025, rng)[1].astype(np.float32)
        (folder / f"{number}.ply").write_bytes(ply_bytes(cloud))
    measured = measure(folder)
    simulated = like(PARTS, measured)
    assert (simulated.grid, simulated.stride) == (0.0025, 1)
    assert "on a grid of 2.5 mm" in simulated.like
    bare = replace(measured, grid=None)
    assert not measured.fits(bare)
    assert like(replace(PARTS, grid=0.001), bare).grid == 0.001


def test_millimetres_are_refused(tmp_path):
    (tmp_path / "scans").mkdir()
    cloud = np.random.default_rng(0).random((100, 3), dtype=np.float32) * 60
    (tmp_path / "scans" / "a.ply").write_bytes(ply_bytes(cloud))
    with pytest.raises(InputError, match="millimetres"):
        measure(tmp_path / "scans")


def test_a_scan_of_fewer_points_makes_no_other_simulation(tmp_path):
    write_scans(tmp_path / "scans")
    before = measure(tmp_path / "scans")
    fewer = replace(before, points=(before.points[0] / 3, 1.01 * before.points[1]))
    more = replace(before, points=(before.points[0], 2 * before.points[1]))
    assert before.fits(fewer)
    assert not before.fits(more)
