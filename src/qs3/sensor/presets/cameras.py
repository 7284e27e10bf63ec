"""The presets: the released scanner, and real cameras in metres, with the source of each value.

Sources by their short names; docs/sensors.md gives them in full.

    DATASHEET    Intel RealSense D400 series, datasheet 337029
    TUNING       Intel's guide to tuning depth cameras
    PROJECTORS   Intel's page on the projectors of the D400 series
    SAPIEN       the stereo depth sensor of SAPIEN and SimSense, its presets and noise constants
    DREDS        the D415 of PKU-EPIC/DREDS
    KHOSHELHAM   Khoshelham and Elberink 2012, Sensors 12(2):1437
    REICHINGER   "Kinect pattern uncovered", 2011
"""

import dataclasses
import math

from qs3.sensor.depth import DepthSettings
from qs3.sensor.exposure import ExposureSettings
from qs3.sensor.matching import MatchingSettings
from qs3.sensor.presets.settings import Sensor
from qs3.sensor.render.scene import LightSettings
from qs3.sensor.rig import StereoRig
from qs3.sensor.speckle import PatternSettings
from qs3.sensor.views import Placement


def _half(degrees: float) -> float:
    """Tangent of half an opening angle."""
    return round(math.tan(math.radians(degrees) / 2), 4)


# Our choice: a room with little near infrared. A lit spot is 200 times as bright as the room's
# light on the same surface at 1 m, 22 times at 3 m; no window, so nothing is brighter above (sky).
_ROOM = LightSettings(projector=1.0, sky=0.0, sky_elevation=90.0, ambient=0.005)

# SAPIEN (after Landau et al., who measured a Kinect v1): Gamma speckle of shape 398.12, Gaussian
# noise of −0.231 ± 0.83 grey levels. Our choice: a linear imager, a lens as sharp as half a pixel,
# and an exposure time that just suffices for a wall of albedo 0.6 at 3 m.
_IMAGER = ExposureSettings(
    response="linear",
    auto=0.6,
    max_gain=50.0,
    psf=0.5,
    speckle=398.12,
    noise=0.83,
    offset=-0.231,
)

# Our choice, from optics and to land where TUNING says that walls lie, 0.05 to 0.1 px: a laser's
# coherent speckle on pixels of 3 µm (the imager's maker) at f/2.0 (DATASHEET) and 850 nm, whose
# grains measure (0.85 µm · 2)² = 2.9 µm², 3.1 of them a pixel in each of two polarisations: shape
# 6 to 8.
_D4_IMAGER = dataclasses.replace(_IMAGER, speckle=7.0)

# TUNING and Intel's page on subpixel linearity: 128 disparities in steps of 1/32 px; the left band
# is as wide as the disparity. Our choice: ZNCC in place of the ASIC's census and semi-global
# matching, which in OpenCV's form locks to whole pixels on spots. A block of 17 is the smallest
# that sees three spots nearly everywhere: on a wall it fills 100 %, one of 13 98 %. With 19 the
# noise of slanted faces stays nearer to a facing wall's (`qs3 realism`, T10).
_D4 = MatchingSettings(
    method="zncc",
    num_disparities=128,
    block_size=19,
    left_band="physical",
    quantum=1 / 32,
    left_right=1.0,
    uniqueness=0.03,
    median=3,
)

# PROJECTORS: 90° × 63°, about 5,000 spots. Ours are 90 × 56 = 5,040, one in each 3×3 tile of cells;
# a spot is 2.2 px wide (our choice).
_WIDE_SPOTS = PatternSettings(
    columns=270,
    rows=168,
    kind="spots",
    tan_half_width=_half(90.0),
    tan_half_height=_half(63.0),
    spot_size=0.7,
)

# Intel's order of host filters begins with a decimation by 2; also the grid of our points.
_STRIDE = 2

D435 = Sensor(
    name="d435",
    description="RealSense D435: global shutter, wide, short baseline",
    metric=True,
    object_size=0.8,
    # SAPIEN: f 430.14, b 50.2 mm, projector 29 mm from the left camera. DATASHEET: 848×480, 50 mm.
    rig=StereoRig(848, 480, 430.0, 0.05, projector_offset=0.58),
    pattern=_WIDE_SPOTS,
    light=_ROOM,
    exposure=_D4_IMAGER,
    matching=_D4,
    # DATASHEET: min-Z 195 mm at 848×480. Far: our choice, twice the recommended 3 m.
    depth=DepthSettings(near=0.195, far=6.0, stride=_STRIDE),
    # Our choice: 0.8 m objects fill a third to two thirds of the image's height.
    placement=Placement(radius=(1.2, 2.0)),
)

