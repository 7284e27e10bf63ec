"""The folder of a test of a simulated camera: a record to go on from after a stop, and plots."""

import dataclasses
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from qs3.errors import InputError
from qs3.evaluation import versions
from qs3.files import claim_folder, read_json, write_json
from qs3.report.figure import write_png
from qs3.report.realism import REALISM_PLOTS, realism_plot
from qs3.sensor.presets import Sensor, sensor_name, settings_dict
from qs3.sensor.realism import RealismSettings, realism
from qs3.sensor.render import Renderer
from qs3.sensor.settings import renderer_dict
from qs3.structure import fill, first_difference, unstructure

RECORD = "realism.json"


def test_camera(
    out: Path,
    sensor: Sensor,
    renderer: Renderer,
    settings: RealismSettings,
    on_result: Callable[[dict[str, Any], bool], None],
    device: str = "cpu",
) -> list[dict[str, Any]]:
    """Test a camera; results that the folder holds already are taken from it.

    Args:
        out: New or empty folder, or one of earlier tests of the same camera.
        sensor: The sensor.
        renderer: What photographs; its settings are a dataclass.
        settings: Which tests, how thoroughly.
        on_result: Called with each result, and whether it was there before.
        device: Where ``ad-census`` searches, ``cpu`` or ``cuda``, to the same bits.

    Returns:
        A result for each test of ``settings``, as `qs3.sensor.realism.realism` gives them.

    Raises:
        InputError: where the folder holds something else, or tests of other settings.
    """
    made_by = {
        "sensor": settings_dict(sensor),
        "renderer": renderer_dict(renderer),
        "settings": {"quick": settings.quick, "seed": settings.seed},
        "versions": versions(),
    }
    own: Any = renderer  # a dataclass
    defaults = {
        "sensor": settings_dict(Sensor()),
        "renderer": {field.name: field.default for field in dataclasses.fields(own)},
        "settings": unstructure(RealismSettings()),
    }
    before = _earlier(Path(out) / RECORD, made_by, defaults)
    results = dict(before)
    folder = claim_folder(out, RECORD)

    def keep(result: dict[str, Any]) -> None:
        results[result["id"]] = result
        if result["id"] not in before:
            ordered = sorted(results.values(), key=lambda result: int(result["id"][1:]))
            write_json(folder / RECORD, made_by | {"tests": ordered})
        on_result(result, result["id"] in before)
        figure = realism_plot(result, sensor)
        if figure is not None:
            write_png(folder / REALISM_PLOTS[result["id"]], figure)

    write_json(folder / RECORD, made_by | {"tests": list(before.values())})
    return realism(sensor, renderer, settings, device=device, done=before, on_result=keep)


def _earlier(
    path: Path, made_by: Mapping[str, Any], defaults: Mapping[str, Any]
) -> dict[str, dict[str, Any]]:
    """Results that lie in the folder, by id, where they are of the same settings.

    Settings that a record does not have were added since: it has their ``defaults``.
    """
    if not path.is_file():
        return {}
    record = read_json(path)
    if not isinstance(record, dict) or not isinstance(record.get("tests"), list):
        raise InputError(f"{path}: not a record of qs3 realism; name another folder for --out")
    if isinstance(record.get("sensor"), dict) and "name" in record["sensor"]:
        record["sensor"]["name"] = sensor_name(record["sensor"]["name"])
    now = unstructure(made_by)
    before = fill({name: record.get(name) for name in now}, now, unstructure(defaults))
    if difference := first_difference(before, now):
        place, was, is_now = difference
        raise InputError(
            f"{path}: of other settings ({place} was {was}, is {is_now}); name another folder "
            "for --out, or repeat the settings to go on"
        )
    return {result["id"]: result for result in record["tests"]}
