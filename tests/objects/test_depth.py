"""Depth images, masks and cameras from files, and the points they give."""

import dataclasses
import json
import re
import shutil
import unicodedata

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from qs3.errors import TOLD, InputError
from qs3.frames import images
from qs3.frames.camera_files import read_intrinsics
from qs3.frames.images import list_files, read_depth, read_mask
from qs3.frames.infrared import PairFiles
from qs3.frames.intrinsics import Intrinsics
from qs3.objects.cut import CutSettings, keep_pixels, lift, upright
from qs3.objects.depth import (
    DepthImageSettings,
    Frame,
    FrameObject,
    cut_frame,
    extract_depth,
    list_frames,
    read_names,
)
from qs3.objects.run import OutputSettings
from qs3.objects.scene_files import SceneSettings, segment_scene
from qs3.store.manifest import read_failures

from ..clouds.hostile import png_bytes, refused
from .depth_scene import (
    HEIGHT,
    MATRIX,
    WIDTH,
    camera_to_world,
    millimetres,
    off_surface,
    photograph,
    thing,
    write_png,
)

CAMERA = Intrinsics(150.0, 140.0, 77.0, 61.0)


@pytest.fixture(scope="module")
def taken(tmp_path_factory):
    """One depth image of the thing with its mask, from the side and above."""
    folder = tmp_path_factory.mktemp("taken")
    pose = camera_to_world(35, 25)
    depth, face = photograph(thing(), pose)
    write_png(folder / "depth" / "a.png", millimetres(depth))
    write_png(folder / "mask" / "a.png", ((face >= 0) * 255).astype(np.uint8))
    return folder, pose, depth


def cut(depth, mask, camera=CAMERA, names=None, **more):
    """The objects of one depth image, called a."""
    settings = DepthImageSettings(**more)
    item = FrameObject("a", mask, upright(settings.gravity))
    return list(cut_frame(Frame("a", depth, camera, (item,)), settings, names or {}))


def test_convention_gravity_makes_the_cloud_upright_and_not_mirrored(taken):
    folder, pose, depth = taken
    gravity = pose[:3, :3].T @ [0.0, 0.0, -9.81]
    (cloud,) = cut(folder / "depth" / "a.png", folder / "mask" / "a.png", gravity=tuple(gravity))
    assert cloud.points.dtype == np.float32
    assert len(cloud.points) == (depth > 0).sum()
    # All that is left between the cloud and the world is a turn about z and a shift.
    turn = pose[:3, :3] @ upright(tuple(gravity)).T
    np.testing.assert_allclose(turn[2], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(turn[:2, :2], turn[:2, :2].T * [[1, -1], [-1, 1]], atol=1e-12)
    world = cloud.points @ turn.T + pose[:3, 3]
    # Half a millimetre along a ray that is at most 1.2 times as long as its depth.
    assert off_surface(thing(), world[::7]).max() < 0.0005 * 1.2
    mirrored = (cloud.points * [-1, 1, 1]) @ turn.T + pose[:3, 3]
    assert off_surface(thing(), mirrored[::7]).mean() > 0.05


def test_convention_without_gravity_the_image_is_upright(tmp_path):
    # One pixel right of the centre, one above it: at 2 m, 100 px of focal length.
    depth = np.zeros((5, 5), np.uint16)
    depth[2, 2] = depth[2, 4] = depth[1, 2] = 2000
    write_png(tmp_path / "d.png", depth)
    camera = Intrinsics(100.0, 50.0, 2.0, 2.0)
    write_png(tmp_path / "m.png", np.ones((5, 5), np.uint8))
    (cloud,) = cut(tmp_path / "d.png", tmp_path / "m.png", camera, cut=CutSettings(min_points=1))
    expected = [[0.0, 2.0, 0.04], [0.0, 2.0, 0.0], [0.04, 2.0, 0.0]]
    np.testing.assert_allclose(cloud.points, expected, atol=1e-6)


directions = st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda g: np.linalg.norm(g) > 0.1)


@given(directions)
def test_upright_is_a_rotation_that_puts_gravity_down(gravity):
    turn = upright(gravity)
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(turn) > 0
    down = np.array(gravity) / np.linalg.norm(gravity)
    np.testing.assert_allclose(turn @ down, [0, 0, -1], atol=1e-9)
    # Within a milliradian of straight down or up the image's upward direction takes over.
    straight = np.linalg.norm(down[:2]) <= 1e-3
    ahead = turn @ ([0, -1, 0] if straight else [0, 0, 1])
    assert abs(ahead[0]) < 1e-9
    assert ahead[1] > -1e-9


@given(
    st.floats(1, 2000), st.floats(1, 2000), st.floats(-50, 50), st.floats(-50, 50),
    st.integers(0, 2**32 - 1),
)  # fmt: skip
@settings(max_examples=50)
def test_lift_inverts_projection(fx, fy, cx, cy, seed):
    rng = np.random.default_rng(seed)
    depth = rng.uniform(0.1, 10, (4, 6)).astype(np.float32)
    keep = rng.random((4, 6)) < 0.7
    x, y, z = lift(depth, keep, Intrinsics(fx, fy, cx, cy)).T
    v, u = np.nonzero(keep)
    np.testing.assert_allclose(fx * x / z + cx, u, atol=1e-6)
    np.testing.assert_allclose(fy * y / z + cy, v, atol=1e-6)
    np.testing.assert_array_equal(z.astype(np.float32), depth[keep])


def test_every_kind_of_file_tells_the_same_depth(tmp_path, rng):
    steps = rng.integers(0, 5000, (7, 9)).astype(np.uint16)
    write_png(tmp_path / "a.png", steps)
    (tmp_path / "b.tif").write_bytes(cv2.imencode(".tiff", steps)[1].tobytes())
    metres = (steps / 1000).astype(np.float32)
    (tmp_path / "c.tiff").write_bytes(cv2.imencode(".tiff", metres)[1].tobytes())
    np.save(tmp_path / "d.npy", metres.astype(np.float64))
    np.save(tmp_path / "e.npy", np.asfortranarray(steps.astype(np.int32)))
    np.save(tmp_path / "f.npy", metres[..., None])
    np.save(tmp_path / "g.npy", metres[None])
    expected = np.where(steps > 0, metres, np.nan)
    for path in sorted(tmp_path.iterdir()):
        np.testing.assert_allclose(read_depth(path), expected, rtol=1e-6, err_msg=path.name)
    np.testing.assert_allclose(read_depth(tmp_path / "a.png", 0.0001), expected / 10, rtol=1e-6)
    np.testing.assert_allclose(read_depth(tmp_path / "d.npy", 0.01), expected / 100, rtol=1e-6)


@pytest.mark.parametrize(
    ("name", "word"),
    [("distance_to_camera_0004.npy", "distance_to_camera"), ("Disparity/4.npy", "Disparity"),
     ("depth/radial_distance_4.npy", "radial_distance"), ("radial_bearing/depth_4.npy", ""),
     ("distance_to_image_plane_0004.npy", ""), ("dispenser.npy", ""),
     ("distance_0004.npy", "distance"), ("distance/4.npy", "distance"), ("distance_4mm/4.npy", ""),
     ("DepthPerspective_4.npy", "DepthPerspective"), ("DepthPlanar_4.npy", ""),
     ("DistanceToCameraSD/4.npy", "DistanceToCamera"), ("DistanceToImagePlaneSD/4.npy", ""),
     ("disp_occ_0/4.npy", "disp"), ("disp0.npy", "disp"), ("a_display_4.npy", "")],
)  # fmt: skip
def test_a_name_of_other_numbers_than_depth_is_reported(tmp_path, caplog, name, word):
    TOLD.clear()
    (tmp_path / name).parent.mkdir(exist_ok=True)
    np.save(tmp_path / name, np.ones((7, 9), np.float32) * 0.7)
    read_depth(tmp_path / name)
    found = re.findall(r"is called (\w+), and is read as depth along", caplog.text)
    assert found == [word] * bool(word)


