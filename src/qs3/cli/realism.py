"""``qs3 realism``: the simulated camera's matcher on a real infrared pair."""

from dataclasses import dataclass
from pathlib import Path

from qs3.cli.options import Flat
from qs3.cli.text import columns, notify, show
from qs3.frames.infrared import PairFiles
from qs3.sensor.matching.settings import Method
from qs3.sensor.stage.settings import ScanSettings


@dataclass(frozen=True)
class PairCamera:
    """The simulated camera whose matcher is measured."""

    sensor: str = "d435"
    """Sensor by name (qs3 sensors lists them) or TOML file."""
    matching: Method | None = None
    """Matcher, as in qs3 scan; default: the sensor's."""
    bias_correction: bool = False
    """Subtract the 1/32 px by which OpenCV's block matching rounds up."""


def realism(
    out: Path,
    files: Flat[PairFiles],
    camera: Flat[PairCamera] = PairCamera(),
) -> int:
    """Compare a simulated camera's matcher with a real camera's own depth of the same images.

    Args:
        out: Folder to write: pair.json and pair.png.
        files: A real camera's images and depth.
        camera: The simulated camera.
    """
    from qs3.report import realism as records

    chosen = ScanSettings(
        camera.sensor, matching=camera.matching, bias_correction=camera.bias_correction
    )
    record = records.compare_pair(out, files.read(), chosen.make_sensor(), files.checksums())
    show(*columns(records.pair_table(record)))
    notify(*record["notes"], f"Look at {out / records.PAIR_PLOT} and {out / records.PAIR_RECORD}")
    return 0
