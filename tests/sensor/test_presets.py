"""Presets are what their sources say; sensors go through TOML unchanged; faults are one line."""

import dataclasses
import math
import tomllib

import cv2
import numpy as np
import pytest

from qs3.errors import InputError
from qs3.sensor.exposure import ExposureSettings, blur
from qs3.sensor.light.pattern import PatternSettings, rosette_places
from qs3.sensor.matching import MatchingSettings
from qs3.sensor.matching.settings import unread
from qs3.sensor.presets import SENSORS, Sensor, changed, load_sensor, sensor_toml, settings_dict
from qs3.sensor.rig import Region, StereoRig
from qs3.sensor.view import photograph

from .laws.bench import VIEW, Bench, painted, wall

REAL = ("d415", "d435", "d455", "kinect-v1")


def write(folder, text: str):
    path = folder / "mine.toml"
    path.write_text(text)
    return path


def degrees(tangent: float) -> float:
    return 2 * math.degrees(math.atan(tangent))


# Focal length, baseline (mm), depth field of view (degrees), and the law's table of disparities at
# 0.5, 1 and 3 m: the published figures.
@pytest.mark.parametrize(
    ("name", "focal", "baseline", "view", "tolerance", "pixels"),
    [
        ("d415", 920, 55, (65, 40), 5, (101.2, 50.6, 16.9)),
        ("d435", 430, 50, (87, 58), 3, (43.0, 21.5, 7.2)),
        ("d455", 430, 95, (87, 58), 3, (81.7, 40.9, 13.6)),
        ("kinect-v1", 580, 75, (57, 43), 2, (87.0, 43.5, 14.5)),
    ],
)
def test_rigs_have_the_published_geometry(name, focal, baseline, view, tolerance, pixels):
    rig = SENSORS[name].rig
    assert (rig.focal, rig.baseline) == (focal, pytest.approx(baseline / 1000))
    assert degrees(rig.width / 2 / rig.focal) == pytest.approx(view[0], abs=tolerance)
    assert degrees(rig.height / 2 / rig.focal) == pytest.approx(view[1], abs=tolerance)
    np.testing.assert_allclose(rig.disparity(np.array([0.5, 1, 3])), pixels, atol=0.1)


def test_the_d435_throws_about_5000_spots_over_its_published_field():
    pattern = SENSORS["d435"].pattern
    assert pattern.columns * pattern.rows / 9 == pytest.approx(5000, rel=0.02)
    assert degrees(pattern.tan_half_width) == pytest.approx(90, abs=0.1)
    assert degrees(pattern.tan_half_height) == pytest.approx(63, abs=0.1)


def test_the_d415_throws_a_dot_per_105_to_150_pixels_that_adds_as_much_as_measured(renderer):
    sensor = SENSORS["d415"]
    rig, pattern = sensor.rig, sensor.pattern
    area = 4 * rig.focal**2 * pattern.tan_half_width * pattern.tan_half_height
    dots = len(rosette_places(pattern.columns, pattern.rows, pattern.seed))
    assert 105 <= area / dots <= 150
    for distance in sensor.placement.radius:
        region, seen = Region(520, 260, 240, 200), []
        for projector in (sensor.light.projector, 0.0):
            lit = changed(sensor, "light.projector", projector)
            lit = changed(lit, "exposure.coherent", 0.0)  # one picture per view
            pair = photograph(renderer, [painted(wall(distance))], lit, [VIEW], [0], [region])[0]
            seen.append(blur(pair.canvas(region)[0], sensor.exposure.psf))
        on, off = seen
        assert 0.04 <= on.mean() / off.mean() - 1 <= 0.32
        # Through three pixels of a Gaussian, wherever its peak lies between them.
        spots = np.maximum(on - off, 1e-9)
        peaks = (spots == cv2.dilate(spots, np.ones((7, 7)))) & (spots > 0.5 * spots.max())
        y, x = np.nonzero(peaks[:, 1:-1])
        before, peak, after = np.log([spots[y, x + k] for k in range(3)])
        widths = np.sqrt(8 * np.log(2) / (2 * peak - before - after))
        assert np.median(widths) == pytest.approx(3.3, abs=0.2)


def quietest(image) -> float:
    """Noise from pixel to pixel of the quietest twentieth of patches at 50 to 100 grey levels."""
    kernel = np.array([[1, -2, 1], [-2, 4, -2], [1, -2, 1]]) / 6  # of planes it leaves nothing
    grey = image.astype(np.float64)
    apart = cv2.filter2D(grey, -1, kernel)
    mean, square = (cv2.blur(x, (7, 7))[5:-5:6, 5:-5:6] for x in (grey, apart**2))
    return float(np.sqrt(np.quantile(square[(mean > 50) & (mean < 100)], 0.05)))


