"""Frames read back as a stranger would: by the JSON files and the pictures alone."""

import dataclasses
import json

import cv2
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from qs3 import shapes
from qs3.errors import InputError
from qs3.meshes import sample_surface
from qs3.sensor.bop import depth_scale, encode_depth, remove_frames, write_frames
from qs3.sensor.depth import DepthSettings
from qs3.sensor.scan import scan

from ..sensors import METRIC

KINDS = ("ir_left", "ir_right", "depth", "depth_true", "normals", "mask", "mask_visib")


@pytest.fixture(scope="module")
def scanned(renderer):
    return scan(
        shapes.make("chair", seed=1),
        sensor=METRIC,
        views=2,
        seed=5,
        scene="room+behind",
        neighbour=shapes.make("table", seed=3),
        num_points=1024,
        renderer=renderer,
        full_frames=True,
    )


@pytest.fixture(scope="module")
def folder(scanned, tmp_path_factory):
    out = tmp_path_factory.mktemp("frames")
    write_frames(out, scanned)
    return out


def picture(folder, kind, view):
    end = "_000000" if kind.startswith("mask") else ""
    path = folder / "000000" / kind / f"{view:06d}{end}.png"
    found = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert found is not None, path
    return found


def read(folder, name):
    return json.loads((folder / "000000" / f"scene_{name}.json").read_text())


def lifted(folder, kind, view, mask=None):
    """Points of a depth picture in the model's frame, in millimetres."""
    camera, truth = read(folder, "camera")[str(view)], read(folder, "gt")[str(view)][0]
    z = picture(folder, kind, view) * camera["depth_scale"]
    keep = (z > 0) if mask is None else (z > 0) & mask
    v, u = np.nonzero(keep)
    matrix = np.array(camera["cam_K"]).reshape(3, 3)
    local = z[keep][:, None] * np.stack([u, v, np.ones(len(u))], axis=1) @ np.linalg.inv(matrix).T
    rotation = np.array(truth["cam_R_m2c"]).reshape(3, 3)
    return (local - truth["cam_t_m2c"]) @ rotation


def test_every_picture_has_the_frames_size_and_type(folder):
    for view in (0, 1):
        for kind in KINDS:
            found = picture(folder, kind, view)
            assert found.shape[:2] == (300, 400)
            wide = kind in ("depth", "depth_true", "normals")
            assert found.dtype == (np.uint16 if wide else np.uint8)
    assert not list((folder / "000000").glob("*/000002*"))


def test_convention_true_depth_lies_on_the_model_within_quantisation(folder):
    mesh = trimesh.load_mesh(folder / "models" / "obj_000001.ply")
    assert mesh.extents.max() == pytest.approx(500, abs=0.01)
    for view in (0, 1):
        visible = picture(folder, "mask_visib", view) > 0
        points = lifted(folder, "depth_true", view, visible)
        assert len(points) > 1000
        distance = trimesh.proximity.closest_point(mesh, points[::29])[1]
        # Half a step of 0.1 mm along a ray that is a little longer than the axis.
        assert distance.max() < 0.5 * 0.1 * 1.2


def test_convention_depth_lies_on_model_and_cloud_within_the_noise(folder, scanned):
    mesh = trimesh.load_mesh(folder / "models" / "obj_000001.ply")
    dense = cKDTree(sample_surface(mesh, 100_000, np.random.default_rng(0)))
    for view, statistics in enumerate(scanned.views):
        visible = picture(folder, "mask_visib", view) > 0
        distance = dense.query(lifted(folder, "depth", view, visible))[0]
        sigma = 1100**2 * statistics.disparity_sigma / (420 * 90)
        assert np.median(distance) < 1.5 * sigma
        # The scan's own points of that view are among them, to half a step.
        cloud = scanned.points[scanned.view == view] * 1000
        whole = cKDTree(lifted(folder, "depth", view))
        assert whole.query(cloud)[0].max() < 0.5 * 0.1 * 1.2


def test_convention_world_and_model_poses_agree(folder, scanned):
    for view, pose in enumerate(scanned.poses):
        camera, truth = read(folder, "camera")[str(view)], read(folder, "gt")[str(view)][0]
        rotation = np.array(camera["cam_R_w2c"]).reshape(3, 3)
        np.testing.assert_allclose(
            -rotation.T @ camera["cam_t_w2c"], pose.position * 1000, atol=1e-6
        )
        turn = rotation.T @ np.array(truth["cam_R_m2c"]).reshape(3, 3)
        assert np.arctan2(turn[1, 0], turn[0, 0]) % (2 * np.pi) == pytest.approx(scanned.yaw)
        np.testing.assert_allclose(camera["cam_t_w2c"], truth["cam_t_m2c"])