@pytest.mark.parametrize("share", [0.02, 0.4, 0.95])
@pytest.mark.parametrize(
    ("kind", "far", "step"),
    [
        (np.float32, 1e10, None), (np.float64, 1e10, None), (np.float16, 65504, None),
        (np.float32, 65504, None), (np.float32, 65504, 0.001), (np.float32, 1e10, 0.001),
        (np.float32, 1000, None), (np.float64, 1e300, None), (np.int32, 10**9, None),
    ],
)  # fmt: skip
def test_the_background_of_a_rendered_image_is_no_depth(tmp_path, rng, kind, far, step, share):
    unit = step or (0.001 if kind == np.int32 else 1)
    depth = (rng.uniform(0.6, 0.9, (48, 64)) / unit).astype(kind)
    depth[: int(48 * share) or 1] = far
    np.save(tmp_path / "a.npy", depth)
    read = read_depth(tmp_path / "a.npy", step)
    expected = np.where(depth == kind(far), np.nan, depth.astype(np.float64) * unit)
    np.testing.assert_allclose(read, expected, rtol=1e-5)


@pytest.mark.parametrize("far", [1000.0, 1e10, 65504.0])
def test_millimetres_beside_metres_or_a_background_are_refused(tmp_path, rng, far):
    depth = rng.uniform(600, 900, (48, 64)).astype(np.float32)
    depth[:20] = far
    np.save(tmp_path / "mm.npy", depth)
    with refused("which no depth camera sees", "mm.npy"):
        read_depth(tmp_path / "mm.npy")
    depth[40:] /= 1000
    np.save(tmp_path / "mixed.npy", depth)
    if far == 1000.0:
        with refused("which no depth camera sees", "mixed.npy"):
            read_depth(tmp_path / "mixed.npy")


def test_what_is_no_depth_becomes_nan(tmp_path):
    np.save(tmp_path / "a.npy", np.array([[2.0, -1.0, np.nan, np.inf, -np.inf, 1e300, 0.0, 65535]]))
    assert np.flatnonzero(np.isfinite(read_depth(tmp_path / "a.npy"))).tolist() == [0]
    steps = np.array([[900, 0, 65535, 65534]], np.uint16)
    write_png(tmp_path / "b.png", steps)
    np.save(tmp_path / "c.npy", steps.astype(">u2"))
    np.save(tmp_path / "d.npy", steps.astype(np.int32))
    for name in ("b.png", "c.npy", "d.npy"):
        depth = read_depth(tmp_path / name)
        np.testing.assert_allclose(depth, [[0.9, np.nan, np.nan, 65.534]])
    wide = np.array([[70000, 65535]], np.int32)  # more than 16 bits: a number like others
    np.save(tmp_path / "e.npy", wide)
    np.testing.assert_allclose(read_depth(tmp_path / "e.npy", 1e-5), wide * 1e-5, rtol=1e-6)
    np.save(tmp_path / "none.npy", np.full((9, 9), -1.0))  # a frame of nothing
    assert np.isnan(read_depth(tmp_path / "none.npy")).all()
    for name, back in (("gl.npy", -0.7 - np.eye(9)), ("i.npy", (-700 - np.eye(9)).astype("i2"))):
        np.save(tmp_path / name, back)
        with refused("its depths are negative: z looks backwards", name):
            read_depth(tmp_path / name)
    np.save(tmp_path / "mm.npy", np.full((9, 9), 800.0))
    with refused("middle depth would be 800 m.*0.001 if it holds millimetres", "mm.npy"):
        read_depth(tmp_path / "mm.npy")


def test_the_gate_and_the_edge_of_a_mask():
    depth = np.full((12, 12), 2.0, np.float32)
    depth[5, 5] = 2.6
    mask = np.zeros((12, 12), bool)
    mask[0:8, 2:10] = True
    assert keep_pixels(depth, mask, CutSettings()).sum() == 64
    assert keep_pixels(depth, mask, CutSettings(far=2.5)).sum() == 63
    assert keep_pixels(depth, mask, CutSettings(far=2.0)).sum() == 0
    assert keep_pixels(depth, mask, CutSettings(near=2.0)).sum() == 1
    # Three sides of the mask are edges, the fourth is the image's border.
    assert keep_pixels(depth, mask, CutSettings(erode=1)).sum() == 7 * 6


def test_a_mask_of_instances_gives_a_cloud_each_with_its_class(taken, tmp_path):
    folder, _, depth = taken
    mask = np.where(depth > 0, 3, 0).astype(np.uint16)
    mask[:, : WIDTH // 2][depth[:, : WIDTH // 2] > 0] = 700
    write_png(tmp_path / "mask" / "a.png", mask)
    (tmp_path / "names.csv").write_text("name,class\na/3,table\n*/700,chair\na,sofa\n")
    image, masks = folder / "depth" / "a.png", tmp_path / "mask"
    names = read_names(tmp_path / "names.csv")
    clouds = cut(image, masks / "a.png", names=names, instances=True)
    assert [(c.id, c.class_name) for c in clouds] == [("a/3", "table"), ("a/700", "chair")]
    assert sum(len(c.points) for c in clouds) == (depth > 0).sum()
    # Without the option both are one object; a coloured mask is what is not black.
    (whole,) = cut(image, masks / "a.png", class_name="x")
    assert whole.class_name == "x"
    colour = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    colour[..., 2] = (mask > 0) * 9
    write_png(masks / "colour.png", colour)
    (other,) = cut(image, masks / "colour.png")
    np.testing.assert_array_equal(whole.points, other.points)


@pytest.mark.parametrize(
    ("rows", "instances", "words"),
    [
        (["aa"], False, "nothing here is called aa, and a has no row"),
        (["a.png"], False, "called a.png, and a has no row"),
        (["a/1"], False, "called a/1, and a has no row"),
        (["*/1"], False, "called */1, and a has no row"),
        (["b/1", "*"], True, "called *, b/1, and a has no row"),
        (["a/1", "a/7"], True, "called a/7, and a/2 has no row"),
        (["a/1", "a/2", "a/7"], True, "warns: nothing here is called a/7"),
        (["a", "b"], False, "warns: nothing here is called b"),
        (["a", *"bcdefgh"], False, "warns: nothing here is called b, c, d, e, f and 2 more"),
        (["a", "*/9"], True, ""),
    ],
)
def test_rows_that_name_nothing_are_not_ignored(taken, tmp_path, caplog, rows, instances, words):
    TOLD.clear()
    mask = np.zeros((HEIGHT, WIDTH), np.uint8)
    mask[20:60, 40:80], mask[60:100, 40:80] = 1, 2
    write_png(tmp_path / "m.png", mask)
    (tmp_path / "t.csv").write_text("name,class\n" + "".join(f"{row},chair\n" for row in rows))
    settings = DepthImageSettings(
        "150,140,77,61", tmp_path / "m.png", instances, names=tmp_path / "t.csv"
    )

    out = OutputSettings(out=str(tmp_path / "data"), workers=0)
    try:
        report = extract_depth(taken[0] / "depth" / "a.png", out, settings)
        faults = [record["reason"] for record in read_failures(tmp_path / "data")]
        assert report.failed == len(faults)
        warned = (f"warns: {line.partition(': ')[2]}" for line in caplog.messages)
        outcome = "".join(faults or warned)
    except InputError as error:
        outcome = str(error)
    fault = words.removeprefix("warns: ")
    assert outcome.startswith("warns: ") == (fault != words)
    assert fault in outcome
    assert bool(fault) == bool(outcome)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"fx": 1e-300}, "no focal lengths of it in pixels"),
        ({"fx": 0.9}, "no focal lengths of it in pixels"),
        ({"fy": 5.0}, "fx 150, fy 5 are no focal lengths of it in pixels"),
        ({"fx": 50.0, "fy": 160.0}, "no focal lengths of it in pixels"),
        ({"depth_scale": 49.0}, "middle depth would be"),
        ({"depth_scale": 1e-5}, None),
        ({"depth_scale": 6e-6}, None),
        ({"cx": 159.5, "cy": 119.5}, "principal point 159.5, 119.5 is not near their middle"),
        ({"width": 120, "height": 160}, "is 160×120 pixels, the camera 120×160"),
        ({"cx": 159.5, "cy": 119.5, "width": 160, "height": 120}, None),  # a crop says so
    ],
)
def test_cameras_of_other_images_are_refused(taken, change, words):
    folder, _, _ = taken
    camera = dataclasses.replace(CAMERA, **change)
    if words is None:
        assert cut(folder / "depth" / "a.png", folder / "mask" / "a.png", camera)
        return
    with refused(words, folder / "depth" / "a.png"):
        cut(folder / "depth" / "a.png", folder / "mask" / "a.png", camera)


