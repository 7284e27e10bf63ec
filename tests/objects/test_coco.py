"""Masks in COCO's JSON: polygons and run lengths; pycocotools 2.0.11 wrote the string."""

import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.path import Path as MplPath

from qs3.errors import TOLD, InputError
from qs3.frames.images import bare
from qs3.objects import coco as coco_module
from qs3.objects.coco import read_coco

from ..clouds.hostile import refused

TEXT = (
    "322O0002ON10O020O00010O1OO0010O20N064020JK160IO0052KO60J160KO4OK00180H06OJ170IO10O12ON60K0O10"
)
SHAPE = (13, 17)


def mask() -> np.ndarray:
    pixels = np.random.default_rng(0).random(SHAPE) < 0.4
    pixels[3:9, 4:15] = True
    return pixels


def found(path, shape=SHAPE, frame="000004.png", scene=0, number=0):
    coco = read_coco(path)
    return coco.of(coco.place(Path(frame), scene, number), shape)


def runs(of: np.ndarray) -> list[int]:
    """Return run lengths down the columns, zeros first."""
    column = of.T.ravel().astype(int)
    ends = np.flatnonzero(np.diff(column)) + 1
    lengths = np.diff([0, *ends, column.size]).tolist()
    return [0, *lengths] if column[0] else lengths


def write(path, segmentation, *others, **more):
    row = {"image_id": 3, "segmentation": segmentation}
    images = [{"id": 3, "file_name": "depth/000004.png"} | more, *others]
    path.write_text(json.dumps({"images": images, "annotations": [row]}))
    return path


@pytest.mark.parametrize("counts", [TEXT, runs(mask())])
def test_run_lengths_give_their_mask(tmp_path, counts) -> None:
    path = write(tmp_path / "m.json", {"size": list(SHAPE), "counts": counts})
    np.testing.assert_array_equal(found(path), mask())


def test_areas_of_several_objects_are_left_out(tmp_path, caplog) -> None:
    TOLD.clear()
    path = write(tmp_path / "m.json", [[0, 0, 4, 0, 4, 4, 0, 4]])
    record = json.loads(path.read_text())
    crowd = {"size": list(SHAPE), "counts": runs(mask())}
    record["annotations"].append({"image_id": 3, "iscrowd": 1, "segmentation": crowd})
    path.write_text(json.dumps(record))
    assert np.unique(found(path)[5:, 5:]).tolist() == [0]
    assert "iscrowd" in caplog.text
    del record["annotations"][0]
    path.write_text(json.dumps(record))
    with refused("all of its masks are marked iscrowd", path):
        read_coco(path)


def test_masks_without_an_image_say_so(tmp_path) -> None:
    (tmp_path / "sam.json").write_text('[{"segmentation": [[0, 0, 4, 0, 4, 4]]}]')
    with refused(
        r"cannot be read as masks of COCO \('image_id' is missing or unknown\); mend", "sam.json"
    ):
        read_coco(tmp_path / "sam.json")


@pytest.mark.parametrize(
    "polygon",
    [
        [4, 2, 12, 2, 12, 8, 4, 8],
        [[4, 2], [12, 2], [12, 8], [4, 8]],
        [["4", "2", "12", "2", "12", "8", "4", "8"]],
        [[4, 2, 12, 2, 12, 8, 4, 8], [15, 11, 16, 12], [1, 1]],
    ],
)
def test_a_polygon_may_be_written_flat_or_in_pairs(tmp_path, polygon) -> None:
    path = write(tmp_path / "m.json", polygon, width="17", height=13.0)
    plain = found(write(tmp_path / "n.json", [[4, 2, 12, 2, 12, 8, 4, 8]]))
    np.testing.assert_array_equal(found(path), plain)
    assert plain.sum() > 40


@pytest.mark.parametrize("line", [[[10, 10, 12, 10]], [[10, 10]], [10, 10]])
def test_a_line_beside_masks_is_left_out(tmp_path, caplog, line) -> None:
    TOLD.clear()
    path = write(tmp_path / "m.json", [[4, 2, 12, 2, 12, 8, 4, 8]])
    plain = found(path)
    record = json.loads(path.read_text())
    record["annotations"][:0] = [{"image_id": 3, "segmentation": line}] * 2
    path.write_text(json.dumps(record))
    np.testing.assert_array_equal(found(path), plain)
    assert caplog.messages == [
        f"{path}: image 3: 2 of its 3 objects have no polygon of three corners, in one list x, y, "
        "x, y …; they are left out"
    ]
    del record["annotations"][2]
    path.write_text(json.dumps(record))
    with refused("image 3: 2 of its 2 objects have no polygon of three corners", path):
        found(path)


def test_polygons_give_their_pixels(tmp_path) -> None:
    path = write(tmp_path / "m.json", [[4, 2, 12, 2, 12, 8, 4, 8], [14, 10, 17, 10, 17, 12.9]])
    wanted = np.zeros((13, 17), bool)
    wanted[2:8, 4:12] = True
    wanted[10, 15:17] = wanted[11, 16] = True
    np.testing.assert_array_equal(found(path) > 0, wanted)