@pytest.mark.parametrize("name", ["d435", "d455"])
def test_the_rooms_light_is_as_quiet_as_in_a_real_pair(name, d435_pair, renderer):
    """A laser's speckle lies on its own light alone; on all light it gave 28 grey levels."""
    sensor = changed(SENSORS[name], "light.projector", 0.0)
    region = Region(320, 160, 200, 160)
    image = Bench(sensor, renderer).shoot([painted(wall(1.5), 0.4)], region).left
    image = (image * (75 / image.mean())).astype(np.float32)  # at the real one's exposure
    assert quietest(d435_pair[0]) == pytest.approx(0.8, abs=0.2)
    assert quietest(image) == pytest.approx(quietest(d435_pair[0]), abs=0.3)


@pytest.mark.parametrize("name", REAL)
def test_real_cameras_are_metric_and_their_parts_agree(name):
    sensor = SENSORS[name]
    rig, pattern, depth = sensor.rig, sensor.pattern, sensor.depth
    assert sensor.metric
    assert sensor.matching.left_band == "physical"
    assert sensor.matching.method == ("zncc" if name == "kinect-v1" else "ad-census")
    # The search reaches to the near end of the gate.
    assert rig.disparity(depth.near) <= sensor.matching.num_disparities
    # The pattern covers the left image at the far end of the gate.
    offset = rig.baseline * rig.projector_offset / depth.far
    assert pattern.tan_half_width >= rig.width / 2 / rig.focal + offset - 1e-2
    assert pattern.tan_half_height >= rig.height / 2 / rig.focal
    # The object's centre is within the image's height wherever the rig stands, half the object
    # above and below it.
    near = sensor.placement.radius[0]
    assert rig.height / 2 / rig.focal * near >= 0.5 * sensor.object_size
    assert near - sensor.object_size > 0
    # At least 2,048 pixels of the grid on a square a quarter as large as the object, 5 views.
    pixels = rig.focal * sensor.object_size / sensor.placement.radius[1] / depth.stride
    assert 5 * pixels**2 / 4 > 2048


def test_the_released_scanner_is_as_it_was():
    assert SENSORS["paper"] == Sensor()
    assert SENSORS["paper"].rig == StereoRig(1080, 1080, 1500.0, 0.1, 0.5)
    assert SENSORS["paper"].matching == MatchingSettings("opencv-bm", 160, 19, left_band="opencv")
    assert not any(SENSORS[name].metric for name in SENSORS if name not in REAL)
    assert SENSORS["qs3-800"].rig.baseline == 0.2
    assert SENSORS["bright-room"].exposure == ExposureSettings(gain=0.7, noise=1.0)


def test_records_leave_out_the_description_and_where_a_picture_lies(tmp_path):
    (tmp_path / "dots.png").write_bytes(b"content")
    sensor = dataclasses.replace(
        SENSORS["d435"], pattern=PatternSettings(image=str(tmp_path / "dots.png"))
    )
    plain = settings_dict(sensor)
    assert "description" not in plain
    assert plain["pattern"]["image"]["name"] == "dots.png"
    assert str(tmp_path) not in str(plain)
    assert plain == settings_dict(dataclasses.replace(sensor, description="other"))


@pytest.mark.parametrize("base", ["", 'base = "kinect-v1"\n'])
def test_every_sensor_goes_through_a_file_unchanged_whatever_its_base(base, tmp_path):
    for sensor in SENSORS.values():
        assert load_sensor(write(tmp_path, base + sensor_toml(sensor))) == sensor


def test_every_field_is_written_with_its_meaning():
    lines = sensor_toml(SENSORS["d435"]).splitlines()
    keys = [i for i, line in enumerate(lines) if line and not line.startswith("# ")]
    assert len(keys) > 50
    assert all(lines[i - 1].startswith("# ") for i in keys)
    assert max(map(len, lines)) <= 100


@pytest.mark.parametrize("text", ['a "quoted" one', "back\\slash für # 3 m"])
def test_awkward_texts_and_numbers_survive(text, tmp_path):
    sensor = dataclasses.replace(
        Sensor(),
        name=text,
        rig=StereoRig(focal=1e3 / 3, baseline=1e-5 / 7),
        light=dataclasses.replace(Sensor().light, projector=1.0e22),
    )
    written = sensor_toml(sensor)
    assert tomllib.loads(written)["name"] == text
    assert load_sensor(write(tmp_path, written)) == sensor