PLAIN = {"fx": 150, "fy": 140, "cx": 77, "cy": 61}


@pytest.mark.parametrize(
    ("named", "step"),
    [
        ({"depth_unit": 0.0002}, 0.0002), ({"depthUnit": 0.0002}, 0.0002),
        ({"depth_units": "mm"}, 0.001), ({"depthUnit": "Millimetres"}, 0.001),
        ({"depth_scale": 0.2}, 0.0002), ({"depth_scale": 1, "depth_unit": 0.001}, 0.001),
        ({"depth_scale": None, "aabb_scale": 16, "max_depth_in_m": 4}, None),
        *(({name: {"unit": "mm", "scale": 1000, "depth_scale": 0.1}}, 1e-4) for name in
          ("extrinsics", "baseline", "imu0", "depth_to_color_transform")),
        *(({name: {"unit": "mm"}}, "write depth_unit") for name in
          ("stereo", "simulation", "maximum", "depth_transform", "raw_to_depth_transform")),
        *(({name: number}, "write depth_unit") for name, number in (
            ("depth_scale", 5000), ("depth_scale", 50), ("depth_factor", 5000), ("scale", 1000),
            ("depthScale", 0.001), ("factor", 0.001), ("png_depth_scale", 6553.5),
            ("png_depth_shift_factor", 5000), ("depth_unit_mm", 1), ("units", "mm"),
            ("depth_scale", "mm"), ("depth_scale", "0.1"),
            ("DepthMapFactor", 5000), ("factor_depth", 1e4), ("depth_shift", 1000),
            ("integer_depth_scale", 0.001), ("depth", {"scale": 1000}), ("depth_divisor", 2),
            ("camera", {"scale": 6553.5}), ("depth_unit", "furlong"), ("depth_to_meters", 0.001),
        )),
        ({"depth_unit": 5000}, "write 0.0002"),
        ({"depth_unit": 0.001, "depth_scale": 5}, "differ"),
    ],
)  # fmt: skip
def test_every_name_of_a_depth_scale_is_honoured_or_refused(tmp_path, named, step):
    (tmp_path / "camera.json").write_text(json.dumps(PLAIN | named))
    if isinstance(step, str):
        with refused(step, tmp_path / "camera.json"):
            read_intrinsics(tmp_path)
    else:
        assert read_intrinsics(tmp_path).depth_scale == pytest.approx(step)
    if step != "write 0.0002":
        assert read_intrinsics(tmp_path, 0.0005).depth_scale == 0.0005


@pytest.mark.parametrize("inner", [{"camera": {"intrinsics": PLAIN}}, {"intrinsics": PLAIN}])
def test_a_depth_scale_beside_the_camera_counts(tmp_path, inner):
    for named, step in ({"depth_scale": 0.1}, 1e-4), ({"depth_unit": 1e-3}, 1e-3), ({}, None):
        (tmp_path / "camera.json").write_text(json.dumps(inner | named))
        assert read_intrinsics(tmp_path).depth_scale == step


def test_a_scale_to_divide_by_is_refused_wherever_it_is_given(taken, tmp_path):
    folder, _, _ = taken
    image, mask = folder / "depth" / "a.png", folder / "mask" / "a.png"
    lens, words = "150,140,77,61", r"to be divided by it, write 0\.0002"
    out = OutputSettings(str(tmp_path / "data"), workers=0)
    pair = PairFiles((image, image), image, lens, 0.05, 5000.0)
    scene = SceneSettings(intrinsics=lens, depth_scale=5000.0)
    for read in (
        lambda: read_depth(image, 5000.0),
        lambda: segment_scene(image, tmp_path / "out", scene),
        lambda: extract_depth(image, out, DepthImageSettings(lens, mask, depth_scale=5000.0)),
        pair.read,
    ):
        with refused(words):
            read()


def same_cameras(forms, folder):
    """The cameras of files by name, each of the numbers of `MATRIX`."""
    cameras = []
    for name, text in forms.items():
        (folder / name).write_text(text, encoding="utf-8")
        camera = read_intrinsics(folder / name)
        assert (camera.fx, camera.fy, camera.cx, camera.cy) == (150, 140, 77, 61), name
        cameras.append(camera)
    return cameras


def test_every_form_of_a_camera_gives_the_same(tmp_path):
    rows = MATRIX.ravel().tolist()
    forms = {
        "bop.json": json.dumps({"fx": 150, "fy": 140.0, "cx": 77, "cy": 61, "depth_scale": 0.1}),
        "k.json": json.dumps({"K": MATRIX.tolist()}),
        "cam.json": json.dumps({"cam_K": rows, "width": 160, "height": 120}),
        "k.txt": "150 0 77\n0 140 61\n0 0 1\n",
        "ros2.yaml": f"header: {{frame_id: a}}\nk: {rows}\nd: [0.0]\n---\nk: []\n",
    }
    first, *_ = same_cameras(forms, tmp_path)
    assert first.depth_scale == pytest.approx(0.0001)
    camera = read_intrinsics("150,140,77,61")
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (150, 140, 77, 61)
    plain = {"fx": 150, "fy": 150, "cx": 77, "cy": 61, "depth_unit": 1e-4, "width": 9, "height": 8}
    (tmp_path / "own.json").write_text(json.dumps(plain), encoding="utf-8")
    camera = read_intrinsics(tmp_path / "own.json")
    assert camera == Intrinsics(150.0, 150.0, 77.0, 61.0, 9, 8, 1e-4)
    with pytest.raises(InputError, match="160×120 pixels, the camera 9×8"):
        camera.check_size((120, 160), "a.png")