def test_a_polygon_holds_the_pixels_whose_middles_lie_in_it(tmp_path) -> None:
    middles = np.indices(SHAPE)[::-1].reshape(2, -1).T + 0.5
    for corners in np.random.default_rng(0).uniform(0, SHAPE[0], (20, 3, 2)):
        path = write(tmp_path / "m.json", [corners.ravel().tolist()])
        inside = MplPath(corners).contains_points(middles).reshape(SHAPE)
        np.testing.assert_array_equal(found(path) > 0, inside)


def test_results_of_a_detector_name_the_image_and_the_surest_mask_wins(tmp_path) -> None:
    rows = [
        {"image_id": 7, "score": 0.9, "segmentation": [[0, 0, 8, 0, 8, 8, 0, 8]]},
        {"image_id": 7, "score": 0.4, "segmentation": [[0, 0, 17, 0, 17, 13, 0, 13]]},
        {"image_id": 8, "segmentation": [[0, 0, 17, 0, 17, 13, 0, 13]]},
    ]
    (tmp_path / "m.json").write_text(json.dumps(rows))
    pixels = found(tmp_path / "m.json", number=7)
    assert (pixels[4, 4], pixels[10, 14]) == (2, 1)
    assert not found(tmp_path / "m.json", number=9).any()
    (tmp_path / "m.json").write_text(json.dumps([row | {"image_id": 7.0} for row in rows[:2]]))
    assert found(tmp_path / "m.json", number=7)[4, 4] == 2


def test_of_masks_that_are_as_sure_the_smaller_one_wins(tmp_path, caplog) -> None:
    TOLD.clear()
    rows = [
        {"image_id": 7, "area": 64, "segmentation": [[0, 0, 8, 0, 8, 8, 0, 8]]},
        {"image_id": 7, "area": 221, "segmentation": [[0, 0, 17, 0, 17, 13, 0, 13]]},
    ]
    (tmp_path / "m.json").write_text(json.dumps(rows))
    pixels = found(tmp_path / "m.json", number=7)
    assert (pixels[4, 4], pixels[10, 14]) == (2, 1)
    assert not caplog.text
    rows[1]["score"] = 2.0
    (tmp_path / "m.json").write_text(json.dumps(rows))
    assert (found(tmp_path / "m.json", number=7) == 2).all()
    assert "image 7: 1 of its 2 masks lie wholly under others" in caplog.text


@pytest.mark.parametrize("number", [7, 7.0, "7"])
@pytest.mark.parametrize("more", [{}, {"file_name": "frame.4.jpg"}])
def test_results_may_name_images_by_words(tmp_path, more, number) -> None:
    """As Ultralytics writes them: an image_id is a number only if its name is."""
    box = [[0, 0, 8, 0, 8, 8, 0, 8]]
    rows = [{"image_id": "frame.4", "segmentation": box} | more, {"image_id": number}]
    rows[1] |= {"segmentation": [[8, 8, 12, 8, 12, 12, 8, 12]]}
    (tmp_path / "m.json").write_text(json.dumps(rows))
    first, second = (found(tmp_path / "m.json", frame=f"{name}.png") for name in ("frame.4", "7"))
    assert (first[4, 4], first[10, 10], second[4, 4], second[10, 10]) == (1, 0, 0, 1)
    with refused("lists no image frame", tmp_path / "m.json"):
        found(tmp_path / "m.json", frame="frame.5.png", number=4)


def test_results_of_several_scenes_stay_apart(tmp_path) -> None:
    box = [[0, 0, 8, 0, 8, 8, 0, 8]]
    rows = [{"scene_id": 2, "image_id": 7, "segmentation": box}]
    (tmp_path / "m.json").write_text(json.dumps(rows))
    assert found(tmp_path / "m.json", scene=2, number=7).any()
    assert not found(tmp_path / "m.json", scene=1, number=7).any()


def test_images_of_one_name_are_told_apart_by_their_folders(tmp_path) -> None:
    other = {"id": 4, "file_name": "cam2\\rgb\\000004.jpg"}
    path = write(
        tmp_path / "m.json", [[0, 0, 8, 0, 8, 8, 0, 8]], other, file_name="cam1/rgb/000004.jpg"
    )
    assert found(path, frame="shots/cam1/depth/000004.png").any()
    assert not found(path, frame="shots/cam2/depth/000004.png").any()
    for unknown in ("shots/depth/000004.png", "cam1/cam2/000004.png"):
        with refused("may be", path, "cam1/rgb/000004.jpg", "cam2/rgb/000004.jpg", unknown):
            found(path, frame=unknown)