def test_convention_normals_are_those_of_the_depth(folder):
    camera = read(folder, "camera")["0"]
    z = picture(folder, "depth_true", 0) * camera["depth_scale"]
    stored = picture(folder, "normals", 0)[..., ::-1] / 32767.5 - 1
    v, u = np.mgrid[:300, :400]
    fx, cx, cy = camera["cam_K"][0], camera["cam_K"][2], camera["cam_K"][5]
    points = np.stack([(u - cx) * z / fx, (v - cy) * z / fx, z], axis=-1)
    # Over four pixels, so that steps of 0.1 mm weigh little.
    across, down = points[2:-2, 4:] - points[2:-2, :-4], points[4:, 2:-2] - points[:-4, 2:-2]
    normal = np.cross(across, down)
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True).clip(1e-9)
    normal *= -np.sign((normal * points[2:-2, 2:-2]).sum(axis=-1, keepdims=True))
    inner = stored[2:-2, 2:-2]
    # Away from edges, where neighbouring pixels have one normal.
    flat = np.ones(inner.shape[:2], dtype=bool)
    for shift in ((0, 2), (4, 2), (2, 0), (2, 4)):
        other = stored[shift[0] : shift[0] + 296, shift[1] : shift[1] + 396]
        flat &= (other * inner).sum(axis=-1) > 0.9999
    flat &= (picture(folder, "depth_true", 0) > 0)[2:-2, 2:-2]
    assert flat.mean() > 0.5
    angle = np.degrees(np.arccos((normal * inner).sum(axis=-1).clip(-1, 1)))
    assert np.percentile(angle[flat], 95) < 3
    np.testing.assert_allclose(np.linalg.norm(inner[flat], axis=-1), 1, atol=1e-4)


def test_masks_boxes_and_counts_agree(folder):
    for view in (0, 1):
        facts = read(folder, "gt_info")[str(view)][0]
        whole, seen = (picture(folder, k, view) > 0 for k in ("mask", "mask_visib"))
        assert not (seen & ~whole).any()
        assert facts["px_count_all"] == whole.sum()
        assert facts["px_count_visib"] == seen.sum()
        assert facts["visib_fract"] == pytest.approx(seen.sum() / whole.sum())
        assert facts["px_count_valid"] == (whole & (picture(folder, "depth", view) > 0)).sum()
        for key, mask in (("bbox_obj", whole), ("bbox_visib", seen)):
            x, y, width, height = facts[key]
            assert mask[y : y + height, x : x + width].sum() == mask.sum()
            for edge in (mask[y], mask[y + height - 1], mask[:, x], mask[:, x + width - 1]):
                assert edge.any()
    assert read(folder, "gt_info")["0"][0]["visib_fract"] == pytest.approx(0.7, abs=0.12)


def test_a_second_scan_leaves_no_picture_of_the_first(folder, scanned, tmp_path):
    write_frames(tmp_path, scanned)
    one = dataclasses.replace(scanned, images=scanned.images[:1], poses=scanned.poses[:1])
    write_frames(tmp_path, one)
    assert len(list(tmp_path.glob("000000/*/*.png"))) == len(KINDS)


def test_frames_are_removed_but_nobody_elses_files_and_no_link_is_followed(scanned, tmp_path):
    frames, other = tmp_path / "frames", tmp_path / "other"
    write_frames(frames, scanned)
    write_frames(other, scanned)
    kept = sorted(other.rglob("*"))
    remove_frames(frames)
    assert not frames.exists()
    remove_frames(frames)
    write_frames(frames, scanned)
    (frames / "000000" / "notes.txt").write_text("x")
    (frames / "000000" / "more").symlink_to(other / "000000" / "depth")
    remove_frames(frames)
    assert [path.name for path in frames.rglob("*")] == ["000000", "notes.txt"]
    link = tmp_path / "link"
    link.symlink_to(other)
    with pytest.raises(InputError, match="is a link"):
        remove_frames(link)
    assert sorted(other.rglob("*")) == kept


def test_frames_that_were_not_written_to_the_end_have_no_json(scanned, tmp_path, monkeypatch):
    write_frames(tmp_path, scanned)
    monkeypatch.setattr("qs3.sensor.bop.encode_depth", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        write_frames(tmp_path, scanned)
    assert not list(tmp_path.glob("000000/*.json"))


def test_a_scan_without_whole_frames_is_refused(scanned, tmp_path):
    bare = dataclasses.replace(scanned, images=())
    with pytest.raises(InputError, match="full_frames"):
        write_frames(tmp_path, bare)


def test_an_object_alone_gives_the_same_cloud_with_and_without_frames(renderer):
    box = trimesh.creation.box(extents=[1.0, 0.8, 0.6])
    alone = {"sensor": METRIC, "views": 1, "seed": 1, "num_points": 500, "renderer": renderer}
    whole, part = (scan(box, full_frames=f, **alone) for f in (True, False))
    np.testing.assert_array_equal(whole.points, part.points)
    np.testing.assert_array_equal(whole.clean, part.clean)
    assert whole.views == part.views
    assert whole.images[0].left.shape == (300, 400)


def test_depth_beyond_the_picture_is_none():
    assert encode_depth(np.array([[6.5534, 6.5535, -1.0]]), 0.1).tolist() == [[65534, 0, 0]]
    far = dataclasses.replace(METRIC, depth=DepthSettings(far=12.0))
    assert depth_scale(far) == 1.0