def test_a_matrix_may_be_larger_than_three_by_three_or_by_columns(tmp_path):
    large, wide = np.eye(4), np.zeros((3, 4))
    large[:3, :3] = wide[:, :3] = MATRIX
    inner = {"height": 120, "width": 160, "intrinsic_matrix": MATRIX.T.ravel().tolist()}
    forms = {
        "k.txt": "\n".join(" ".join(map(str, row)) for row in large.tolist()),
        "p.txt": " ".join(map(str, wide.ravel().tolist())),
        "k.json": json.dumps({"K": large.tolist()}),
        "flat.json": json.dumps({"camera_matrix": large.ravel().tolist()}),
        "open3d.json": json.dumps({"intrinsic_matrix": MATRIX.T.ravel().tolist()}),
        "rows.json": json.dumps({"intrinsic_matrix": MATRIX.ravel().tolist()}),
        "nested.json": json.dumps({"intrinsic_matrix": MATRIX.tolist()}),
        "pose.json": json.dumps({"extrinsic": np.eye(4).ravel().tolist(), "intrinsic": inner}),
    }
    *_, camera = same_cameras(forms, tmp_path)
    assert (camera.width, camera.height) == (160, 120)
    large[0, 3], large[3, 0] = 5.0, 1.0
    wide[0, 3] = 5.0
    for matrix, words in ((large, "is not 0 0 0 1"), (wide, "fourth column"), (MATRIX.T, "row by")):
        (tmp_path / "K.txt").write_text(" ".join(map(str, matrix.ravel().tolist())))
        with refused(words, "K.txt"):
            read_intrinsics(tmp_path / "K.txt")


def test_cameras_of_other_tools_are_read(tmp_path):
    rows = MATRIX.tolist()
    kalibr = {"camera_model": "pinhole", "distortion_coeffs": [0.1, 0, 0, 0], "intrinsics": FOUR}
    forms = {
        "k.csv": "\n".join(",".join(map(str, row)) for row in rows),
        "k.txt": "# K\n" + str(MATRIX),
        "nested.txt": str(rows),
        "four.txt": "150 140 77 61",
        "comma.txt": "150,140,77,61\n",
        "list.json": json.dumps({"intrinsics": rows}),
        "alone.json": json.dumps(rows),
        "flat.yaml": "- [150, 0, 77]\n- [0, 1.4e2, 61]\n- [0, 0, 1]\n",
        "four.json": json.dumps(FOUR),
        "twice.json": json.dumps(PLAIN)[:-1] + ', "fx": 150}',
        "twice.yaml": "fx: 150\n<<: {fx: 9, cx: 77}\nfx: 150.0\nfy: 140\ncy: 61\n",
        "exponents.yaml": "fx: 15e1\nfy: 1.4E2\ncx: 77\ncy: 610e-1\n",
        "zivid.yml": ZIVID,
        "kalibr.yaml": json.dumps(
            {"cam0": kalibr | {"distortion_model": "radtan", "resolution": [160, 120]}}
        ),
    }
    *_, camera = same_cameras(forms, tmp_path)
    assert (camera.width, camera.height, camera.distortion) == (160, 120, (0.1, 0, 0, 0))
    (tmp_path / "step.yaml").write_text("fx: 150\nfy: 140\ncx: 77\ncy: 61\ndepth_unit: 1e-4\n")
    assert read_intrinsics(tmp_path / "step.yaml").depth_scale == 1e-4
    (tmp_path / "utf16.txt").write_text("150 140 77 61", encoding="utf-16")
    assert read_intrinsics(tmp_path / "utf16.txt").fx == 150


ZIVID = """__version__: 1
CameraIntrinsics:
  CameraMatrix: {CX: 77, CY: 61, FX: 150, FY: 140}
  Distortion: {K1: 0, K2: 0, K3: 0, P1: 0, P2: 0}
"""
FOUR = [150, 140, 77, 61]
RADIAL = {"k1": 0.1, "k2": 0.2, "k3": 0.3, "p1": 0.01, "p2": 0.02}


@pytest.mark.parametrize(
    ("named", "kept"),
    [
        ({name: [0.1, 0.2, 0, 0, 0]}, (0.1, 0.2, 0, 0, 0))
        for name in ("distortion", "dist", "dist_coef", "distortion_coeffs", "dist_coeffs", "kc")
    ]
    + [
        (RADIAL, (0.1, 0.2, 0.01, 0.02, 0.3)),
        (RADIAL | {"k4": 0.4, "k5": 0.5, "k6": 0.6}, (0.1, 0.2, 0.01, 0.02, 0.3, 0.4, 0.5, 0.6)),
        ({"coeffs": [0.1, 0, 0, 0, 0], "model": "distortion.brown_conrady"}, (0.1, 0, 0, 0, 0)),
        ({"radial_distortion": [0.0, 0.0]}, ()),
        *(
            ({name: [0.1, 0.2]}, f"its {name.replace('_', '')} is unknown")
            for name in (
                "radial",
                "tangential",
                "lens_coeffs",
                "distortion_k1",
                "k7",
                "d0",
                "p3",
                "s1",
                "thin_prism",
            )
        ),
        ({"xi": 1.2, "D": [0.1, 0, 0, 0]}, "its xi is unknown"),
        ({"is_fisheye": True}, "its isfisheye is unknown"),
        ({"skew": 0.4}, "its skew is unknown"),
        ({"distortion": {"radial": [0.1], "tangential": [0, 0]}}, "its radial is unknown"),
        (
            {"is_fisheye": False, "xi": 0.0, "radial": [[0, 0]], "skew": "0", "undistorted": True},
            (),
        ),
        ({"distortion": {"K1": 0.1, "K2": 0.2, "K3": 0, "P1": 0, "P2": 0}}, (0.1, 0.2, 0, 0, 0)),
        (
            {"camera_model": "D435", "distortion_model": "plumb_bob", "D": [0.1, 0, 0, 0]},
            (0.1, 0, 0, 0),
        ),
        ({"type": "depth", "camera_type": "NFOV", "D": [0.1, 0, 0, 0]}, (0.1, 0, 0, 0)),
        *(
            (strange, ())
            for strange in (
                {"camera_model": "OAK-D Pro (fov 80)"},
                {"camera_type": "ortho-rectified"},
                {"dist_coeffs_valid": True},
                {"lens_distance": 0.1},
                {"s1": "sensor1"},
                {"distortion_status": "measured", "radial": ["0", False, {"unit": "px"}]},
            )
        ),
        *(
            ({"camera_model": name}, "no pinhole")
            for name in (
                "pinhole-fov",
                "double sphere",
                "mei",
                "eucm-none",
                "ds-none",
                "kb4",
                "xi",
                "theta",
            )
        ),
        ({"radial": ["0.1"]}, "its radial is unknown"),
        ({"fisheye": "yes"}, "its fisheye is unknown"),
        ({"type": "fisheye"}, "no pinhole"),
        ({"projection": "equirectangular"}, "no pinhole"),
        ({"camera_model": "Orthographic camera"}, "no pinhole"),
        ({"camera_model": "KANNALA_BRANDT4"}, "no pinhole"),
        ({"intrinsics": {"fx": 150, "model": "equidistant"}}, "no pinhole"),
        ({"model": "OPENCV_FISHEYE"}, "no pinhole"),
        ({"D": [0, 0, 0, 0], "distortion_model": "equidistant"}, "no pinhole"),
        *(
            ({name: {"model": "radtan", inner: [0.1, 0, 0, 0]}}, (0.1, 0, 0, 0))
            for name, inner in (
                ("distortion", "coefficients"),
                ("distortion", "params"),
                ("lens", "dist_coeffs"),
            )
        ),
        ({"lens": {"k1": 0.1}}, (0.1, 0, 0, 0, 0)),
        ({"lens": {"model": "wide 6 mm", "focal": 6}, "distortion": {"type": "none"}}, ()),
        ({"distortion": {"type": "brown", "k1": 0.1}}, r"undone \(brown, 5 numbers"),
        ({"distortion": {"values": [0.1, 0, 0, 0]}}, "its distortionvalues is unknown"),
        ({"cam_dist": [0.1, 0, 0, 0]}, "its camdist is unknown"),
        ({"depth_dist_coeffs": [0.1, 0, 0, 0]}, "its depthdistcoeffs is unknown"),
        ({"tau_x": 0.1}, "its taux is unknown"),
        # So have fisheyes; OpenCV's divisor has k5 and k6 too.
        ({"k1": 0.1, "k2": 0.2, "k3": 0.3, "k4": 0.4}, "its k4 is unknown"),
        (RADIAL | {"k4": 0}, (0.1, 0.2, 0.01, 0.02, 0.3)),
        ({"camera_model": "omni", "distortion_model": "radtan"}, "lens model omni"),
        ({"cam0": {"intrinsics": FOUR}, "cam1": {"intrinsics": FOUR}}, "cam0, cam1"),
    ],
)
def test_the_distortion_of_a_lens_is_found_by_any_name(tmp_path, named, kept):
    plain = dict(zip(("fx", "fy", "cx", "cy"), FOUR, strict=True))
    (tmp_path / "a.json").write_text(json.dumps(plain | named))
    if isinstance(kept, str):
        with refused(kept, tmp_path / "a.json"):
            read_intrinsics(tmp_path / "a.json")
    else:
        assert read_intrinsics(tmp_path / "a.json").distortion == kept


