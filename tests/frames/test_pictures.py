"""Depth images and masks of every kind that other programs write."""

import re
import struct

import cv2
import numpy as np
import pytest
from PIL import Image

from qs3.errors import TOLD
from qs3.frames.images import find_mask, list_images, read_depth, read_mask, read_raw

from ..clouds.hostile import png_bytes, refused

STEPS = np.arange(700, 700 + 12 * 20).reshape(12, 20)
GREY = [(value, value, value) for value in range(256)]
BLACK, WHITE, RED, GREEN, BLUE = (0,) * 3, (255,) * 3, (200, 0, 0), (0, 150, 0), (0, 0, 90)


def tiff(array, orientation=1, order="<", big=False, pages=1, bits=0):
    """A TIFF of one strip, written by hand after the specification; with ``bits`` it is packed."""
    array = np.ascontiguousarray(array.astype(array.dtype.newbyteorder(order)))
    height, width = array.shape
    form = {"u": 1, "i": 2, "f": 3}[array.dtype.kind]
    start, size, wide = (16, 20, "Q") if big else (8, 12, "I")
    body = packed(array, bits) if bits else array.tobytes()
    tags = {256: width, 257: height, 258: bits or 8 * array.dtype.itemsize, 259: 1, 262: 1}
    tags |= {273: start, 274: orientation, 277: 1, 278: height, 279: len(body), 339: form}
    place = start + len(body)
    head = (b"II" if order == "<" else b"MM") + struct.pack(order + "H", 43 if big else 42)
    head += struct.pack(order + "HH", 8, 0) if big else b""
    content = head + struct.pack(order + wide, place) + body
    for page in range(pages):
        place += struct.calcsize(order + wide + ("Q" if big else "H")) + size * len(tags)
        content += struct.pack(order + ("Q" if big else "H"), len(tags))
        for tag, value in tags.items():
            kind = 4 if tag in (273, 279) else 3
            held = struct.pack(order + ("I" if kind == 4 else "H"), value)
            held = held.ljust(struct.calcsize(wide), b"\0")
            content += struct.pack(order + "HH" + wide, tag, kind, 1) + held
        content += struct.pack(order + wide, place if page + 1 < pages else 0)
    return content


@pytest.mark.parametrize("big", [False, True])
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("kind", ["u2", "i2", "u4", "i4", "f2", "f4", "f8"])
def test_every_kind_of_tiff_gives_the_numbers_that_are_stored(tmp_path, kind, order, big):
    numbers = STEPS.astype(kind)
    for orientation in range(1, 9):
        (tmp_path / "d.tif").write_bytes(tiff(numbers, orientation, order, big))
        raw = read_raw(tmp_path / "d.tif")
        np.testing.assert_array_equal(raw, numbers, err_msg=f"orientation {orientation}")
        assert raw.dtype == numbers.dtype
        if kind[0] != "f":
            (tmp_path / "m.tif").write_bytes(tiff(blobs().astype(kind), orientation, order, big))
            np.testing.assert_array_equal(read_mask(tmp_path / "m.tif"), blobs())


@pytest.mark.parametrize("bits", [10, 12, 14])
def test_packed_tiffs_give_the_numbers_that_are_stored(tmp_path, bits):
    (tmp_path / "d.tif").write_bytes(tiff(STEPS.astype("u2"), bits=bits))
    np.testing.assert_array_equal(read_raw(tmp_path / "d.tif"), STEPS)
    (tmp_path / "m.tif").write_bytes(tiff(blobs().astype("u2"), bits=bits))
    np.testing.assert_array_equal(read_mask(tmp_path / "m.tif", instances=True), blobs())


