"""All ten tests in order, with what was done before taken over."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from tqdm import tqdm

from qs3.errors import InputError
from qs3.sensor.presets import Sensor
from qs3.sensor.realism import (
    checks_edges,
    checks_kinect,
    checks_scan,
    checks_surfaces,
    checks_wall,
)
from qs3.sensor.realism.results import TITLES
from qs3.sensor.realism.stage import Stage
from qs3.sensor.render import Renderer

CHECKS: dict[str, Callable[[Stage, int, bool], dict[str, Any]]] = {
    "T1": checks_wall.noise,
    "T2": checks_wall.bias,
    "T3": checks_wall.steps,
    "T4": checks_edges.bands,
    "T5": checks_edges.edges,
    "T6": checks_surfaces.fill,
    "T7": checks_surfaces.clear,
    "T8": checks_kinect.kinect,
    "T9": checks_wall.repeats,
    "T10": checks_scan.scanned,
}
"""What photographs and judges each test: stage, seed, quick."""


@dataclass(frozen=True)
class RealismSettings:
    """Which tests are done, and how thoroughly."""

    quick: bool = False
    """Fewer targets and smaller parts of the frame; the bounds stay."""
    seed: int = 0
    """All random steps follow from it."""
    tests: tuple[str, ...] = tuple(TITLES)
    """Tests to do, T1 to T10; others may be added to the same folder."""

    def __post_init__(self) -> None:
        asked = {test.upper(): test for test in self.tests}
        unknown = [test for name, test in asked.items() if name not in TITLES]
        if unknown or not asked:
            raise InputError(
                f"tests: no test {unknown[0] if unknown else ''!r}; choose of {', '.join(TITLES)}"
            )
        object.__setattr__(self, "tests", tuple(test for test in TITLES if test in asked))
        if self.seed < 0:
            raise InputError(f"seed: {self.seed} must not be below 0")


def realism(
    sensor: Sensor,
    renderer: Renderer,
    settings: RealismSettings,
    *,
    done: Mapping[str, dict] | None = None,
    on_result: Callable[[dict], None] | None = None,
    progress: bool = True,
) -> list[dict]:
    """Test a sensor.

    Args:
        sensor: The sensor.
        renderer: What photographs.
        settings: Which tests.
        done: Results that are there already, by id: they are returned as they are.
        on_result: Called with each result, as soon as it is there; also with those of ``done``.
        progress: Show a bar.

    Returns:
        A plain dictionary for each test, in the order of ``settings.tests``: ``id``, ``title``,
        ``passed`` (None where it does not apply, with ``why``), ``rows`` (``what``, ``measured``,
        ``expected``, ``unit``, ``passed``), ``data`` (curves) and ``seconds``.
    """
    stage, results = Stage(sensor, renderer), []
    for test in tqdm(settings.tests, desc=f"realism of {sensor.name}", disable=not progress):
        if done and test in done:
            one = done[test]
        else:
            start = time.perf_counter()
            one = CHECKS[test](stage, settings.seed, settings.quick)
            one["seconds"] = round(time.perf_counter() - start, 3)
        results.append(one)
        if on_result is not None:
            on_result(one)
    return results