MORE = {"fx": 170, "fy": 170, "cx": 79.5, "cy": 59.5}


@pytest.mark.parametrize(
    ("named", "words"),
    [
        (PLAIN | {"color": MORE}, "color is another camera; give a file of the depth camera"),
        (PLAIN | {"device": {"left": {"CameraMatrix": MORE}}}, "left is another camera"),
        ({"intrinsics": PLAIN, "depth_intrinsics": MORE}, "depth_intrinsics is another camera"),
        (PLAIN | {"K_rgb": [[170, 0, 79], [0, 170, 59], [0, 0, 1]]}, "K_rgb is another camera"),
        (PLAIN | {"M2": {"rows": 3, "data": [170, 0, 79, 0, 170, 59, 0, 0, 1]}}, "M2 is another"),
        (PLAIN | {"ppx": 79}, "ppx has two values"),
        ({"K": MATRIX.tolist(), "camera_matrix": np.diag([9, 9, 1]).tolist()}, "has two values"),
        (PLAIN | {"color": PLAIN, "K": MATRIX.tolist(), "cam_K": MATRIX.ravel().tolist()}, ""),
        (PLAIN | {"R": np.eye(3).tolist(), "pose": np.eye(4).tolist(), "imu": {"K": "none"}}, ""),
        ({"K": MATRIX.tolist(), "P": [170, 0, 79, 0, 0, 170, 59, 0, 0, 0, 1, 0]}, ""),
    ],
)
def test_a_file_of_several_cameras_is_refused(tmp_path, named, words):
    (tmp_path / "camera.json").write_text(json.dumps(named))
    if words:
        with refused(words, tmp_path / "camera.json"):
            read_intrinsics(tmp_path)
    else:
        assert read_intrinsics(tmp_path) == Intrinsics(150.0, 140.0, 77.0, 61.0)


@pytest.mark.parametrize(
    ("named", "is_cut"),
    [
        *(({name: value}, True) for name, value in (
            ("roi", [8, 8, 64, 48]), ("roi", {"x": 8, "y": 0, "width": 64}), ("crop_left", 8),
            ("crop", {"x1": 8, "y1": 0, "x2": 64, "y2": 48}), ("OffsetX", 8), ("y_offset", "4"),
            ("region_of_interest", {"offset_x": 8}), ("binning", 2), ("binning", [1, 2]),
            ("BinningHorizontal", 2), ("binning", "2x2"), ("decimation", 2),
        )),
        *(({name: value}, False) for name, value in (
            ("roi", [0, 0, 160, 120]), ("roi", {"x": 0, "y": 0, "width": 160, "height": 120}),
            ("crop", None), ("crop", False), ("binning", {"x": 1, "y": 1}), ("binning", "1x1"),
            ("binning_x", 1), ("crop_right", 160), ("decimation", 0), ("OffsetY", 0),
        )),
    ],
)  # fmt: skip
def test_parts_of_a_sensor_are_refused_by_any_name(tmp_path, named, is_cut):
    (tmp_path / "camera.json").write_text(json.dumps(PLAIN | named))
    if is_cut:
        with refused("has binning or a roi; give --intrinsics", tmp_path / "camera.json"):
            read_intrinsics(tmp_path)
    else:
        assert read_intrinsics(tmp_path) == Intrinsics(150.0, 140.0, 77.0, 61.0)


SIZES = [
    {"image_size": [848, 480]}, {"image_size": [480, 848]}, {"image_size": "848x480"},
    {"image_size": {"width": 848, "height": 480}}, {"resolution": {"w": 848, "h": 480}},
    {"resolution": "848 × 480 @ 30"}, {"resolution": [848, 480]}, {"shape": [480, 848, 3]},
    {"img_width": 848, "img_height": 480}, {"cols": 848, "rows": 480}, {"w": 848, "h": 480},
    {"width_px": 848, "height_px": 480}, {"imageWidth": 848, "imageHeight": 480},
    {"resolution": [848.0, 480.0]}, {"width": 848.0, "height": 480},
    {"intrinsics": {"image_size": [848, 480], "K": [[430, 0, 424], [0, 430, 240], [0, 0, 1]]}},
]  # fmt: skip


@pytest.mark.parametrize("named", SIZES)
def test_the_size_of_images_is_read_by_any_name(tmp_path, named):
    plain = {"fx": 430, "fy": 430, "cx": 424, "cy": 240} if "intrinsics" not in named else {}
    (tmp_path / "a.json").write_text(json.dumps(plain | named))
    camera = read_intrinsics(tmp_path / "a.json")
    assert (camera.width, camera.height) == (848, 480)
    with pytest.raises(InputError, match="is 640×480 pixels, the camera 848×480"):
        camera.check_size((480, 640), "a.png")


@pytest.mark.parametrize(
    ("named", "words"),
    [
        ({"width": 9, "cols": 8}, "has the width 8 and 9"),
        ({"width": 9, "intrinsics": PLAIN | {"width": 8}}, "has the width 8 and 9"),
        ({"image_size": [160, 120], "height": 121}, "has the height 120 and 121"),
        ({"img_width": "wide"}, "'imgwidth': 'wide' is not a whole number"),
        ({"resolution": ["a", "b"]}, "'resolution': 'a' is not a whole number"),
        ({"resolution": [640.5, 480]}, "'resolution': 640.5 is not a whole number"),
        ({"resolution": [True, [480]]}, "'resolution': True is not a whole number"),
        ({"width": 640.5}, "'width': 640.5 is not a whole number"),
        ({"width": "640"}, "'width': '640' is not a whole number"),
        ({"size": 1024, "resolution": 0.001, "width": 0, "height": 0, "depth_mode": "NFOV"}, ""),
    ],
)
def test_sizes_that_differ_are_refused(tmp_path, named, words):
    (tmp_path / "a.json").write_text(json.dumps(PLAIN | named))
    if words:
        with refused(words, tmp_path / "a.json"):
            read_intrinsics(tmp_path / "a.json")
    else:
        assert read_intrinsics(tmp_path / "a.json").width is None


