"""SUN RGB-D: a synthetic release whose scene is known, read by each of its lists of boxes."""

import dataclasses
import json
import shutil

import numpy as np
import pytest
from scipy.io import savemat

from qs3.errors import InputError
from qs3.io.extract.cut import CutSettings, OrientedBox, inside_box
from qs3.io.extract.sunrgbd import SunRgbdSettings, cut_frame, decode_depth
from qs3.io.extract.sunrgbd_lists import below, list_sunrgbd, rename_to

from ..hostile import fuzz, refused
from .depth_scene import off_surface
from .sun_writers import FRAMES, meta_row, placed, structs, truth, write_sunrgbd

CHAIR = rename_to(["chair"])


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sun")
    write_sunrgbd(folder)
    return folder


@pytest.fixture
def bare(root, tmp_path):
    """The frames alone, to be spoilt."""
    shutil.copytree(root / "SUNRGBD", tmp_path / "SUNRGBD")
    return tmp_path / "SUNRGBD"


def clouds(frames, **more):
    return [cloud for frame in frames for cloud in cut_frame(frame, SunRgbdSettings(**more))]


def test_convention_points_stand_on_the_thing_in_the_world_and_not_mirrored(root):
    cut = clouds(list_sunrgbd(root, rename=CHAIR))
    assert [cloud.id for cloud in cut] == [f"{FRAMES[0]}/000", f"{FRAMES[1]}/000"]
    for index, cloud in enumerate(cut):
        assert cloud.class_name == "chair"
        assert len(cloud.points) > 500
        mesh = placed(index)
        # The box is tight: floor at its lower face is all that may come with the thing.
        above = cloud.points[cloud.points[:, 2] > mesh.bounds[0, 2] + 0.002]
        assert len(above) > 500
        assert off_surface(mesh, above).max() < 0.0005 * 1.3
        mirrored = above * [-1, 1, 1] + [2 * mesh.bounds.mean(axis=0)[0], 0, 0]
        assert off_surface(mesh, mirrored).mean() > 0.02


def test_three_lists_of_boxes_give_the_same_clouds(root, bare):
    by_mat = clouds(list_sunrgbd(root / "SUNRGBD", root / "SUNRGBDMeta3DBB_v2.mat", rename=CHAIR))
    by_json = clouds(list_sunrgbd(root, root / "boxes.json", rename=CHAIR))
    by_frame = clouds(list_sunrgbd(bare, rename=CHAIR), margin=1e-6)
    for mat, jsoned, own in zip(by_mat, by_json, by_frame, strict=True):
        assert mat.id == jsoned.id
        assert own.id == mat.id.removesuffix("/000") + "/002"  # counted with the walls
        np.testing.assert_allclose(mat.points, jsoned.points, atol=1e-6)
        assert abs(len(own.points) - len(mat.points)) <= 3
        np.testing.assert_allclose(np.sort(own.points[:, 2])[-99:], np.sort(mat.points[:, 2])[-99:],
                                   atol=1e-5)  # fmt: skip
        np.testing.assert_allclose(own.source["coeffs"], truth(0)["coeffs"], atol=1e-9)


def test_convention_bits_are_turned_as_the_toolbox_does():
    steps = np.arange(65536, dtype=np.uint16).reshape(256, 256)
    words = steps.astype(np.uint32)
    expected = (((words >> 3) | (words << 13)) & 0xFFFF) / 1000
    np.testing.assert_allclose(np.nan_to_num(decode_depth(steps)), expected, rtol=1e-6)


def test_far_points_raw_depth_margins_and_small_objects(root):
    frames = list_sunrgbd(root, rename=CHAIR)
    plain = clouds(frames)
    assert not clouds(frames, cut=CutSettings(far=1.0))
    assert len(clouds(frames, margin=0.2)[0].points) > len(plain[0].points)
    count = len(plain[0].points)
    kept = clouds(frames[:1], cut=CutSettings(min_points=count))
    assert len(kept) == 1
    assert not clouds(frames[:1], cut=CutSettings(min_points=count + 1))
    raw = clouds(list_sunrgbd(root, depth="raw", rename=CHAIR))
    assert count * 0.7 < len(raw[0].points) < count * 0.9
    # What is cut is what lies within the box, of all points of the frame.
    whole = truth(0) | {"coeffs": np.full(3, 50.0)}
    box = OrientedBox(*truth(0).values())
    wide = dataclasses.replace(frames[0].objects[0], box=OrientedBox(*whole.values()))
    (every,) = clouds([dataclasses.replace(frames[0], objects=(wide,))])
    assert inside_box(every.points.astype(np.float64), box).sum() == pytest.approx(count, abs=2)


