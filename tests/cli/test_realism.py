"""``qs3 realism`` with a small camera."""

import functools
import hashlib
import json

import cv2
import numpy as np
import pytest

# The D435's optics on a small chip.
SMALL = """
base = "d435"
name = "small"

[rig]
width = 200
height = 150
focal = 215.0

[matching]
num_disparities = 32
block_size = 15

[depth]
near = 0.5
far = 3.0
"""


@pytest.fixture(scope="module")
def camera(tmp_path_factory):
    path = tmp_path_factory.mktemp("camera") / "small.toml"
    path.write_text(SMALL)
    return path


@pytest.fixture
def realism(typed):
    return functools.partial(typed, "realism")


@pytest.fixture
def refused(typed):
    return functools.partial(typed.refuses, "realism")


def pair_options(folder, left, right, depth, focal=215.0):
    """Writes a pair, its depth (in metres) as PNG in millimetres and its K; names them."""
    for name, image in (("left", left), ("right", right)):
        cv2.imwrite(str(folder / f"{name}.png"), image)
    cv2.imwrite(str(folder / "depth.png"), np.nan_to_num(1000 * depth).round().astype(np.uint16))
    height, width = depth.shape
    matrix = f"{focal} 0 {(width - 1) / 2}\n0 {focal} {(height - 1) / 2}\n0 0 1\n"
    (folder / "K.txt").write_text(matrix)
    return ("--pair", folder / "left.png", folder / "right.png", "--depth", folder / "depth.png",
            "--intrinsics", folder / "K.txt", "--baseline", 0.05)  # fmt: skip


@pytest.fixture
def flat(tmp_path, rng):
    """Options of a pair of a wall at 12 px, of which the camera misses a part."""
    texture = rng.integers(0, 60000, (150, 200 + 12), dtype=np.uint16)
    depth = np.full((150, 200), 215.0 * 0.05 / 12)
    depth[50:80, 100:150] = np.nan
    return pair_options(tmp_path, texture[:, :200], texture[:, 12:], depth)


def test_a_real_pair_is_held_against_its_own_depth(realism, camera, flat, tmp_path):
    out = tmp_path / "out"
    common = ("--sensor", camera, "--matching", "zncc", "--out", out)
    done = realism(*flat, *common)
    record = json.loads((out / "pair.json").read_text())
    assert record["camera_valid"] == pytest.approx(1 - 1500 / (150 * 188), abs=1e-3)
    assert record["camera_holes"] == pytest.approx(1500 / (150 * 188), abs=1e-3)
    assert record["valid"] > 0.85  # half a block of the frame's rim has no match
    assert record["holes"] == pytest.approx(1 - record["valid"], abs=1e-6)
    assert record["over_3px"] == 0
    assert record["median_abs_px"] < 0.05
    assert abs(record["difference_px"]) <= record["median_abs_px"]
    assert record["scale"] == pytest.approx(1, abs=0.005)
    assert (record["sensor"], record["matching"]["method"]) == ("small", "zncc")
    digests = {name: hashlib.sha256((tmp_path / f"{name}.png").read_bytes()).hexdigest()
               for name in ("left", "right", "depth")}  # fmt: skip
    assert record["images"] == {
        name: {"name": f"{name}.png", "sha256": digest} for name, digest in digests.items()
    }
    assert record["plane_rms_px"] < 0.05
    assert record["over_1px_near_steps"] is None
    assert record["notes"] == []
    assert "RMS on planes" in done.stdout
    assert (out / "pair.png").read_bytes()[1:4] == b"PNG"
    depth = tmp_path / "depth.npy"  # in metres
    np.save(depth, cv2.imread(str(tmp_path / "depth.png"), cv2.IMREAD_UNCHANGED) / 1000)
    realism(*flat[:4], depth, *flat[5:], *common)
    again = json.loads((out / "pair.json").read_text())
    assert again.pop("images")["depth"]["name"] == "depth.npy"
    assert again == {name: value for name, value in record.items() if name != "images"}
    longer = realism(*flat[:-1], 0.05 * 1.03, *common)  # another camera's baseline
    assert "focal length or baseline" in longer.stderr
    changed = json.loads((out / "pair.json").read_text())
    assert changed["scale"] == pytest.approx(1 / 1.03, abs=0.005)
    assert changed["difference_px"] == pytest.approx(-0.36, abs=0.05)
    swapped = realism(flat[0], flat[2], flat[1], *flat[3:], *common)
    assert "LEFT and RIGHT swapped" in swapped.stderr


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"--depth": "absent.png"}, "absent.png"),
        ({"--depth": "left8.png"}, "8 bits"),
        ({"--depth": "small.npy"}, "small.npy: is 100×75 pixels"),
        ({"--depth-scale": 1.0}, "depth-scale"),
        ({"--pair": ("left8.png", "right.png")}, "uint16"),
    ],
    ids=str,
)
def test_faults_of_a_pair_are_one_line(
    refused, camera, flat, tmp_path, monkeypatch, changes, words
):
    monkeypatch.chdir(tmp_path)
    cv2.imwrite("left8.png", np.zeros((150, 200), np.uint8))
    np.save("small.npy", np.ones((75, 100)))
    chosen = {flat[0]: flat[1:3], **dict(zip(flat[3::2], flat[4::2], strict=True)), **changes}
    options = []
    for name, value in chosen.items():
        if value is not None:
            options += [name, *(value if isinstance(value, tuple) else (value,))]
    assert words in refused(*options, "--sensor", camera, "--out", "out")
    assert not (tmp_path / "out").exists()