@pytest.mark.parametrize(
    ("shape", "cx", "cy", "other"),
    [
        ((480, 640), 424, 240, None), ((480, 848), 320, 240, None), ((360, 640), 320, 240, None),
        ((480, 640), 320, 180, None), ((960, 1280), 640, 360, None), ((512, 512), 320, 256, None),
        ((400, 640), 321.7, 238.2, "640×480"), ((800, 1280), 640, 360, "1280×720"),
        ((720, 1280), 646, 398, "1280×800"), ((1080, 1920), 959.5, 599.5, "1920×1200"),
        ((576, 640), 328.9, 337.3, ""),  # an Azure Kinect
        ((424, 512), 258.6, 206.5, ""), ((480, 640), 325.6, 253.7, ""),  # Kinects
        ((720, 1280), 655.1, 355.0, ""), ((400, 400), 216, 204.6, ""),  # T-LESS
    ],
)  # fmt: skip
def test_a_camera_without_a_size_looks_at_the_middle_of_its_images(caplog, shape, cx, cy, other):
    """It is refused far from the middle, and asked about at that of a camera's other mode."""
    TOLD.clear()
    camera = Intrinsics(600.0, 600.0, float(cx), float(cy))
    if other is None:
        with pytest.raises(InputError, match="is not near their middle"):
            camera.check_size(shape, "a.png")
        return
    camera.check_size(shape, "a.png")
    assert bool(caplog.text) == bool(other)
    assert f"is the middle of {other}" in (caplog.text or "is the middle of ")
    caplog.clear()
    TOLD.clear()
    dataclasses.replace(camera, width=shape[1], height=shape[0]).check_size(shape, "a.png")
    assert not caplog.text


def test_a_principal_point_out_of_its_image_is_asked_about(caplog):
    for cx, cy in ((0.0, 0.0), (0.5, 0.5), (-9.0, 60.0), (80.0, 500.0)):
        TOLD.clear()
        caplog.clear()
        Intrinsics(150.0, 140.0, cx, cy, 160, 120).check_size((120, 160), "a.png")
        assert (
            f"principal point {cx:g}, {cy:g} is not in it; if the image is no crop" in caplog.text
        )
    caplog.clear()
    Intrinsics(150.0, 140.0, 20.0, 110.0, 160, 120).check_size((120, 160), "a.png")
    assert not caplog.text


def test_the_middle_of_another_resolution_is_asked_about_though_the_size_is_stated(caplog):
    for cx, cy, other in ((119.5, 89.5, "240×180"), (39.5, 29.5, "80×60"), (119.5, 60.0, "")):
        TOLD.clear()
        caplog.clear()
        Intrinsics(150.0, 140.0, cx, cy, 160, 120).check_size((120, 160), "a.png")
        assert bool(other) == bool(caplog.text)
        assert other in caplog.text


@pytest.mark.parametrize(
    ("cx", "cy", "is_asked"), [(240, 320, True), (320, 240, False), (99, 99, False)]
)
def test_a_principal_point_by_rows_and_columns_is_asked_about(caplog, cx, cy, is_asked):
    TOLD.clear()
    Intrinsics(600.0, 600.0, float(cx), float(cy), 640, 480).check_size((480, 640), "a.png")
    assert (f"a.png: is cx {cx}, and cy {cy}?" in caplog.text) == is_asked


def test_a_yaml_of_endless_aliases_is_refused(tmp_path):
    rows = ["a0: &a0 [1, 2]"]
    rows += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 9)}]" for n in range(1, 9)]
    (tmp_path / "a.yaml").write_text("\n".join([*rows, "K: *a8"]))
    with refused("aliases", tmp_path / "a.yaml"):
        read_intrinsics(tmp_path / "a.yaml")


LENS = [0.4, -0.2, 0.001, -0.002, 0.02, 0.5, -0.1, 0.01]


@pytest.mark.parametrize(
    ("coefficients", "kept"),
    [
        ([*LENS, *[0.0] * 6], 14), ([*LENS, 1e-3, 0, -1e-3, 0, 0.001, 0.002], 14),
        ([*LENS, 1e-3, 0, -1e-3, 0], 12), ([*LENS[:5], 0.0], 5), ([*LENS[:4], *[0.0] * 5], 5),
        ([*LENS[:4]], 4), ([0.0] * 14, 0), ([0.0] * 6, 0),
    ],
)  # fmt: skip
def test_every_list_of_coefficients_that_opencv_has_is_undone(tmp_path, coefficients, kept):
    model = "plumb_bob" if len(coefficients) == 5 else "rational_polynomial"
    table = {"K": MATRIX.tolist(), "D": coefficients, "distortion_model": model}
    (tmp_path / "camera.json").write_text(json.dumps(table))
    camera = read_intrinsics(tmp_path)
    assert len(camera.distortion) == kept
    v, u = np.mgrid[20:100:5, 20:140:5].reshape(2, -1)
    keep = np.zeros((HEIGHT, WIDTH), bool)
    keep[v, u] = True
    points = lift(np.full((HEIGHT, WIDTH), 2, np.float32), keep, camera)
    lens = np.array((coefficients + [0.0] * 14)[:14])
    seen = cv2.projectPoints(points, np.zeros(3), np.zeros(3), MATRIX, lens)[0][:, 0]
    np.testing.assert_allclose(seen, np.argwhere(keep)[:, ::-1], atol=2e-3)


@pytest.mark.parametrize(
    "coefficients", [LENS[:6], LENS[:7], [*LENS, 0.1, 0.1], [*LENS] * 2, [0.1] * 3]
)
def test_other_lists_of_coefficients_are_refused(tmp_path, coefficients):
    (tmp_path / "camera.json").write_text(json.dumps({"K": MATRIX.tolist(), "D": coefficients}))
    with refused("cannot be undone", "camera.json", f"{len(coefficients)} numbers"):
        read_intrinsics(tmp_path)


