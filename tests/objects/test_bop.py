"""Scenes in BOP's layout: one written here by hand, and one that our own scan writes."""

import json
import shutil

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from qs3 import shapes
from qs3.errors import TOLD, InputError
from qs3.geometry import rotation_z
from qs3.meshes import sample_surface
from qs3.objects.bop import bop_scenes, class_of, list_bop_frames, list_bop_pictures
from qs3.objects.depth import DepthImageSettings, cut_frame, extract_depth
from qs3.objects.run import OutputSettings
from qs3.sensor.bop import write_frames
from qs3.sensor.light.mitsuba import MitsubaRenderer
from qs3.sensor.scan import scan

from ..clouds.hostile import refused
from ..sensors import METRIC
from .depth_scene import MATRIX, camera_to_world, off_surface, photograph, thing, write_png

PLACE = np.eye(4)
PLACE[:3, :3] = rotation_z(0.7)
PLACE[:3, 3] = [0.1, -0.05, 0.0]


def moved(mesh, pose):
    copied = mesh.copy()
    copied.apply_transform(pose)
    return copied


def millimetres(pose, kind):
    return {
        f"cam_R_{kind}": pose[:3, :3].ravel().tolist(),
        f"cam_t_{kind}": (pose[:3, 3] * 1000).tolist(),
    }


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    """The thing, placed in a world, from two sides; a second object is hidden in both."""
    folder = tmp_path_factory.mktemp("bop") / "000042"
    cameras, truth = {}, {}
    for image, (yaw, down) in enumerate([(30, 20), (150, 35)]):
        pose = camera_to_world(yaw, down)
        depth, face = photograph(moved(thing(), PLACE), pose)
        write_png(folder / "depth" / f"{image:06d}.png", np.rint(depth * 10000).astype(np.uint16))
        mask = ((face >= 0) * 255).astype(np.uint8)
        write_png(folder / "mask_visib" / f"{image:06d}_000000.png", mask)
        write_png(folder / "mask_visib" / f"{image:06d}_000001.png", mask * 0)
        to_camera = np.linalg.inv(pose)
        cameras[image] = {"cam_K": MATRIX.ravel().tolist(), "depth_scale": 0.1}
        cameras[image] |= millimetres(to_camera, "w2c")
        model = millimetres(to_camera @ PLACE, "m2c")
        truth[image] = [{"obj_id": 5, **model}, {"obj_id": 7, **model}]
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    (folder / "scene_gt.json").write_text(json.dumps(truth))
    return folder


def clouds(source, frame="world", names=None, **more):
    settings = DepthImageSettings(frame=frame, **more)
    frames, _ = list_bop_frames(source, settings, names or {})
    return [cloud for listed in frames for cloud in cut_frame(listed, settings, {})]


def test_convention_views_meet_in_the_world_and_in_the_models_axes(scene):
    for frame, mesh in (("world", moved(thing(), PLACE)), ("model", thing())):
        cut = clouds(scene, frame=frame)
        assert [cloud.id for cloud in cut] == ["000042/000000/000000", "000042/000001/000000"]
        for cloud in cut:
            assert cloud.points.dtype == np.float32
            assert len(cloud.points) > 1000
            # A twentieth of a millimetre along a ray that is at most 1.2 times its depth.
            assert off_surface(mesh, cloud.points[::7]).max() < 0.00005 * 1.2
        mirrored = cut[0].points[::7] * [-1, 1, 1]
        assert off_surface(mesh, mirrored).max() > 0.05


def test_convention_the_cameras_axes_are_upright(scene):
    (cloud, _) = clouds(scene, frame="camera")
    (world, _) = clouds(scene)
    to_camera = np.linalg.inv(camera_to_world(30, 20))
    x, y, z = (world.points @ to_camera[:3, :3].T + to_camera[:3, 3]).T
    np.testing.assert_allclose(cloud.points, np.stack([x, z, -y], axis=1), atol=1e-5)


def test_classes_come_from_the_table_then_the_option_then_the_model():
    for names, option, expected in (
        ({"obj_000005": "chair"}, "x", "chair"),
        ({"5": "sofa"}, "x", "sofa"),
        ({}, "x", "x"),
        ({}, "", "obj_000005"),
    ):
        assert class_of(5, DepthImageSettings(class_name=option), names) == expected


@pytest.mark.parametrize(
    ("row", "words"),
    [("6", "is called 6, and obj_000005 has no row"), ("obj_5", "called obj_5"), ("5", "")],
)
def test_rows_of_models_that_are_not_there_are_refused(scene, tmp_path, row, words):
    (tmp_path / "t.csv").write_text(f"name,class\n{row},chair\n")
    settings = DepthImageSettings(names=tmp_path / "t.csv")
    out = OutputSettings(out=str(tmp_path / "data"), workers=0)
    if words:
        with refused(words, "t.csv: nothing here"):
            extract_depth(scene, out, settings)
    else:
        assert extract_depth(scene, out, settings).failed == 0


