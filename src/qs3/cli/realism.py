"""``qs3 realism``: the simulated camera against what real ones are known to do."""

import dataclasses
import sys
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

_VERDICTS = {True: "pass", False: "MISS", None: "does not apply"}


def realism(
    out: Path,
    strict: bool = False,
    settings: Flat[RealismSettings] = RealismSettings(),  # noqa: B008
    camera: Flat[CameraSettings] = CameraSettings(sensor="d435"),  # noqa: B008
    files: Flat[PairFiles] = PairFiles(),  # noqa: B008
) -> int:
    """Test a simulated camera against the laws of real ones.

    Eleven laws, measured beside expected: a table, a record and plots. Or, with --pair, its matcher
    on a real infrared pair beside the depth that the real camera made of it.

    Args:
        out: Folder to write: realism.json and plots. Run the same command again to go on after a
            stop.
        strict: End with exit code 1 where a test misses; without, a miss is a result like any
            other.
        settings: Which tests.
        camera: What is tested.
        files: A real camera's images and depth.
    """
    pair = files.read()
    if pair is not None:
        if strict or settings != RealismSettings():
            raise InputError("--pair: takes none of --strict, --quick, --seed and --tests")
        unused = [
            f"--{field.name.replace('_', '-')}"
            for field in dataclasses.fields(camera)
            if field.name not in ("sensor", "matching", "bias_correction")
            and getattr(camera, field.name) != field.default
        ]
        if unused:
            raise InputError(f"--pair: renders nothing, and takes no {', '.join(unused)}")
        return _pair(out, pair, camera, files)
    from tqdm import tqdm

    from qs3.report.realism import test_camera

    def say(result: dict[str, Any], before: bool) -> None:
        cost = "done before" if before else f"{result['seconds']:.1f} s"
        tqdm.write(f"{result['id']} {_VERDICTS[result['passed']]}, {cost}", file=sys.stderr)

    renderer = camera.make_renderer()
    results = test_camera(out, camera.make_sensor(), renderer, settings, say)
    show(*table(results))
    tell(*_summary(results, out))
    missed = any(result["passed"] is False for result in results)
    return 1 if strict and missed else 0


def _pair(out: Path, pair: InfraredPair, camera: CameraSettings, files: PairFiles) -> int:
    """Hold the matcher against a real camera's own depth."""
    from qs3.report.pair import PAIR_PLOT, PAIR_RECORD, compare_pair

    record = compare_pair(out, pair, camera.make_sensor(), files.checksums())
    show(*pair_table(record))
    tell(*record["notes"], f"Look at {out / PAIR_PLOT} and {out / PAIR_RECORD}")
    return 0


def pair_table(record: Mapping[str, Any]) -> list[str]:
    """Lines of the table: what, ours, the camera's."""

    def cell(value: Any, unit: str = "") -> str:
        if isinstance(value, dict):
            value = [value["median"], value["p10"], value["p90"]]
        if isinstance(value, list):
            return " ".join("–" if part is None else f"{part:.2f}" for part in value)
        return "–" if value is None else f"{value:.2%}" if unit == "%" else f"{value:.3f}"

    rows = [("", "ours", "the camera")]
    for name, what, unit in (
        ("valid", "valid pixels right of the left band", "%"),
        ("holes", "of these only the other has", "%"),
        ("edge_spill_px", "spill beyond edges: median, p10, p90 [px]", ""),
        ("plane_rms_px", "RMS on planes [px]", ""),
        ("autocorrelation", "its autocorrelation at 1, 4, 8 px along x", ""),
    ):
        rows.append((what, cell(record[name], unit), cell(record[f"camera_{name}"], unit)))
    rows.append(("median |difference of disparity| [px]", cell(record["median_abs_px"]), ""))
    rows.append(("median difference, ours − the camera's [px]", cell(record["difference_px"]), ""))
    rows.append(("scale, ours / the camera's", cell(record["scale"]), ""))
    rows.append(("more than 1 px off", cell(record["over_1px"], "%"), ""))
    rows.append(("more than 3 px off", cell(record["over_3px"], "%"), ""))
    return columns(rows)


def table(results: Sequence[Mapping[str, Any]]) -> list[str]:
    """Lines of the table: test, what, measured, expected, verdict.

    Example:
        >>> row = {"what": "slope", "measured": 2.0, "expected": "≥ 1", "unit": "", "passed": True}
        >>> lines = table([{"id": "T1", "title": "Noise", "passed": True, "rows": [row]}])
        >>> lines[-1].split()
        ['slope', '2', '≥', '1', 'pass']
    """
    cells = [("test", "what", "measured", "expected", "")]
    for result in results:
        why = f": {result['why']}" if result.get("why") else ""
        cells.append((result["id"], result["title"], "", "", _VERDICTS[result["passed"]] + why))
        for row in result["rows"]:
            unit = row["unit"] and f" {row['unit']}"
            value = "–" if row["measured"] is None else _number(row["measured"]) + unit
            bounds = f"{row['expected']}{unit}" if row["expected"] else ""
            verdict = "" if row["passed"] is None else _VERDICTS[row["passed"]]
            cells.append(("", row["what"], value, bounds, verdict))
    return columns(cells)


def _number(value: float) -> str:
    """Four digits, whole numbers in full: 117,123 rather than 1.171e+05."""
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:.4g}"


def _summary(results: Sequence[Mapping[str, Any]], folder: Path) -> list[str]:
    """What came out, which plots there are, and where to look."""
    from qs3.report.realism import REALISM_PLOTS, RECORD

    verdicts = {result["id"]: _VERDICTS[result["passed"]] for result in results}
    drawn = [folder / plot for plot in REALISM_PLOTS.values() if (folder / plot).is_file()]
    absent = [
        f"{plot} ({test} {verdicts.get(test, 'was not asked')})"
        for test, plot in REALISM_PLOTS.items()
        if folder / plot not in drawn
    ]
    counts = {verdict: list(verdicts.values()).count(verdict) for verdict in _VERDICTS.values()}
    look = " and ".join(map(str, [*drawn[:1], folder / RECORD]))
    return [
        *([f"no {', '.join(absent)}"] if absent else []),
        f"{counts['pass']} passed, {counts['MISS']} missed, {counts['does not apply']} do not "
        f"apply. Look at {look}",
    ]