def test_a_file_gives_only_what_differs_from_its_base(tmp_path):
    path = write(tmp_path, 'base = "d435"\n[rig]\nbaseline = 0.1\n[matching]\nblock_size = 15\n')
    base, sensor = SENSORS["d435"], load_sensor(path)
    assert sensor.name == "mine"
    assert sensor.rig == dataclasses.replace(base.rig, baseline=0.1)
    assert sensor.matching == dataclasses.replace(base.matching, block_size=15)
    rest = {"name": base.name, "description": base.description}
    assert dataclasses.replace(sensor, rig=base.rig, matching=base.matching, **rest) == base
    assert load_sensor(str(path)) == sensor


def test_what_the_matcher_never_reads_is_not_written_and_refused_if_given(tmp_path):
    for sensor in SENSORS.values():
        written = tomllib.loads(sensor_toml(sensor))["matching"]
        assert not unread(sensor.matching.method).keys() & written.keys()
        assert (
            written.keys() | unread(sensor.matching.method).keys() == vars(sensor.matching).keys()
        )
    # Another matcher than the base's leaves what only the base's reads.
    path = write(
        tmp_path, 'base = "d435"\nmatching = {method = "opencv-bm", bias_correction = true}'
    )
    assert load_sensor(path).matching.min_region == MatchingSettings().min_region
    for text in (
        'base = "d435"\nmatching.texture = 2.0',  # the default, but given
        'base = "kinect-v1"\nmatching.ad_census.arm = 9',
        "matching.min_region = 0",
        'base = "d435"\nmatching.method = "zncc"\nmatching.ad_census.arm = 3',
    ):
        with pytest.raises(InputError, match=r"mine.toml: matching: .* never reads") as caught:
            load_sensor(write(tmp_path, text))
        assert "\n" not in str(caught.value)


def test_a_picture_is_looked_for_beside_the_file(tmp_path, monkeypatch):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "dots.png").write_bytes(b"x")
    path = write(tmp_path / "parts", '[pattern]\nimage = "dots.png"\n')
    monkeypatch.chdir(tmp_path)
    sensor = load_sensor(path.relative_to(tmp_path))
    assert sensor.pattern.image == str((tmp_path / "parts" / "dots.png").resolve())
    # Shown in full and written elsewhere it is still found.
    assert load_sensor(write(tmp_path, sensor_toml(sensor))) == sensor


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[rig]\nbaselne = 0.1", "'rig.baselne'.*did you mean rig.baseline"),
        ("[rgi]\nfocal = 3.0", "'rgi'.*did you mean rig"),
        ("base = 'd345'", "base: .*'d345'.*d435"),
        ("[rig]\nfocal = true", "'rig.focal': True is not a number"),
        ("[rig]\nwidth = 848.0", "'rig.width': 848.0 is not a whole number"),
        ("[rig]\nsecond = 'eye'", "'rig.second': 'eye' must be one of camera, pattern"),
        ("[pattern]\nimage = '../absent.png'", r"pattern.image: .*/\.\./absent.png: no such file"),
        # What the settings themselves refuse.
        ("[rig]\nsecond = 'pattern'", "projector_offset"),
        ('base = "d435"\nobject_size = 60.0', r"placement.radius: 1.2 … 2 lies within.*size 60"),
        # What does not go together.
        ("[exposure]\nbits = 10", "opencv-bm takes 8 bits"),
        ("[depth]\nnear = 1.0\nfar = 1.5", "outside the depth gate.* 2 to 6.* 1 … 1.5"),
        ("base = 'd435'\n[rig]\nbaseline = 10.0", "f·b/z of 1536 px"),
        ("base = 'd435'\n[rig]\nbaseline = 50.0", "divide millimetres by 1000"),
        ("base = 'd435'\n[depth]\nfar = 3000", "depth.far 3000 is in metres.*divide millimetres"),
        (
            "base = 'd435'\nplacement.radius = [500, 900]\ndepth = { near = 300, far = 3000 }",
            "placement.radius 900 is in metres.*divide millimetres by 1000",
        ),
    ],
)
def test_faults_of_a_file_are_one_line_that_names_it(text, message, tmp_path):
    path = write(tmp_path, text + "\n")
    with pytest.raises(InputError, match=f"mine.toml: .*{message}") as caught:
        load_sensor(path)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < 500 + len(str(path))
