"""``qs3 realism``: the simulated camera against what real ones are known to do."""

import dataclasses
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro

from qs3.cli.camera import CameraOptions
from qs3.errors import InputError
from qs3.files import claim_folder, read_json, write_json

RECORD = "realism.json"


@dataclass(frozen=True)
class RealismOptions:
    """Test a simulated camera: ten laws of real ones, measured beside expected, and plots."""

    out: Path
    """Folder to write: realism.json and plots. Run the same command again to go on after a stop."""
    sensor: str = "d435"
    """A preset (qs3 sensors lists them: d415, d435, …) or your own TOML file."""
    tests: tuple[str, ...] = ()
    """Tests to do, such as T1 T3; all ten by default. Others may be added to the same folder."""
    quick: bool = False
    """Fewer targets and smaller parts of the frame; the bounds stay."""
    strict: bool = False
    """End with exit code 1 where a test misses; without, a miss is a result like any other."""
    seed: int = 0
    """All random steps follow from it."""
    image_noise: float | None = None
    """Gaussian noise of the images in grey levels of 255; default by sensor."""
    matching: Literal["opencv-bm", "zncc"] | None = None
    """OpenCV's block matching, or our own of twice the precision; default by sensor."""
    bias_correction: bool = False
    """Take off the 1/32 px by which OpenCV's block matching rounds up."""
    pattern: Path | None = None
    """Your own picture to project in place of the speckle dots."""
    renderer: Literal["mitsuba", "cycles"] = "mitsuba"
    """mitsuba, or cycles: the paper's renderer, Blender's (`make cycles` brings it)."""
    samples: int | None = None
    """Rays a pixel; default by renderer: 4 of mitsuba, 128 of cycles."""
    indirect: Literal["cached", "path"] = "cached"
    """Soft light of mitsuba: from an irradiance cache, or by plain path tracing (use 64 samples
    and more)."""
    variant: Literal["auto", "cuda_ad_mono", "llvm_ad_mono", "scalar_rgb"] = "auto"
    """Variant of Mitsuba; auto takes the fastest that works here."""

    @property
    def camera(self) -> CameraOptions:
        """The same camera as `scan` and `generate` make of these options."""
        shared = {f.name for f in dataclasses.fields(CameraOptions)}
        mine = {f.name for f in dataclasses.fields(self)}
        return CameraOptions(**{name: getattr(self, name) for name in shared & mine})


def realism(options: Annotated[RealismOptions, tyro.conf.arg(name="")]) -> int:
    """Test a simulated camera against the laws of real ones: a table, a record and plots."""
    from tqdm import tqdm

    from qs3.evaluation import versions
    from qs3.report.figure import write_png
    from qs3.report.realism import REALISM_PLOTS, realism_plot
    from qs3.sensor.presets import settings_dict
    from qs3.sensor.realism import RealismSettings
    from qs3.sensor.realism import realism as test_sensor

    wanted = _tests(options.tests)
    if options.seed < 0:
        raise InputError(f"--seed {options.seed}: must not be negative")
    settings = RealismSettings(quick=options.quick, seed=options.seed, tests=wanted)
    sensor = options.camera.resolve_sensor()
    renderer = options.camera.resolve_renderer()
    made_by = {
        "sensor": settings_dict(sensor),
        "renderer": {**dataclasses.asdict(renderer), **renderer.description},
        "settings": {"quick": options.quick, "seed": options.seed},
        "versions": versions(),
    }
    done = _earlier(options.out, made_by)
    folder = claim_folder(options.out, RECORD)
    there = [name for name in wanted if name in done]
    if there:
        print(f"{', '.join(there)}: done before, taken from {folder / RECORD}", file=sys.stderr)

    def keep(result: dict[str, Any]) -> None:
        new = result["id"] not in there
        done[result["id"]] = result
        if new:
            ordered = sorted(done.values(), key=lambda one: int(one["id"][1:]))
            write_json(folder / RECORD, made_by | {"tests": ordered})
            told = f"{result['id']} {_verdict(result['passed'])}, {result['seconds']:.1f} s"
            tqdm.write(told, file=sys.stderr)
        figure = realism_plot(result, sensor)
        if figure is not None:
            write_png(folder / REALISM_PLOTS[result["id"]], figure)

    write_json(folder / RECORD, made_by | {"tests": list(done.values())})
    results = test_sensor(sensor, renderer, settings, done=dict(done), on_result=keep)
    for line in table(results):
        print(line)
    _tell(results, folder)
    missed = any(result["passed"] is False for result in results)
    return 1 if options.strict and missed else 0