def test_classes_are_renamed_or_left_out_and_splits_read(root):
    frames = list_sunrgbd(root, splits=root / "allsplit.mat", rename=rename_to(None))
    named = [[item.class_name for item in frame.objects] for frame in frames]
    assert named == [["sofa_chair", "toilet"]] * 2
    assert [frame.split for frame in frames] == ["train", "test"]
    assert {cloud.split for cloud in clouds(frames)} == {"train", "test"}
    with pytest.raises(InputError, match="no frame"):
        list_sunrgbd(root, rename=rename_to(["bathtub"]))
    with pytest.raises(InputError, match="alltrain and alltest"):
        list_sunrgbd(root, splits=root / "SUNRGBDMeta3DBB_v2.mat")


def test_one_bad_frame_fails_alone(bare):
    folder = bare / FRAMES[0]
    (folder / "annotation3Dfinal" / "index.json").write_text("{")
    frames = list_sunrgbd(bare, rename=CHAIR)
    assert [frame.id for frame in frames] == list(FRAMES)
    with pytest.raises(InputError, match=r"index\.json: not a JSON file"):
        clouds(frames[:1])
    assert len(clouds(frames[1:])) == 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda f: (f / "intrinsics.txt").unlink(), "intrinsics.txt: no such file"),
        (lambda f: (f / "intrinsics.txt").write_text("1 2 3"), "3 numbers instead of 9"),
        (lambda f: (f / "intrinsics.txt").write_text("one"), "not a text file"),
        (lambda f: (f / "intrinsics.txt").write_text("-1 0 5 0 9 5 0 0 1"), "must be positive"),
        (lambda f: (f / "extrinsics" / "20150101.txt").write_text("1 " * 12), "no rotation"),
        (lambda f: (f / "extrinsics" / "20150101.txt").write_text("nan " * 12), "no rotation"),
        (lambda f: (f / "depth_bfx" / "d.png").unlink(), "0 depth_bfx"),
        (lambda f: (f / "depth_bfx" / "e.png").write_bytes(b""), "2 depth_bfx"),
        (lambda f: (f / "depth_bfx" / "d.png").write_bytes(b""), "not a PNG"),
        (lambda f: [p.unlink() for p in (f / "extrinsics").iterdir()], "extrinsics"),
    ],
)
def test_damaged_frames_are_refused_by_name(bare, change, message):
    change(bare / FRAMES[0])
    with refused(message, "NYU0001"):
        clouds(list_sunrgbd(bare, rename=CHAIR))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[]", "not a JSON object"),
        ('{"../kv1": []}', "leads outside"),
        ('{"/etc": []}', "leads outside"),
        ('{"": []}', "leads outside"),
        ('{"kv1/NYUdata/NYU0001": 3}', "not a list of boxes"),
        ('{"kv1/NYUdata/NYU0001": [3]}', "not a list of boxes"),
        ('{"kv1/NYUdata/NYU0001": [{"class": 7}]}', "class must be a name"),
        ('{"kv1/NYUdata/NYU0001": [{"class": "chair"}]}', "object 0: field 'centroid' is missing"),
        ('{"a": [{"class": "chair", "centroid": [1, 2, null]}]}', r"centroid|basis"),
        ('{"a": [{"class": "chair", "centroid": [1, 2, 3], "basis": [1], "coeffs": [1, 1, 1]}]}',
         "basis must be 9"),
        ('{"absent": []}', "no frame"),
    ],
)  # fmt: skip
def test_bad_lists_of_boxes_are_refused(root, tmp_path, text, message):
    (tmp_path / "bad.json").write_text(text)
    with pytest.raises(InputError, match=message):
        list_sunrgbd(root, tmp_path / "bad.json", rename=CHAIR)