D455 = dataclasses.replace(
    D435,
    name="d455",
    description="RealSense D455: global shutter, wide, long baseline",
    # DATASHEET: 95 mm. Our choice: the D435's optics at 848×480, the projector half way.
    rig=StereoRig(848, 480, 430.0, 0.095, projector_offset=0.5),
    # f·b/110, as the D435's min-Z is.
    depth=DepthSettings(near=0.37, far=6.0, stride=_STRIDE),
    placement=Placement(radius=(1.2, 2.4)),
)

D415 = dataclasses.replace(
    D435,
    name="d415",
    description="RealSense D415: rolling shutter, narrow, dense spots",
    # SAPIEN: 1280×720, f 920. DATASHEET: 55 mm. DREDS: projector at 51 % of the baseline.
    rig=StereoRig(1280, 720, 920.0, 0.055, projector_offset=0.51),
    # PROJECTORS: two units, denser and narrower than the D435's. We model one projector; that it
    # covers a little more than the image of 70° × 43° and has 156 × 93 = 14,508 spots is our
    # choice: one in 64 px², where the D435 has one in 90.
    pattern=PatternSettings(
        columns=468,
        rows=279,
        kind="spots",
        tan_half_width=_half(72.0),
        tan_half_height=_half(45.0),
        spot_size=0.8,
    ),
    # DATASHEET: min-Z 450 mm at 1280×720. Its image is larger: every third pixel.
    depth=DepthSettings(near=0.45, far=6.0, stride=3),
    # The narrow image takes in an object of 0.8 m from 1.5 m.
    placement=Placement(radius=(1.5, 2.5)),
)

KINECT_V1 = Sensor(
    name="kinect-v1",
    description="Kinect v1: one camera and the stored pattern, 1/8 px",
    metric=True,
    object_size=0.8,
    # KHOSHELHAM: 640×480, f 580 px, b 75 mm; the projector is the second, virtual camera.
    rig=StereoRig(640, 480, 580.0, 0.075, projector_offset=1.0, second="pattern"),
    # REICHINGER: 633×495 cells, one spot in nine. Our choice: it covers a little more than the
    # image of 58° × 45°; a cell is 1.1 px wide, a spot 2 px: narrower ones lock to pixels.
    pattern=PatternSettings(
        columns=633,
        rows=495,
        kind="spots",
        tan_half_width=0.6,
        tan_half_height=0.45,
        spot_size=1.8,
    ),
    light=_ROOM,
    # Our choice, so that a wall is as noisy as KHOSHELHAM measured, 1.43 mm at 1 m: Landau's shape
    # of 398 gives 1.2 mm, 60 gives 1.4 mm.
    exposure=dataclasses.replace(_IMAGER, speckle=60.0),
    # KHOSHELHAM: steps of 1/8 px. 9×9: the window that simkinect and BlenSor take it to have.
    # 64 disparities reach from 0.68 m.
    matching=MatchingSettings(
        method="zncc",
        num_disparities=64,
        block_size=9,
        left_band="physical",
        quantum=1 / 8,
        left_right=1.0,
        uniqueness=0.03,
        median=0,
    ),
    # KHOSHELHAM: 0.7 to 6 m.
    depth=DepthSettings(near=0.7, far=6.0, stride=_STRIDE),
    placement=Placement(radius=(1.5, 2.5)),
)

_PAPER = Sensor()
_PAPER_800 = Sensor(
    name="qs3-800",
    description="the geometry of the stereo pair in the released code's history",
    rig=StereoRig(width=800, height=800, focal=800 * 50 / 36, baseline=0.2),
    placement=Placement(radius=(1.95, 1.95)),
)
_BRIGHT_ROOM = Sensor(
    name="bright-room",
    description="the paper's camera in a brighter room, with a grainy imager",
    light=LightSettings(sky=0.8, ambient=0.08),
    exposure=ExposureSettings(gain=0.7, noise=1.0),
)

SENSORS: dict[str, Sensor] = {
    sensor.name: sensor
    for sensor in (_PAPER, _PAPER_800, _BRIGHT_ROOM, D415, D435, D455, KINECT_V1)
}