def test_a_folder_of_scenes_is_all_its_scenes(scene, tmp_path):
    for name in ("10", "2"):
        shutil.copytree(scene, tmp_path / name)
    assert bop_scenes(tmp_path)
    assert not bop_scenes(tmp_path / "2" / "depth")
    frames = list_bop_frames(tmp_path, DepthImageSettings(), {})[0]
    assert [f.id for f in frames] == ["2/000000", "2/000001", "10/000000", "10/000001"]


def test_depth_is_a_tiff_too_and_each_image_has_its_camera(scene, tmp_path):
    wanted = clouds(scene)
    shutil.copytree(scene, tmp_path / "000042")
    folder, steps = tmp_path / "000042", cv2.IMREAD_UNCHANGED
    for number, ending in ((0, "tif"), (1, "tiff")):
        old = folder / "depth" / f"{number:06d}.png"
        cv2.imwrite(
            str(old.with_suffix(f".{ending}")), cv2.imread(str(old), steps)[:, :150] // (1 + number)
        )
        old.unlink()
        for i in (0, 1):
            mask = folder / "mask_visib" / f"{number:06d}_{i:06d}.png"
            cv2.imwrite(str(mask), cv2.imread(str(mask), steps)[:, :150])
    cameras = json.loads((folder / "scene_camera.json").read_text())
    cameras["0"] |= {"width": 150, "height": 120}
    cameras["1"]["depth_scale"] = 0.2
    (folder / "scene_camera.json").write_text(json.dumps(cameras))
    for one, other in zip(wanted, clouds(tmp_path), strict=True):
        assert len(one.points) == len(other.points)
        np.testing.assert_allclose(one.points, other.points, atol=2e-4)
    shutil.copy(scene / "depth" / "000000.png", folder / "depth")
    with refused("has the same name", folder / "depth" / "000000.tif"):
        clouds(tmp_path)


@pytest.fixture(scope="module")
def scanned(tmp_path_factory):
    result = scan(
        shapes.make("chair", seed=1),
        sensor=METRIC,
        views=2,
        seed=5,
        num_points=1024,
        renderer=MitsubaRenderer(variant="scalar_rgb", samples=2),
        full_frames=True,
    )
    folder = tmp_path_factory.mktemp("scan") / "frames"
    write_frames(folder, result)
    return folder, result


def test_convention_our_own_frames_lie_on_the_mesh_again(scanned):
    folder, result = scanned
    mesh = trimesh.load_mesh(folder / "models" / "obj_000001.ply")
    mesh.apply_scale(0.001)
    turn = np.eye(4)
    turn[:3, :3] = rotation_z(result.yaw)
    for frame, surface in (("model", mesh), ("world", moved(mesh, turn))):
        true = clouds(folder, frame=frame, depth_folder="depth_true")
        assert len(true) == 2
        for cloud in true:
            # Half a step of 0.1 mm along a ray that is a little longer than the axis.
            assert off_surface(surface, cloud.points[::9]).max() < 0.5 * 0.0001 * 1.25
        dense = cKDTree(sample_surface(surface, 50_000, np.random.default_rng(0)))
        for cloud, statistics in zip(clouds(folder, frame=frame), result.views, strict=True):
            assert len(cloud.points) > 1000
            sigma = 1.1**2 * statistics.disparity_sigma / (METRIC.rig.focal * METRIC.rig.baseline)
            assert np.median(dense.query(cloud.points)[0]) < 1.5 * sigma + 0.001


def spoil(scene, tmp_path, name, change):
    shutil.copytree(scene, tmp_path / "scene")
    path = tmp_path / "scene" / name
    value = json.loads(path.read_text())
    changed = change(value)
    path.write_text(json.dumps(changed if changed is not None else value))
    return tmp_path / "scene"


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("scene_camera.json", lambda v: [v], "cannot be read as a scene of BOP"),
        ("scene_camera.json", lambda v: v["1"].update(depth_scale=None), "depth_scale"),
        ("scene_camera.json", lambda v: v["0"].update(cam_R_w2c=[1] * 9), "is no rotation"),
        ("scene_camera.json", lambda v: v["0"].update(cam_t_w2c=[1, 2]), "t_w2c has 2 numbers"),
        ("scene_camera.json", lambda v: v["0"].update(cam_t_w2c=[1e290, 0, 0]), "beyond 1,000 km"),
        ("scene_gt.json", lambda v: {"0": [{}]}, "obj_id.*missing"),
        ("scene_gt.json", lambda v: {"0": [{"obj_id": 1}] * 3}, r"000000_000002\.png"),
    ],
)  # fmt: skip
def test_damaged_scenes_are_refused_by_name(scene, tmp_path, name, change, message):
    source = spoil(scene, tmp_path, name, change)
    with refused(message, "scene"):
        clouds(source)