def test_damaged_tiffs_are_one_line(tmp_path):
    good = tiff(STEPS.astype(np.float16))
    for content, words in (
        (good[:100], "cut off or damaged"),
        (good[:4] + b"\xff" * 4 + good[8:], "cut off or damaged"),
        (tiff(STEPS.astype(np.uint16), pages=2), "several pictures"),
        (b"II*\0\0\0\0\0", "damaged"),
    ):
        (tmp_path / "d.tif").write_bytes(content)
        with refused(words, "d.tif"):
            read_raw(tmp_path / "d.tif")
        with refused("d.tif", "d.tif"):
            read_mask(tmp_path / "d.tif")


def test_a_unit_that_is_no_metre_is_refused_or_named(tmp_path, caplog):
    TOLD.clear()
    metres = np.linspace(0.4, 0.8, 64 * 64).reshape(64, 64)
    for numbers, words in (
        (metres * 100, "middle depth would be 57.78 m if it holds metres; give --depth-scale"),
        (0.05 * 425 / metres, "disparities are no depth"),
        (metres * 1000, "0.001 if it holds millimetres"),
    ):
        np.save(tmp_path / "d.npy", numbers)
        with refused(words, "d.npy"):
            read_depth(tmp_path / "d.npy")
    np.testing.assert_allclose(read_depth(tmp_path / "d.npy", 0.001), metres, rtol=1e-6)
    np.save(tmp_path / "far.npy", metres * 60)
    np.testing.assert_allclose(read_depth(tmp_path / "far.npy", 1.0), metres * 60, rtol=1e-6)
    assert not caplog.text
    np.save(tmp_path / "cm.npy", np.rint(metres * 100).astype(np.uint16))
    read_depth(tmp_path / "cm.npy")
    assert "middle depth would be 0.058 m if it holds millimetres" in caplog.text
    TOLD.clear()
    read_depth(tmp_path / "cm.npy", 0.001)  # of a camera's file that is wrong
    assert "middle depth is 0.058 m; if that is wrong, give --depth-scale" in caplog.text
    np.save(tmp_path / "d.npy", metres)
    with refused(r"0.0005778 m, .*\(now 0.001; 1 if metres\)", "d.npy"):
        read_depth(tmp_path / "d.npy", 0.001)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ((STEPS << 3).astype(np.uint16), r"multiples of 8: .*, give --depth-scale.* \(0.000125\)"),
        ((STEPS << 4).astype(np.uint16), r"multiples of 16: .* \(6.25e-05\)"),
        ((STEPS * 5).astype(np.uint16), r"multiples of 5: those of TUM RGB-D .* \(0.0002\)"),
        ((STEPS * 10).astype(np.uint16), r"multiples of 10: .* \(0.0001\)"),
        (np.where(STEPS % 7, STEPS / 1000, 1.0).astype(np.float32), "if depth runs from 0 to 1"),
        (STEPS.astype(np.uint16), ""),
        (((STEPS - 600) * 10).astype(np.uint16), ""),  # centimetres, in millimetres
        (np.full((12, 20), 800, np.uint16), ""),
        ((STEPS / 1000).astype(np.float32), ""),
    ],
)
def test_numbers_that_are_likely_no_millimetres_are_reported(tmp_path, caplog, numbers, words):
    TOLD.clear()
    np.save(tmp_path / "d.npy", numbers)
    read_depth(tmp_path / "d.npy")
    assert re.search(words, caplog.text)
    assert bool(words) == bool(caplog.text)
    caplog.clear()
    read_depth(tmp_path / "d.npy", 0.001 if numbers.dtype.kind == "u" else 1.0)
    assert not caplog.text


