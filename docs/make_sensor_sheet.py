"""Draw the contact sheet of the sensor: every material, every scene and every preset.

Each cell shows the left image above the sensor's depth and the true depth of the object.

Usage: ``python docs/make_sensor_sheet.py [--sensor d435] [--out docs/images/sensor.png]``
"""

import argparse
import dataclasses
import hashlib
import json
from pathlib import Path

import cv2
import numpy as np
from jaxtyping import Float, UInt8
from PIL import Image
from PIL.PngImagePlugin import PngInfo

from qs3 import shapes
from qs3.errors import InputError
from qs3.sensor.materials import MATERIALS
from qs3.sensor.presets import SENSORS, Sensor, get_sensor, settings_dict
from qs3.sensor.render.mitsuba import MitsubaRenderer
from qs3.sensor.scan import scan

_SCENES = ("alone", "floor", "wall", "room", "behind", "beside")
_CELL, _LINE = 190, 22
PICTURE = Path(__file__).parent / "images" / "sensor.png"


def presets() -> str:
    """Fingerprint of all presets: by what the picture tells whether it is of them."""
    plain = {name: settings_dict(sensor) for name, sensor in SENSORS.items()}
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def cell(title: str, sensor: Sensor, scene: str = "alone") -> UInt8[np.ndarray, "h w 3"]:
    """One scan of a chair: left image, depth and true depth, with its figures below the title."""
    neighbour = shapes.make("cabinet", seed=2) if scene in ("behind", "beside") else None
    # Shiny surfaces are path traced and need many rays; the others do not.
    renderer = MitsubaRenderer(samples=4 if sensor.material.rough else 64)
    try:
        made = scan(
            shapes.make("chair", seed=3),
            sensor=sensor,
            views=1,
            seed=4,
            scene=scene,
            neighbour=neighbour,
            crop="none",
            renderer=renderer,
            keep_images=True,
        )
    except InputError as error:
        if "saw no point" not in str(error):
            raise
        return _labelled(title, "no point seen", [np.full((_CELL, _CELL, 3), 40, np.uint8)] * 3)
    view, images = made.views[0], made.images[0]
    left = cv2.convertScaleAbs(images.left, alpha=255 / np.iinfo(images.left.dtype).max)
    if images.left.dtype == np.uint16:
        left = (images.left >> 2).astype(np.uint8)
    known = images.true_depth[np.isfinite(images.true_depth)]
    limits = (float(known.min()), float(known.max()))
    pictures = [
        np.repeat(left[..., None], 3, axis=2),
        _coloured(images.depth, limits),
        _coloured(images.true_depth, limits),
    ]
    figures = f"fill {view.valid_fraction or 0:.0%}"
    if view.disparity_sigma is not None:
        figures += f", sigma {view.disparity_sigma:.3f} px"
    return _labelled(title, figures, pictures)


def _coloured(
    depth: Float[np.ndarray, "h w"], limits: tuple[float, float]
) -> UInt8[np.ndarray, "h w 3"]:
    low, high = limits
    share = np.clip((depth - low) / max(high - low, 1e-9), 0, 1)
    levels = np.nan_to_num(255 * (1 - share)).astype(np.uint8)
    picture = cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)
    picture[~np.isfinite(depth)] = 40
    return picture


def _labelled(title: str, figures: str, pictures: list[np.ndarray]) -> UInt8[np.ndarray, "h w 3"]:
    head = np.full((2 * _LINE, _CELL, 3), 255, np.uint8)
    for line, text in enumerate((title, figures)):
        place = (4, _LINE * (line + 1) - 6)
        cv2.putText(head, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([head, *(_fitted(picture) for picture in pictures)])


def _fitted(picture: UInt8[np.ndarray, "h w 3"]) -> UInt8[np.ndarray, "h2 w2 3"]:
    """The picture in a square cell, its shape kept."""
    height, width = picture.shape[:2]
    scale = _CELL / max(height, width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    square = np.full((_CELL, _CELL, 3), 255, np.uint8)
    top, left = (_CELL - small.shape[0]) // 2, (_CELL - small.shape[1]) // 2
    square[top : top + small.shape[0], left : left + small.shape[1]] = small
    return square


def sheet(sensor: Sensor) -> UInt8[np.ndarray, "h w 3"]:
    """Three rows: materials in a room and scenes as ``sensor`` sees them, and all presets."""
    rows = [
        # In a room: of a mirror or a pane that stands alone there is nothing to be seen.
        [
            cell(name, dataclasses.replace(sensor, material=material), "room")
            for name, material in MATERIALS.items()
        ],
        [cell(name, sensor, name) for name in _SCENES],
        [cell(name, preset) for name, preset in SENSORS.items()],
    ]
    width = max(len(row) for row in rows)
    blank = np.full_like(rows[0][0], 255)
    return np.vstack([np.hstack(row + [blank] * (width - len(row))) for row in rows])


def main() -> None:
    """Write the sheet that the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--sensor", default="d435")
    parser.add_argument("--out", type=Path, default=PICTURE)
    args = parser.parse_args()
    picture = sheet(get_sensor(args.sensor))
    args.out.parent.mkdir(parents=True, exist_ok=True)
    about = PngInfo()
    about.add_text("presets", presets())
    Image.fromarray(picture[..., ::-1]).save(args.out, pnginfo=about, optimize=True)


if __name__ == "__main__":
    main()