def test_cameras_as_opencv_and_ros_write_them(tmp_path, caplog):
    mine = cv2.FileStorage(str(tmp_path / "opencv.yaml"), cv2.FILE_STORAGE_WRITE)
    mine.write("image_width", 160)
    mine.write("image_height", 120)
    mine.write("camera_matrix", MATRIX)
    mine.write("distortion_coefficients", np.zeros((1, 5)))
    mine.release()
    head, _, rest = (tmp_path / "opencv.yaml").read_text().partition("\n")
    assert head.startswith("%YAML")
    (tmp_path / "opencv4.yaml").write_text(f"%YAML:1.0\n{rest}")
    calibration = """image_width: 160
image_height: 120
camera_matrix: {rows: 3, cols: 3, data: [150.0, 0.0, 77.0, 0.0, 140.0, 61.0, 0.0, 0.0, 1.0]}
distortion_model: plumb_bob
distortion_coefficients: {rows: 1, cols: 5, data: [0.0, 0.0, 0.0, 0.0, 0.0]}
"""
    (tmp_path / "camera_info.yaml").write_text(calibration)
    expected = Intrinsics(150.0, 140.0, 77.0, 61.0, 160, 120)
    assert read_intrinsics(tmp_path / "opencv.yaml") == expected
    assert read_intrinsics(tmp_path / "opencv4.yaml") == expected
    assert read_intrinsics(tmp_path) == expected  # camera_info.yaml is a name that is looked for
    echoed = "---\n" + f"{calibration}---\n" * 2000 + "{"  # what comes after is not looked at
    for head in ("%YAML 1.1\n", ""):
        (tmp_path / "echo.yaml").write_text(head + echoed)
        assert read_intrinsics(tmp_path / "echo.yaml") == expected
    assert not caplog.text
    small = calibration.replace("[0.0, 0.0", "[0.0, 1e-05")
    plain = {"fx": 150, "fy": 140, "cx": 77, "cy": 61, "width": 160, "height": 120}
    four = {"ppx": 77, "ppy": 61, "coeffs": [1e-5, 0, 0, 0, 0], "model": "BROWN_CONRADY", "D": None}
    plain |= dict.fromkeys(("cx", "cy")) | four
    for name, text in {"bent.yml": small, "bent.json": json.dumps(plain)}.items():
        (tmp_path / name).write_text(text)
        camera = read_intrinsics(tmp_path / name)
        assert dataclasses.replace(camera, distortion=()) == expected
        assert sorted(camera.distortion) == [0, 0, 0, 0, 1e-5]
        assert f"{tmp_path / name}: has lens distortion, which is undone" in caplog.text


@pytest.mark.parametrize("source", ["", "depth", "depth/a.png"])
def test_the_camera_is_the_one_beside_the_images_unless_another_is_named(taken, tmp_path, source):
    shots = shutil.copytree(taken[0], tmp_path / "shots")

    def cloud(name, intrinsics=""):
        settings = DepthImageSettings(intrinsics=intrinsics, mask=shots / "mask" / "a.png")
        out = tmp_path / name
        extract_depth(shots / source, OutputSettings(out=str(out), workers=0), settings)
        return (out / "shard-00000.parquet").read_bytes()

    with pytest.raises(InputError, match="depth alone makes no points"):
        cloud("none")
    (shots / "camera.json").write_text(json.dumps(PLAIN))
    assert cloud("beside") == cloud("named", "{fx},{fy},{cx},{cy}".format(**PLAIN))
    assert cloud("other", "170,160,77,61") != cloud("beside")


def test_bad_cameras_on_the_command_line():
    for text, message in (("0,140,77,61", "must be positive"), ("150,140,77", "give fx,fy,cx,cy"),
                          ("absent.json", "no such file")):  # fmt: skip
        with pytest.raises(InputError, match=message):
            read_intrinsics(text)


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("a.json", "[1, 2", "not a JSON file"),
        ("a.json", '{"fx": 150, "fy": 140, "cx": 77}', "'cy' is missing"),
        ("a.json", '{"fx": 1, "fy": 1, "cx": 7, "cy": 6, "depth_scale": 0}', "must be positive"),
        (
            "a.json",
            '{"fx": 1, "fy": 1, "cx": 7, "cy": 6, "depth_scale": 0.001}',
            "1e-06 m per step of depth is finer .* depth_unit metres",
        ),
        ("a.json", json.dumps(PLAIN | {"roi": {"x_offset": 9}}), "has binning or a roi"),
        ("a.json", json.dumps(PLAIN | {"binning_x": 2}), "has binning or a roi"),
        ("a.json", '{"K": [[9, 0, 4], [0, 9, 4], [0, 0, 1]], "fx": 9, "fy": 9, "cx": 4, "cy": 5}',
         "and the matrix K differ"),
        ("a.json", '{"K": [[1, 0], [0, 1]]}', "K must be 3×3 numbers"),
        ("a.yaml", "K: [1, 2", "cannot be read as a camera"),
        ("a.yaml", "fx:\t600", r"found character '\\t' that cannot start any token"),
        ("a.json", json.dumps([PLAIN]), "give fx,fy,cx,cy, a JSON"),
        ("a.json", "[1, 2]", "must be 3×3 numbers, not 2"),
        ("a.yaml", "K: !!python/object/apply:os.system [ls]", "cannot be read as a camera"),
        *(("a.yaml", f"cam0:\n  camera_model: {model}\n  intrinsics: [1.2, 0.5, 150, 140, 77, 61]",
           f"the lens model {model}, which is no pinhole") for model in ("omni", "ds", "eucm")),
        ("a.json", '{"fx": 150, "fy": 140, "cx": 77, "cy": 61, "fx": 15}', "'fx' has two values"),
        ("a.json", '{"K": {"fx": 150, "fx": 15}}', "'fx' has two values; remove one"),
        ("a.yaml", "fx: 150\nfy: 140\ncx: 77\ncy: 61\nfx: 15", "'fx' has two values; remove one"),
        ("a.yaml", "K: {fx: 150, fy: 140, fx: 15}", "'fx' has two values"),
        ("a.txt", "150 0 0 0 140 0 77 61 1", "row by row"),
        ("a.txt", "150 3 77 0 140 61 0 0 1", "skew"),
        ("a.txt", "1 2 3", "must be 3×3 numbers, not 3"),
        ("a.csv", "Frame Info:\nType,Depth\nFx,425.1\nFy,425.1", "words.*give fx,fy,cx,cy"),
        ("a.xml", '<?xml version="1.0"?><opencv_storage/>', "FileStorage write it .*yaml"),
    ],
)  # fmt: skip
def test_bad_camera_files_are_refused_by_name(tmp_path, name, text, message):
    path = tmp_path / name
    path.write_text(text, encoding="utf-8")
    with refused(message, path):
        read_intrinsics(path)


def encoded(ending, image):
    return cv2.imencode(ending, image)[1].tobytes()


GREY16 = np.arange(600, dtype=np.uint16).reshape(20, 30)
BAD_IMAGES = {
    "huge.png": (png_bytes(60000, 60000), "damaged"),
    "grey8.png": (encoded(".png", GREY16.astype(np.uint8)), "8 bits.*save depth as 16-bit PNG"),
    "colour.png": (encoded(".png", np.zeros((4, 4, 3), np.uint8)), "colour picture"),
    "short.png": (encoded(".png", GREY16)[:-30], "cut off"),
    "rgb16.png": (encoded(".png", np.zeros((4, 4, 3), np.uint16)), "colour picture"),
    "pages.tif": (cv2.imencodemulti(".tiff", [GREY16, GREY16])[1].tobytes(), "several pictures"),
    "jpeg.png": (encoded(".jpg", GREY16.astype(np.uint8)), "it is a JPEG image"),
    "text.npy": (b"depth", "cannot be read"),
    "depth.exr": (b"v/1\1", "not an image of a depth camera"),
}


@pytest.mark.parametrize("name", BAD_IMAGES)
def test_bad_images_are_refused_by_name(tmp_path, name, capfd):
    content, message = BAD_IMAGES[name]
    path = tmp_path / name
    path.write_bytes(content)
    with refused(message, path):
        read_depth(path)
    assert capfd.readouterr().err == ""
    if not name.startswith(("grey8", "colour", "rgb16")):
        with pytest.raises(InputError):
            read_mask(path)