def test_a_skew_box_fails_its_frame(root, tmp_path):
    cut = {key: value.tolist() for key, value in truth(0).items()}
    entry = {"class": "chair", **cut, "basis": [1, 0, 0, 1, 0, 0, 0, 0, 1]}
    (tmp_path / "boxes.json").write_text(json.dumps({FRAMES[0]: [entry]}))
    with pytest.raises(InputError, match="NYU0001, object 0: the axes"):
        clouds(list_sunrgbd(root, tmp_path / "boxes.json", rename=CHAIR))


@pytest.mark.parametrize(
    "given",
    [
        "/n/fs/sun3d/data/SUNRGBD/../../../../etc/shadow/depth/d.png",
        "kv1/../../x/depth/d.png",
        "/etc/a/depth/d.png",
        "d.png",
        "",
        "a\\..\\..\\..\\b\\depth\\d.png",
    ],
)
def test_paths_that_lead_out_of_the_release_are_refused(root, tmp_path, given):
    row = meta_row(FRAMES[0], np.eye(3), np.eye(3), [("chair", truth(0))]) | {"depthpath": given}
    savemat(tmp_path / "m.mat", {"SUNRGBDMeta": structs([row])})
    with pytest.raises(InputError, match=r"m\.mat: .*(leads outside|names no depth picture)"):
        list_sunrgbd(root, tmp_path / "m.mat", rename=CHAIR)


def test_links_that_lead_out_are_refused(tmp_path):
    (tmp_path / "root" / "in").mkdir(parents=True)
    (tmp_path / "out").mkdir()
    (tmp_path / "root" / "link").symlink_to(tmp_path / "out")
    assert below(tmp_path / "root", "in/a") == tmp_path / "root" / "in" / "a"
    with pytest.raises(InputError, match="a link that leads outside"):
        below(tmp_path / "root", "link/a")


def test_mat_files_without_the_table_or_a_field_are_refused(root, tmp_path):
    savemat(tmp_path / "a.mat", {"other": 1})
    with pytest.raises(InputError, match="has no variable SUNRGBDMeta"):
        list_sunrgbd(root, tmp_path / "a.mat")
    savemat(tmp_path / "b.mat", {"SUNRGBDMeta": structs([{"depthpath": "a/b/depth/d.png"}])})
    with pytest.raises(InputError, match="no frame of"):
        list_sunrgbd(root, tmp_path / "b.mat")
    savemat(tmp_path / "c.mat", {"SUNRGBDMeta": structs([{"K": np.eye(3)}])})
    with pytest.raises(InputError, match=r"depthpath.*names no depth picture"):
        list_sunrgbd(root, tmp_path / "c.mat")


def test_a_truncated_mat_file_is_refused(root, tmp_path):
    content = (root / "SUNRGBDMeta3DBB_v2.mat").read_bytes()
    for size in (0, 100, 127, 130, len(content) // 2, len(content) - 1):
        (tmp_path / "m.mat").write_bytes(content[:size])
        with pytest.raises(InputError, match=r"m\.mat"):
            list_sunrgbd(root, tmp_path / "m.mat")


def test_mutated_mat_files_are_read_or_refused(root, tmp_path, rng):
    path = tmp_path / "a.mat"
    row = meta_row(FRAMES[0], np.eye(3), np.eye(3), [("chair", truth(0)), ("bed", truth(1))])
    savemat(path, {"SUNRGBDMeta": structs([row])})
    shutil.copy(root / "SUNRGBDMeta3DBB_v2.mat", tmp_path / "packed.mat")

    def read(path):
        list_sunrgbd(root, path, rename=rename_to(None))

    fuzz([path, path, tmp_path / "packed.mat"], read, rng, 150)


def test_mutated_lists_of_boxes_are_read_or_refused(root, bare, tmp_path, rng):
    """The list of boxes, an annotation and its matrices in turn, through to the clouds at times."""
    frame = bare / FRAMES[0]
    boxes = shutil.copy(root / "boxes.json", tmp_path / "boxes.json")

    def read(_):
        frames = list_sunrgbd(bare, boxes, rename=CHAIR)
        frames += list_sunrgbd(bare / "kv1", rename=CHAIR)
        if rng.random() < 0.2:
            clouds(frames)

    own = ("annotation3Dfinal/index.json", "extrinsics/20150101.txt", "intrinsics.txt")
    fuzz([boxes, *(frame / name for name in own)], read, rng, 120)