@pytest.mark.parametrize("bits", [11, 12, 13, 14, 15])
def test_full_bits_that_are_often_and_alone_are_no_depth(tmp_path, bits):
    top = 2**bits - 1
    wall = np.linspace(0.95 * top, top, STEPS.size).reshape(STEPS.shape).round()
    for numbers, is_marked in ((np.minimum(STEPS, top // 2), True), (wall, False)):
        picture = numbers.astype(np.int32)
        picture[:3] = top
        np.save(tmp_path / "d.npy", picture)
        found = read_depth(tmp_path / "d.npy")
        assert np.isnan(found[:3]).all() == is_marked
        np.testing.assert_allclose(found[3:], picture[3:] / 1000, rtol=1e-6)


def test_pictures_beside_depth_are_left_out_by_their_names(tmp_path, caplog):
    TOLD.clear()
    for name in ("1_ir", "1_color", "1_Depth", "2.depth", "frame-2.rgb", "bin", "air", "2", "12"):
        (tmp_path / f"{name}.png").touch()
    assert [*list_images(tmp_path)] == ["1_Depth", "2.depth", "12", "air", "bin"]
    assert f"{tmp_path}: 4 pictures, such as 1_color, are left out: no depth" in caplog.text
    for name in ("1_Depth", "2.depth"):
        (tmp_path / f"{name}.png").unlink()
    assert len(list_images(tmp_path)) == 7


def test_pictures_of_another_kind_beside_those_without_a_kind_are_left_out(tmp_path, caplog):
    TOLD.clear()
    for name in ("1", "1_ir", "2", "2_mask", "3_ir", "left_1"):
        (tmp_path / f"{name}.png").touch()
    assert [*list_images(tmp_path)] == ["1", "2", "3_ir", "left_1"]
    assert f"{tmp_path}: 2 pictures, such as 1_ir, are left out: no depth" in caplog.text


@pytest.mark.parametrize("other", ["aligned_depth_to_color_1", "1_depth_raw", "depth1"])
def test_two_depth_pictures_of_one_moment_are_reported(tmp_path, caplog, other):
    TOLD.clear()
    for name in ("depth_1", "depth_2", "left_depth_3", "right_depth_3"):
        (tmp_path / f"{name}.png").touch()
    assert len(list_images(tmp_path)) == 4
    assert not caplog.text
    (tmp_path / f"{other}.png").touch()
    assert len(list_images(tmp_path)) == 5
    assert "may be one picture twice, and the camera is that of one" in caplog.text


@pytest.mark.parametrize(
    ("depth", "others"),
    [
        ("depth_1", ["color_1", "snr_1", "normals_1"]),  # Zivid
        ("a_IMG_DepthMap", ["a_IMG_Texture_16Bit", "a_IMG_NormalMap", "a_IMG_ConfidenceMap"]),
        ("1_depth", ["1_colors", "1_distance", "1_instance_segmaps"]),  # BlenderProc
        ("1_depth", ["1_intensity", "1_semantic"]),
        ("img_DepthPlanar_1", ["img_Segmentation_1", "img_DisparityNormalized_1"]),  # AirSim
    ],
)
def test_what_programs_write_beside_depth_is_no_depth(tmp_path, depth, others):
    for name in (depth, *others):
        (tmp_path / f"{name}.tif").touch()
    assert [*list_images(tmp_path)] == [depth]


def test_what_isaac_sim_writes_into_one_folder_is_told_apart(tmp_path):
    kinds = ("rgb", "distance_to_camera", "instance_segmentation", "distance_to_image_plane")
    for name in (*(f"{kind}_{number:04d}" for kind in kinds for number in range(2)), "disparity_0"):
        (tmp_path / f"{name}.png").touch()
    depth = ["distance_to_image_plane_0000", "distance_to_image_plane_0001"]
    assert [*list_images(tmp_path)] == depth
    masks = [find_mask(tmp_path, tmp_path / f"{name}.png").stem for name in depth]
    assert masks == ["instance_segmentation_0000", "instance_segmentation_0001"]


def test_the_small_depth_images_are_read_or_refused(shared_data):
    faults = shared_data / "faults"
    with refused("middle depth would be 60 m", "d_f64mm_near.npy"):
        read_depth(faults / "d_f64mm_near.npy")
    depth = read_depth(faults / "d_f64.tif")
    assert depth.shape == (48, 64)
    np.testing.assert_allclose(np.unique(depth[depth > 0]), [0.8, 1.0], rtol=1e-6)
    content = (faults / "d_orient.tif").read_bytes()
    stored = np.frombuffer(content[8 : 8 + 6144], "<u2").reshape(48, 64)
    np.testing.assert_array_equal(read_raw(faults / "d_orient.tif"), stored)


def blobs(shape=(60, 80)):
    """Two objects, 1 and 2, and background 0."""
    numbers = np.zeros(shape, np.uint8)
    numbers[10:40, 10:30], numbers[20:50, 50:70] = 1, 2
    return numbers


def saved(path, image, **options):
    image.save(path, **options)
    return path


def palette(indices, colours, path, **options):
    image = Image.fromarray(indices, "L")
    indexed = Image.frombytes("P", image.size, image.tobytes())
    indexed.putpalette([value for colour in colours for value in colour])
    return saved(path, indexed, **options)


def split_of(mask):
    """The sets of pixels of a mask's objects, whatever their numbers are."""
    return {np.flatnonzero(mask == number).tobytes() for number in np.unique(mask) if number}


PALETTES = [
    ([0, 1, 2], [BLACK, RED, GREEN], {}),
    ([0, 1, 2], [BLACK, RED, GREEN], {"bits": 2}),
    ([0, 1, 2], [BLACK, RED, GREEN, *[BLACK] * 250], {"bits": 8}),
    ([2, 0, 1], [RED, GREEN, BLACK], {}),
    ([3, 1, 0], [WHITE, RED, BLUE, BLACK], {}),
    ([255, 0, 7], [RED] * 7 + [GREEN] * 248 + [BLACK], {}),
    ([0, 1, 2], [WHITE, RED, BLACK], {"transparency": 0}),
    ([1, 0, 2], [RED, WHITE, BLUE], {"transparency": bytes([255, 0, 255])}),
    ([0, 5, 9], GREY, {}),
    ([0, 5, 9], [BLACK] * 256, {}),
]


@pytest.mark.parametrize(
    ("order", "colours", "options", "ending"),
    [(*each, ".png") for each in PALETTES] + [(*each, ".tif") for each in PALETTES if not each[2]],
)
def test_instances_of_a_palette_are_its_indices(tmp_path, order, colours, options, ending):
    numbers = blobs()
    path = palette(np.array(order, np.uint8)[numbers], colours, tmp_path / f"m{ending}", **options)
    mask = read_mask(path, numbers.shape, instances=True)
    assert split_of(mask) == split_of(numbers)
    for index in (1, 2):
        if order[index]:
            assert (mask[numbers == index] == order[index]).all()
    np.testing.assert_array_equal(read_mask(path) > 0, numbers > 0)


@pytest.mark.parametrize(
    ("order", "colours"), [([0, 1, 2], [WHITE, RED, GREEN]), ([0, 1, 2], [BLACK, RED, BLACK])]
)
def test_a_palette_whose_background_is_unknown_is_refused(tmp_path, order, colours):
    path = palette(np.array(order, np.uint8)[blobs()], colours, tmp_path / "m.png")
    for instances in (False, True):
        with refused("background is unknown", "m.png"):
            read_mask(path, instances=instances)


@pytest.mark.parametrize("clear", [0, 9])
def test_grey_that_is_transparent_is_background_and_no_depth(tmp_path, clear):
    """GDAL writes what was not measured so."""
    numbers = np.array([clear, 1, 2], np.uint8)[blobs()]
    path = saved(tmp_path / "m.png", Image.fromarray(numbers), transparency=clear)
    np.testing.assert_array_equal(read_mask(path, instances=True), blobs())
    depth = np.array([clear, 700, 800], np.uint16)[blobs()]
    path = saved(tmp_path / "d.png", Image.fromarray(depth), transparency=clear)
    np.testing.assert_array_equal(np.isnan(read_depth(path)), blobs() == 0)


@pytest.mark.parametrize("bits", [1, 2, 4])
def test_grey_of_few_bits_keeps_its_numbers(tmp_path, bits):
    numbers = np.minimum(blobs(), 2**bits - 1)
    if bits == 1:
        path = saved(tmp_path / "m.png", Image.fromarray(numbers.astype(bool)))
    else:
        path = tmp_path / "m.png"
        path.write_bytes(few_bits(numbers, bits))
    np.testing.assert_array_equal(read_mask(path, instances=True), numbers)


def packed(numbers, bits):
    """Rows of numbers, most significant bit first; each begins a byte."""
    digits = (numbers[..., None] >> np.arange(bits - 1, -1, -1)) & 1
    rows = np.packbits(digits.astype(np.uint8).reshape(len(numbers), -1), axis=1)
    return rows.tobytes()


def few_bits(numbers, bits):
    """A grey PNG of 2 or 4 bits."""
    rows = np.frombuffer(packed(numbers, bits), np.uint8).reshape(len(numbers), -1)
    body = np.pad(rows, ((0, 0), (1, 0))).tobytes()
    return png_bytes(numbers.shape[1], numbers.shape[0], bits, 0, body)


def colour(numbers, colours):
    return np.array(colours, np.uint8)[numbers]


def test_instances_of_colours_are_numbered_as_coco_does(tmp_path):
    numbers = blobs()
    path = saved(tmp_path / "m.png", Image.fromarray(colour(numbers, [BLACK, RED, GREEN])))
    mask = read_mask(path, instances=True)
    assert split_of(mask) == split_of(numbers)
    assert np.unique(mask).tolist() == [0, 200, 150 * 256]
    np.testing.assert_array_equal(read_mask(path) > 0, numbers > 0)
    white = saved(tmp_path / "white.png", Image.fromarray(colour(numbers, [WHITE, RED, GREEN])))
    for instances in (False, True):
        with refused("no pixel is black or transparent", "white.png"):
            read_mask(white, instances=instances)
    grey = saved(tmp_path / "grey.png", Image.fromarray(colour(numbers, GREY)))
    np.testing.assert_array_equal(read_mask(grey, instances=True), numbers)


@pytest.mark.parametrize("mode", ["RGBA", "LA"])
def test_what_is_opaque_is_the_object_of_a_cut_out(tmp_path, mode, rng):
    numbers = blobs()
    photograph = rng.integers(0, 256, (*numbers.shape, 3), dtype=np.uint8)
    for top in (255, 100):
        image = Image.fromarray(photograph).convert(mode)
        image.putalpha(Image.fromarray(((numbers == 1) * top).astype(np.uint8)))
        path = saved(tmp_path / "m.png", image)
        np.testing.assert_array_equal(read_mask(path) > 0, numbers == 1)
    with refused("soft edges|levels of grey", "m.png"):
        read_mask(path, instances=True)
    # What is opaque everywhere has its objects in its colours.
    image = Image.fromarray(colour(numbers, [BLACK, WHITE, WHITE])).convert(mode)
    np.testing.assert_array_equal(read_mask(saved(path, image)) > 0, numbers > 0)
    flat = Image.fromarray(colour(numbers, [WHITE, RED, GREEN])).convert(mode)
    flat.putalpha(Image.fromarray(((numbers > 0) * 255).astype(np.uint8)))
    assert split_of(read_mask(saved(path, flat), instances=True)) == split_of(numbers)
    flat.putalpha(0)
    with refused("transparent everywhere", "m.png"):
        read_mask(saved(path, flat))


@pytest.mark.parametrize("edges", ["gauss", "line", "resize", "jpeg", "rgb", "palette", "16"])
def test_soft_edges_are_cut_at_half(tmp_path, edges):
    hard = np.zeros((240, 320), np.uint8)
    cv2.fillPoly(hard, [np.array([[60, 50], [220, 80], [200, 200], [80, 180]])], 255)
    soft = cv2.GaussianBlur(hard, (0, 0), 3)
    if edges == "line":
        soft = np.zeros_like(hard)
        corners = np.array([[60, 50], [220, 80], [200, 200], [80, 180]])
        cv2.fillPoly(soft, [corners], 255, cv2.LINE_AA)
    elif edges == "resize":
        soft = cv2.resize(hard[::2, ::2], (320, 240), interpolation=cv2.INTER_LINEAR)
    elif edges == "jpeg":
        soft = cv2.imdecode(cv2.imencode(".jpg", hard)[1], cv2.IMREAD_GRAYSCALE)
    path = tmp_path / "m.png"
    if edges == "rgb":
        saved(path, Image.fromarray(soft).convert("RGB"))
    elif edges == "palette":
        saved(path, Image.fromarray(soft).convert("RGB").quantize(64))
    elif edges == "16":
        cv2.imwrite(str(path), soft.astype(np.uint16) * 257)
    else:
        cv2.imwrite(str(path), soft)
    found = read_mask(path) > 0
    rim = cv2.dilate(hard, np.ones((5, 5))) != cv2.erode(hard, np.ones((5, 5)))
    np.testing.assert_array_equal(found[~rim], hard[~rim] > 0)
    assert found.sum() == pytest.approx((hard > 0).sum(), rel=0.02)
    with refused("soft edges", "m.png"):
        read_mask(path, instances=True)


def test_numbers_are_not_taken_for_soft_edges(tmp_path):
    numbers = np.zeros((120, 160), np.int32)
    for index in range(1, 31):
        row, column = divmod(index - 1, 6)
        numbers[24 * row : 24 * row + 20, 26 * column : 26 * column + 4 + index % 20] = index
    numbers[3, 150] = 200  # a speck
    numbers[100:110, 150:158] = 255
    np.save(tmp_path / "m.npy", numbers)
    for instances in (False, True):
        np.testing.assert_array_equal(read_mask(tmp_path / "m.npy", instances=instances), numbers)


def test_a_photograph_and_depth_are_no_masks(tmp_path, rng):
    photograph = cv2.GaussianBlur(rng.integers(0, 256, (120, 160), dtype=np.uint8), (0, 0), 2)
    photograph = cv2.normalize(photograph, None, 0, 255, cv2.NORM_MINMAX)
    steps = (600 + np.indices((120, 160)).sum(axis=0)).astype(np.uint16)
    steps[:10] = 0
    levels = cv2.GaussianBlur(
        np.where(blobs((240, 320)), blobs((240, 320)) * 120 + 15, 0), (0, 0), 1
    )
    for image in (photograph, steps, levels.astype(np.uint8)):
        cv2.imwrite(str(tmp_path / "m.png"), image)
        with refused("many levels of grey", "m.png"):
            read_mask(tmp_path / "m.png")


def test_background_is_zero_or_known_or_refused(tmp_path, caplog):
    TOLD.clear()
    numbers = blobs().astype(np.int64)
    for mask, instances, words in (
        (numbers - 1, False, "holds -1: is it background"),
        (np.where(numbers, numbers, -9), False, "holds -9: is it background"),
        (np.where(numbers, numbers, 255), False, "no pixel is 0, the background"),
    ):
        np.save(tmp_path / "m.npy", mask)
        with refused(words, "m.npy"):
            read_mask(tmp_path / "m.npy", instances=instances)
    assert not caplog.text
    assert np.unique(read_mask(tmp_path / "m.npy", instances=True)).tolist() == [1, 2, 255]
    assert "1, 2, 255 are objects each" in caplog.text
    np.save(tmp_path / "m.npy", np.where(numbers, numbers, -1))
    np.testing.assert_array_equal(read_mask(tmp_path / "m.npy"), numbers)


def test_the_border_of_pascal_voc_is_no_object(tmp_path, caplog):
    TOLD.clear()
    numbers = blobs().astype(np.uint8)
    bordered = numbers.copy()
    around = cv2.dilate(numbers, np.ones((3, 3), np.uint8))
    bordered[(around > 0) & (numbers == 0)] = 255
    np.save(tmp_path / "m.npy", bordered)
    np.testing.assert_array_equal(read_mask(tmp_path / "m.npy", instances=True), numbers)
    whole = read_mask(tmp_path / "m.npy")  # what is not 0 may be the object
    np.testing.assert_array_equal(whole > 0, bordered > 0)
    assert "255 beside 0, 1, 2 is taken for no object" in caplog.text
    np.save(tmp_path / "m.npy", np.where(numbers == 1, 254, bordered))
    assert 255 in read_mask(tmp_path / "m.npy", instances=True)


def test_the_border_of_16_bits_and_of_classes_is_no_object(tmp_path, caplog):
    TOLD.clear()
    numbers = blobs().astype(np.uint16)
    border = (cv2.dilate(numbers, np.ones((3, 3), np.uint8)) > 0) & (numbers == 0)
    np.save(tmp_path / "m.npy", np.where(border, 65535, numbers))
    np.testing.assert_array_equal(read_mask(tmp_path / "m.npy", instances=True), numbers)
    assert "65535 beside 0, 1, 2 is taken for no object" in caplog.text
    classes = np.where(border, 255, numbers * 7).astype(np.uint8)
    for cream, is_border in (((224, 224, 192), True), ((224, 224, 193), False)):
        colours = [BLACK, *[(k, 0, 99) for k in range(254)], cream]
        path = palette(classes, colours, tmp_path / "m.png")
        for instances in (False, True):
            assert (255 not in read_mask(path, instances=instances)) == is_border


def test_black_objects_on_a_transparent_ground_are_one(tmp_path):
    alpha = (blobs() > 0) * np.uint8(255)
    path = saved(tmp_path / "m.png", Image.fromarray(np.dstack([alpha * 0] * 3 + [alpha])))
    for instances in (False, True):
        np.testing.assert_array_equal(read_mask(path, instances=instances), alpha > 0)


def test_numbers_that_were_made_by_scaling_are_reported(tmp_path, caplog):
    TOLD.clear()
    numbers = blobs() * np.uint8(3)
    numbers[55:57, 3:5] = 5  # a speck
    for how, asked in ((cv2.INTER_NEAREST, False), (cv2.INTER_LINEAR, True)):
        cv2.imwrite(str(tmp_path / "m.png"), cv2.resize(numbers, (200, 150), interpolation=how))
        read_mask(tmp_path / "m.png")
        assert not caplog.text
        read_mask(tmp_path / "m.png", instances=True)
        assert ("scale it by the nearest pixel" in caplog.text) == asked


@pytest.mark.parametrize("kind", [np.uint8, np.uint16, bool])
def test_a_mask_whose_background_is_its_largest_number_is_reported(tmp_path, caplog, kind):
    TOLD.clear()
    numbers, top = blobs().astype(int), 1 if kind is bool else np.iinfo(kind).max
    np.save(tmp_path / "m.npy", np.where(numbers, 0, top).astype(kind))
    np.testing.assert_array_equal(read_mask(tmp_path / "m.npy") > 0, numbers == 0)
    assert f"{top} lies in all of its corners; if that is the background" in caplog.text
    if kind is not bool:  # the first object is 0, and would be lost
        np.save(tmp_path / "m.npy", np.where(numbers, numbers - 1, top).astype(kind))
        with refused(f"{top} lies in all of its corners", "m.npy"):
            read_mask(tmp_path / "m.npy", instances=True)


def test_the_small_masks_are_read_as_they_are_meant(shared_data):
    faults = shared_data / "faults"
    whole = read_mask(faults / "sc_mask_ok.png") > 0
    assert whole.sum() == 5434
    for name, sizes in (("pal", [5434, 3200]), ("color", [5434, 5434])):
        mask = read_mask(faults / f"sc_mask_{name}.png", instances=True)
        assert sorted((mask == n).sum() for n in np.unique(mask) if n) == sorted(sizes)
    soft = read_mask(faults / "sc_mask_soft.png") > 0
    assert (soft ^ whole).sum() < 60
    assert (read_mask(faults / "m_neg.npy") > 0).sum() == 200