def _tests(given: Sequence[str]) -> tuple[str, ...]:
    """The tests asked for, in their order, each once."""
    from qs3.sensor.realism import LAWS

    unknown = [name for name in given if name.upper() not in LAWS]
    if unknown:
        raise InputError(f"--tests {unknown[0]}: no such test; choose of {' '.join(LAWS)}")
    asked = {name.upper() for name in given} or set(LAWS)
    return tuple(name for name in LAWS if name in asked)


def _earlier(folder: Path, made_by: Mapping[str, Any]) -> dict[str, dict[str, Any]]:
    """Results that lie in the folder, by id, where they are of the same settings."""
    import json

    path = Path(folder) / RECORD
    if not path.is_file():
        return {}
    record = read_json(path)
    if not isinstance(record, dict) or not isinstance(record.get("tests"), list):
        raise InputError(f"{path}: not a record of qs3 realism; name another folder for --out")
    now = json.loads(json.dumps(made_by))  # tuples become lists, as in the file
    for name, value in now.items():
        where = _difference(record.get(name), value, name)
        if where:
            raise InputError(
                f"{path}: of other settings ({where}); name another folder for --out, or repeat "
                "the settings to go on"
            )
    return {result["id"]: result for result in record["tests"]}


def _difference(old: Any, new: Any, name: str) -> str:
    """Where two settings differ first: "matching.method was zncc, is opencv-bm"."""
    if isinstance(old, dict) and isinstance(new, dict):
        found = (_difference(old.get(k), new.get(k), f"{name}.{k}") for k in old.keys() | new)
        return min((one for one in found if one), default="")
    return "" if old == new else f"{name} was {old}, is {new}"


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
        verdict = _verdict(result["passed"])
        why = f": {result['why']}" if result.get("why") else ""
        cells.append((result["id"], result["title"], "", "", verdict + why))
        for row in result["rows"]:
            unit = row["unit"] and f" {row['unit']}"
            value = "–" if row["measured"] is None else _number(row["measured"]) + unit
            bounds = f"{row['expected']}{unit}" if row["expected"] else ""
            verdict = "" if row["passed"] is None else _verdict(row["passed"])
            cells.append(("", row["what"], value, bounds, verdict))
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    return [
        "  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)).rstrip()
        for row in cells
    ]


def _number(value: float) -> str:
    """Four digits, whole numbers in full: 117,123 rather than 1.171e+05."""
    return f"{value:,.0f}" if float(value).is_integer() else f"{value:.4g}"


def _verdict(passed: bool | None) -> str:
    return {True: "pass", False: "MISS", None: "does not apply"}[passed]


def _tell(results: Sequence[Mapping[str, Any]], folder: Path) -> None:
    """What came out, which plots there are, and where to look."""
    from qs3.report.realism import REALISM_PLOTS

    absent = [name for name, plot in REALISM_PLOTS.items() if not (folder / plot).is_file()]
    verdicts = {result["id"]: _verdict(result["passed"]) for result in results}
    if absent:
        plots = (f"{REALISM_PLOTS[n]} ({n} {verdicts.get(n, 'was not asked')})" for n in absent)
        print(f"no {', '.join(plots)}", file=sys.stderr)
    counts = {True: 0, False: 0, None: 0}
    for result in results:
        counts[result["passed"]] += 1
    drawn = [plot for name, plot in REALISM_PLOTS.items() if name not in absent]
    look = f"{folder / drawn[0]} and {folder / RECORD}" if drawn else str(folder / RECORD)
    print(
        f"{counts[True]} passed, {counts[False]} missed, {counts[None]} do not apply. "
        f"Look at {look}",
        file=sys.stderr,
    )
