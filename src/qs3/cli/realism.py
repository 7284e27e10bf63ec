"""``qs3 realism``: the simulated camera against laws of real ones."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from qs3.cli.options import Flat
from qs3.cli.text import columns, show, tell
from qs3.errors import InputError
from qs3.io.extract.infrared import PairFiles
from qs3.sensor.realism import RealismSettings
from qs3.sensor.realism.pair import InfraredPair
from qs3.sensor.settings import CameraSettings

_VERDICTS = {True: "pass", False: "MISS", None: ""}
_PAIR_FIGURES = (
    ("valid", "valid pixels right of the left band", "%"),
    ("holes", "of these only the other has", "%"),
    ("plane_rms_px", "RMS on planes [px]", ""),
    ("autocorrelation", "its autocorrelation at 1, 4, 8 px along x", ""),
    ("median_abs_px", "median |difference of disparity| [px]", ""),
    ("difference_px", "median difference, ours − the camera's [px]", ""),
    ("scale", "scale, ours / the camera's", ""),
    ("over_1px", "more than 1 px off", "%"),
    ("over_1px_near_steps", "the same near steps of 4 px", "%"),
    ("over_3px", "more than 3 px off", "%"),
)


def realism(
    out: Path,
    strict: bool = False,
    settings: Flat[RealismSettings] = RealismSettings(),  # noqa: B008
    camera: Flat[CameraSettings] = CameraSettings(sensor="d435"),  # noqa: B008
    files: Flat[PairFiles] = PairFiles(),  # noqa: B008
) -> int:
    """Test a simulated camera against the laws of real ones.

    Prints measured and expected figures of six laws and writes a record. With --pair, compares its
    matcher on a real infrared pair with the real camera's own depth.

    Args:
        out: Folder to write: realism.json, or pair.json and pair.png.
        strict: End with exit code 1 if a test misses.
        settings: Settings of the tests.
        camera: The tested camera.
        files: A real camera's images and depth.
    """
    pair = files.read()
    if pair is not None:
        usual = CameraSettings(camera.sensor, matching=camera.matching,
                               bias_correction=camera.bias_correction)  # fmt: skip
        if strict or settings != RealismSettings() or camera != usual:
            raise InputError("--pair: takes --sensor, --matching and --bias-correction alone")
        return _pair(out, pair, camera, files)
    from qs3.report.realism import RECORD, test_camera

    results = test_camera(out, camera.make_sensor(), camera.make_renderer(), settings)
    show(*table(results))
    missed = [result["id"] for result in results if not result["passed"]]
    tell(
        f"{len(results) - len(missed)} passed, {len(missed)} missed. "
        f"The record is in {out / RECORD}"
    )
    return 1 if strict and missed else 0


def _pair(out: Path, pair: InfraredPair, camera: CameraSettings, files: PairFiles) -> int:
    """Compare the matcher with a real camera's own depth."""
    from qs3.report.realism import PAIR_PLOT, PAIR_RECORD, compare_pair

    record = compare_pair(out, pair, camera.make_sensor(), files.checksums())
    show(*pair_table(record))
    tell(*record["notes"], f"Look at {out / PAIR_PLOT} and {out / PAIR_RECORD}")
    return 0


def pair_table(record: Mapping[str, Any]) -> list[str]:
    """Return the lines of the table: what, ours, the camera's."""

    def cell(value: Any, unit: str) -> str:
        if isinstance(value, list):
            return " ".join(cell(part, unit) for part in value)
        return "–" if value is None else f"{value:.2%}" if unit == "%" else f"{value:.3f}"

    rows = [("", "ours", "the camera")]
    for name, what, unit in _PAIR_FIGURES:
        camera = f"camera_{name}"
        theirs = cell(record[camera], unit) if camera in record else ""
        rows.append((what, cell(record[name], unit), theirs))
    return columns(rows)


def table(results: Sequence[Mapping[str, Any]]) -> list[str]:
    """Return the lines of the table: test, what, measured, expected, verdict."""
    cells = [("test", "what", "measured", "expected", "")]
    for result in results:
        cells.append((result["id"], result["title"], "", "", _VERDICTS[result["passed"]]))
        for row in result["rows"]:
            unit = row["unit"] and f" {row['unit']}"
            value = "–" if row["measured"] is None else _number(row["measured"]) + unit
            bounds = f"{row['expected']}{unit}" if row["expected"] else ""
            cells.append(("", row["what"], value, bounds, _VERDICTS[row["passed"]]))
    return columns(cells)


def _number(value: float) -> str:
    """Four digits, whole numbers in full: 117,123 rather than 1.171e+05."""
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:.4g}"