def drop(*names):
    def change(value):
        for image in value.values():
            for entry in image if isinstance(image, list) else [image]:
                for name in names:
                    entry.pop(name)

    return change


def test_axes_that_no_file_tells_are_refused(scene, tmp_path):
    source = spoil(scene, tmp_path, "scene_camera.json", drop("cam_R_w2c", "cam_t_w2c"))
    with pytest.raises(InputError, match="image 0: has no cam_R_w2c"):
        clouds(source)
    assert len(clouds(source, frame="camera")) == 2
    (tmp_path / "scene" / "scene_gt.json").unlink()
    with pytest.raises(InputError, match=r"scene_gt\.json: no such file"):
        clouds(source)


def test_places_of_parts_in_metres_are_refused(scene, tmp_path):
    def in_metres(truth):
        for part in truth["0"]:
            part["cam_t_m2c"] = [length / 1000 for length in part["cam_t_m2c"]]

    source = spoil(scene, tmp_path, "scene_gt.json", in_metres)
    with refused("image 0, object 0: cam_t_m2c is .* mm long, .* in millimetres", "scene_gt.json"):
        clouds(source, frame="model")


def test_places_of_cameras_that_are_likely_in_metres_are_asked_about(scene, tmp_path, caplog):
    for length, asked in ((0.001, True), (0.0, False), (1.0, False)):
        TOLD.clear()
        caplog.clear()

        def scaled(cameras, length=length):
            for camera in cameras.values():
                camera["cam_t_w2c"] = [length * number for number in camera["cam_t_w2c"]]

        clouds(spoil(scene, tmp_path / str(length), "scene_camera.json", scaled))
        assert ("mm long; if that is metres, write millimetres" in caplog.text) == asked


def test_folders_of_pictures_are_names_and_no_paths():
    for name in ("../depth", "/etc", ""):
        with pytest.raises(InputError, match="is no folder of a scene"):
            DepthImageSettings(depth_folder=name)


def test_the_cameras_of_a_scene_have_names_with_their_endings(scene, tmp_path, caplog):
    """As BOP-Industrial names them."""
    TOLD.clear()
    place = tmp_path / scene.name
    for end in ("_cam1", "_cam2"):
        for name in ("depth", "mask_visib"):
            shutil.copytree(scene / name, place / (name + end))
        for name in ("scene_camera", "scene_gt"):
            shutil.copy(scene / f"{name}.json", place / f"{name}{end}.json")
    shutil.copy(scene / "scene_camera.json", place / "scene_camera_photoneo.json")
    (place / "scene_camera_info").mkdir()
    assert bop_scenes(place) == bop_scenes(tmp_path) == [place]
    one = clouds(scene)
    both = clouds(place)
    ids = [f"000042_cam{camera}/{image:06d}/000000" for camera in (1, 2) for image in (0, 1)]
    assert [cloud.id for cloud in both] == ids
    for cloud, other in zip([*one, *one], both, strict=True):
        np.testing.assert_array_equal(cloud.points, other.points)
    assert "scene_camera_photoneo.json: left out, as depth_photoneo is missing" in caplog.text
    out = OutputSettings(str(tmp_path / "data"), workers=0)
    assert extract_depth(place, out, DepthImageSettings()).objects == 4


@pytest.mark.parametrize("table", ["scene_camera.json", "scene_gt.json"])
def test_pictures_that_a_table_lacks_are_reported(scene, tmp_path, caplog, table):
    TOLD.clear()
    copy = shutil.copytree(scene, tmp_path / "000042")
    assert len(clouds(copy)) == 2
    assert not caplog.text
    entries = json.loads((copy / table).read_text())
    del entries["1"]
    (copy / table).write_text(json.dumps(entries))
    assert len(clouds(copy)) == 1
    assert f"{table}: has no entry for 000001 in depth; left out" in caplog.text
    TOLD.clear()
    caplog.clear()
    assert len(list_bop_pictures(copy)) == (1 if "camera" in table else 2)
    assert ("no entry for 000001" in caplog.text) == ("camera" in table)


def test_depth_of_a_wrong_unit_names_the_scenes_own_scale(scene, tmp_path):
    place = tmp_path / "000001"
    shutil.copytree(scene, place)
    cameras = json.loads((scene / "scene_camera.json").read_text())
    text = json.dumps({key: camera | {"depth_scale": 40.0} for key, camera in cameras.items()})
    (place / "scene_camera.json").write_text(text)
    with refused("correct depth_scale, millimetres per step, in scene_camera.json"):
        clouds(place)