def test_masks_of_another_size_or_kind_are_refused(tmp_path):
    write_png(tmp_path / "mask.png", np.ones((120, 161), np.uint8))
    with pytest.raises(InputError, match=r"mask.png: is 161×120 pixels, the depth image 160×120"):
        read_mask(tmp_path / "mask.png", (120, 160))
    np.save(tmp_path / "big.npy", np.full((2, 2), 2**40))
    with pytest.raises(InputError, match="beyond 32 bits"):
        read_mask(tmp_path / "big.npy")
    np.save(tmp_path / "pickle.npy", np.array([[None, 1]]), allow_pickle=True)
    with refused("allow_pickle", "pickle.npy"):
        read_mask(tmp_path / "pickle.npy")
    np.save(tmp_path / "bool.npy", np.eye(2, dtype=bool))
    assert read_mask(tmp_path / "bool.npy").tolist() == [[1, 0], [0, 1]]
    np.save(tmp_path / "sam.npy", np.eye(2, dtype=bool)[None])
    assert read_mask(tmp_path / "sam.npy").tolist() == [[1, 0], [0, 1]]


def test_a_mask_may_be_called_mask_where_its_image_is_called_depth(tmp_path):
    def masks_of(name):
        (tmp_path / f"{name}.png").touch()
        (frame,) = list_frames(
            tmp_path / f"{name}.png", CAMERA, tmp_path / "masks", (0.0, 1.0, 0.0)
        )
        return [each.mask.stem for each in frame.objects]

    (tmp_path / "masks").mkdir()
    for name in ("cam1_7-label", "cam2_7-label", "seg_8", "left_9", "right_9"):
        (tmp_path / "masks" / f"{name}.png").touch()
    assert masks_of("cam2_7_depth") == ["cam2_7-label"]
    assert masks_of("depth_8") == ["seg_8"]
    assert masks_of("right_9") == ["right_9"]
    for name in ("depth_10_mask", "Image0012.Instances", "frame-13.depth_segmentation"):
        (tmp_path / "masks" / f"{name}.png").touch()
        assert masks_of(re.match(r".*(?=[._])", name)[0]) == [name]
    for name in ("rgb_11_mask", "labels", "ir_5", "confidence_6", "rgb", "depth_mask_11"):
        (tmp_path / "masks" / f"{name}.png").touch()
    assert masks_of("depth") == ["labels"]
    (tmp_path / "masks" / "labels.png").unlink()
    (tmp_path / "masks" / "mask_8.png").touch()
    for name in ("depth_8", "7_depth", "9", "depth_18", "depth_5", "depth_6", "depth", "depth_11"):
        with refused(f"no mask {name}.png", tmp_path / "masks"):
            masks_of(name)


def test_no_image_is_its_own_mask(tmp_path):
    for name in ("depth_4.png", "mask_4.png", "4.png", "depth_5.png", "5.png"):
        write_png(tmp_path / name, np.eye(4, dtype=np.uint16))
    depth = tmp_path / "depth_4.png"
    (frame,) = list_frames(depth, CAMERA, tmp_path, (0.0, 1.0, 0.0))
    assert frame.objects[0].mask.name == "mask_4.png"
    for source, mask, words in (
        (depth, depth, "is the depth image and no mask of it"),
        (tmp_path, tmp_path, "holds depth_5.png itself and no mask depth_5_mask.png of it"),
    ):
        with refused(words, mask):
            list_frames(source, CAMERA, mask, (0.0, 1.0, 0.0))


def test_no_mask_is_of_two_images(tmp_path):
    (tmp_path / "masks").mkdir()
    for name in ("4.png", "raw_4.png", "masks/mask_4.png"):
        (tmp_path / name).touch()
    with refused("have the same mask; give each its own", "4.png", "raw_4.png"):
        list_frames(tmp_path, CAMERA, tmp_path / "masks", (0.0, 1.0, 0.0))


def test_a_folder_of_masks_is_listed_once_for_all_images(tmp_path, monkeypatch):
    (tmp_path / "masks").mkdir()
    for k in range(20):
        (tmp_path / f"depth_{k}.png").touch()
        (tmp_path / "masks" / f"mask_{k}.png").touch()
    listed = []
    monkeypatch.setattr(images, "list_files", lambda *a: listed.append(a[0]) or list_files(*a))
    frames = list_frames(tmp_path, CAMERA, tmp_path / "masks", (0.0, 1.0, 0.0))
    assert [frame.objects[0].mask.stem for frame in frames] == [f"mask_{k}" for k in range(20)]
    assert listed == [tmp_path, tmp_path / "masks"]


def test_a_folder_goes_with_a_folder_of_masks(tmp_path):
    for name in ("b.png", "a.png", ".hidden.png", "c.npy", "note.txt"):
        (tmp_path / name).write_bytes(b"")
    (tmp_path / "masks").mkdir()
    for name in ("a.png", "b.tif", "c.png"):
        (tmp_path / "masks" / name).write_bytes(b"")

    def listed(source, mask=tmp_path / "masks"):
        return list_frames(source, CAMERA, mask, (0.0, 1.0, 0.0))

    frames = listed(tmp_path, tmp_path / "masks")
    assert [(frame.id, frame.objects[0].mask.name) for frame in frames] == [
        ("a", "a.png"), ("b", "b.tif"), ("c", "c.png"),
    ]  # fmt: skip
    with pytest.raises(InputError, match="one mask for 3 depth images"):
        listed(tmp_path, tmp_path / "masks" / "a.png")
    (tmp_path / "masks" / "c.png").unlink()
    (tmp_path / "masks" / "c.jpg").write_bytes(b"")
    with pytest.raises(InputError, match=r"no mask c\.png .*; c\.jpg is none of \.png, \.tif"):
        listed(tmp_path, tmp_path / "masks")
    (tmp_path / "a.tif").write_bytes(b"")
    with pytest.raises(InputError, match="same name"):
        listed(tmp_path)
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="no depth image"):
        listed(tmp_path / "empty")
    with pytest.raises(InputError, match="no such file"):
        listed(tmp_path / "absent")


def test_masks_go_with_images_in_either_form_of_unicode(tmp_path):
    """macOS hands out names decomposed."""
    (tmp_path / "masks").mkdir()
    for first, second in (("NFD", "NFC"), ("NFC", "NFD")):
        image = tmp_path / (unicodedata.normalize(first, f"Größe {first}") + ".png")
        mask = tmp_path / "masks" / (unicodedata.normalize(second, f"Größe {first}") + ".png")
        image.write_bytes(b"")
        mask.write_bytes(b"")
        (frame,) = list_frames(image, CAMERA, tmp_path / "masks", (0.0, 1.0, 0.0))
        assert frame.objects[0].mask == mask


def test_bad_tables_of_classes_are_refused(tmp_path):
    fault = "needs a name, none twice, and a class"
    for text, message in (("a,b\n1,2\n", "name,class"), ("name,class\n", fault),
                          ("name,class\na,chair\na,table\n", fault),
                          ("name,class\na,\n", fault), ("name,class\n,b\n", fault)):  # fmt: skip
        (tmp_path / "names.csv").write_text(text, encoding="utf-8")
        with pytest.raises(InputError, match=message):
            read_names(tmp_path / "names.csv")


def test_settings_out_of_range_are_refused():
    for bad in ({"near": 2.0, "far": 1.0}, {"far": float("nan")}, {"erode": -1}):
        with pytest.raises(InputError):
            CutSettings(**bad)
    with pytest.raises(InputError):
        DepthImageSettings(gravity=(0.0, 0.0, 0.0))