@pytest.mark.parametrize(
    "name",
    [
        "000004_png.rf.1f3c5d7e9a0b1c2d3e4f5a6b7c8d9e0f.jpg",
        "train/000004_PNG.rf.1F3C5D7E9A0B.png",
        "000004_tiff.rf.xYz123.jpg",
        "000004_png_jpg.rf.1f3c5d7e9a0b.jpg",
        "upload/1/3f2a1b4c-000004.png",
        "upload/1/12345678-000004.png",
        "20249999-000004.png",
        "000004-color.jpg",
        "rgb/rgb000004.png",
        "color_000004_png.rf.1f3c5d7e9a0b.jpg",
    ],
)
def test_names_that_other_tools_changed_are_found(tmp_path, name) -> None:
    path = write(tmp_path / "m.json", [[0, 0, 8, 0, 8, 8, 0, 8]], file_name=name)
    for frame in ("000004.png", "depth/depth_000004.png", "000004.depth.tif"):
        assert found(path, frame=frame).any()
    exact = {"id": 4, "file_name": "000004.png"}
    assert not found(write(path, [[0, 0, 8, 0, 8, 8, 0, 8]], exact, file_name=name)).any()
    with refused("lists no image 4", path):
        found(path, frame="4.png")


def test_a_date_is_no_mark_of_another_tool(tmp_path) -> None:
    names = ("20240101-0004_color.png", "20240102-0004_color.png", "3f2a1b4c-20240103-0004.png")
    others = [{"id": k, "file_name": name} for k, name in enumerate(names, start=4)]
    path = write(tmp_path / "m.json", [[0, 0, 8, 0, 8, 8, 0, 8]], *others, file_name="5.png")
    coco = read_coco(path)
    for k, day in enumerate(("20240101", "20240102", "20240103"), start=4):
        assert coco.place(Path(f"{day}-0004_depth.png"), 0, 0) == (None, k)
        with refused("lists no image 0004", path):
            coco.place(Path(day) / "0004.png", 0, 0)


def test_names_are_taken_apart_once_for_all_frames(tmp_path, monkeypatch) -> None:
    others = [{"id": k, "file_name": f"color_{k}.png"} for k in range(4, 24)]
    path = write(tmp_path / "m.json", [[0, 0, 8, 0, 8, 8, 0, 8]], *others)
    coco, names = read_coco(path), []
    monkeypatch.setattr(coco_module, "bare", lambda name: names.append(name) or bare(name))
    for k in range(4, 24):
        assert coco.place(Path(f"depth_{k}.png"), 0, 0) == (None, k)
    assert len(names) <= 3 * len(coco.images)


@pytest.mark.parametrize(
    ("image", "row", "words"),
    [
        ({"width": 34, "height": 26}, {}, "a mask of 34×26 pixels, the depth image has 17×13"),
        ({}, {"image_id": 9}, "a mask is of image 9, which is not among its images"),
        ({}, {"segmentation": []}, "an object of image 3 has no segmentation; a box alone"),
        ({}, {"segmentation": None}, "an object of image 3 has no segmentation"),
        ({}, {"segmentation": [[0, 0, 32, 0, 32, 12]]}, "far outside of its image"),
        ({}, {"segmentation": [[0.1, 0.1, 0.9, 0.1, 1, 1]]}, "a polygon in shares of its image"),
    ],
)
def test_masks_of_other_images_and_boxes_are_refused(tmp_path, image, row, words) -> None:
    row = {"image_id": 3, "bbox": [0, 0, 8, 8], "segmentation": [[0, 0, 8, 0, 8, 8]]} | row
    images = [{"id": 3, "file_name": "000004.png"} | image]
    (tmp_path / "m.json").write_text(json.dumps({"images": images, "annotations": [row]}))
    with refused(words, tmp_path / "m.json"):
        found(tmp_path / "m.json")


@pytest.mark.parametrize(
    ("segmentation", "message"),
    [
        ({"size": [13, 18], "counts": TEXT}, "mask of 18×13 pixels, the depth image has 17×13"),
        ({"size": list(SHAPE), "counts": [1, 2]}, "do not fill 17×13"),
        ({"size": list(SHAPE), "counts": [-5, 226]}, "do not fill 17×13"),
        ({"size": list(SHAPE), "counts": TEXT[:-9]}, "do not fill 17×13"),
        ({"size": list(SHAPE), "counts": {"a": 1}}, "m.json"),
        ({"counts": TEXT}, "m.json"),
        ([[1, 2, 3]], "m.json"),
        ([[1e9, 2, 3, 4, 5, 6]], "far outside"),
        ([[4, 2, 12, 2], [5, 5]], "no polygon of three corners"),
        ([[4, 2]], "no polygon of three corners"),
        ("polygon", "m.json"),
    ],
)
def test_bad_masks_are_one_line(tmp_path, segmentation, message) -> None:
    path = write(tmp_path / "m.json", segmentation)
    with pytest.raises(InputError, match=message):
        found(path)


@pytest.mark.parametrize("record", [5, {"images": []}, [{"image_id": 1}], [3], {"annotations": 3}])
def test_other_json_is_refused(tmp_path, record) -> None:
    (tmp_path / "m.json").write_text(json.dumps(record))
    with pytest.raises(InputError, match=r"m\.json"):
        read_coco(tmp_path / "m.json")


def test_an_image_that_is_not_listed_is_refused(tmp_path) -> None:
    with pytest.raises(InputError, match="lists no image 000005"):
        found(write(tmp_path / "m.json", [[1, 2, 3, 4, 5, 6]]), frame="000005.png", number=3)
