"""``qs3 realism``: the simulated camera against laws of real ones."""

from pathlib import Path

from qs3.cli.options import Flat
from qs3.cli.text import columns, show, tell
from qs3.errors import InputError
from qs3.io.extract.infrared import PairFiles
from qs3.sensor.realism import RealismSettings
from qs3.sensor.settings import CameraSettings


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
    from qs3.report import realism as records

    pair = files.read()
    if pair is not None:
        usual = CameraSettings(camera.sensor, matching=camera.matching,
                               bias_correction=camera.bias_correction)  # fmt: skip
        if strict or settings != RealismSettings() or camera != usual:
            raise InputError("--pair: takes --sensor, --matching and --bias-correction alone")
        record = records.compare_pair(out, pair, camera.make_sensor(), files.checksums())
        show(*columns(records.pair_table(record)))
        tell(*record["notes"], f"Look at {out / records.PAIR_PLOT} and {out / records.PAIR_RECORD}")
        return 0
    results = records.test_camera(out, camera.make_sensor(), camera.make_renderer(), settings)
    show(*columns(records.table(results)))
    missed = [result["id"] for result in results if not result["passed"]]
    tell(f"{len(results) - len(missed)} passed, {len(missed)} missed. "
         f"The record is in {out / records.RECORD}")  # fmt: skip
    return 1 if strict and missed else 0
