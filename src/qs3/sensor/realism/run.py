"""The eleven laws by id, and their tests in order, with what was done before taken over."""

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from tqdm import tqdm

from qs3.errors import InputError
from qs3.sensor.presets import Sensor
from qs3.sensor.realism import clouds, edges, faces, surfaces, walls
from qs3.sensor.realism.bench import Bench
from qs3.sensor.realism.rows import Judged, plain
from qs3.sensor.render import Renderer

LAWS: dict[str, tuple[str, Callable[[Bench], Judged | str]]] = {
    "T1": ("RMS grows with the square of the distance", walls.noise),
    "T2": ("No bias of disparity or distance", walls.bias),
    "T3": ("Disparities come in the preset's steps", walls.steps),
    "T4": ("Left band and occlusion shadow as wide as geometry says", edges.bands),
    "T5": ("Edges reach no further than the matcher's law", edges.edges),
    "T6": ("Walls are filled; glancing ones less", surfaces.fill),
    "T7": ("No depth on a mirror or clear glass", surfaces.clear),
    "T8": ("Steps and noise of the Kinect as measured", walls.kinect),
    "T9": ("Image noise changes depth, equal seeds repeat it", walls.repeats),
    "T10": ("Distances from a scanned object follow the law", faces.scanned),
    "T11": ("No strays about an object in a room", clouds.strays),
}
"""Title, and test: figures beside their bounds and curves, or why the law does not apply."""


@dataclass(frozen=True)
class RealismSettings:
    """Which tests are done, and how thoroughly."""

    quick: bool = False
    """Fewer targets and smaller parts of the frame; the bounds stay."""
    seed: int = 0
    """All random steps follow from it."""
    tests: tuple[str, ...] = tuple(LAWS)
    """Tests to do, T1 to T11; others may be added to the same folder."""

    def __post_init__(self) -> None:
        asked = {test.upper(): test for test in self.tests}
        unknown = [test for name, test in asked.items() if name not in LAWS]
        if unknown or not asked:
            name = unknown[0] if unknown else ""
            raise InputError(f"tests: no test {name!r}; choose of {', '.join(LAWS)}")
        object.__setattr__(self, "tests", tuple(test for test in LAWS if test in asked))
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
    bench, results = Bench(sensor, renderer, settings.seed, settings.quick), []
    for name in tqdm(settings.tests, desc=f"realism of {sensor.name}", disable=not progress):
        result = (done or {}).get(name) or run_test(name, bench)
        results.append(result)
        if on_result is not None:
            on_result(result)
    return results


def run_test(name: str, bench: Bench) -> dict:
    """A test's result: it passes where every figure with bounds does; None where none has any."""
    start = time.perf_counter()
    title, test = LAWS[name]
    judged = test(bench)
    rows, data = ([], {}) if isinstance(judged, str) else judged
    verdicts = [row["passed"] for row in rows if row["passed"] is not None]
    result = {
        "id": name,
        "title": title,
        "passed": all(verdicts) if verdicts else None,
        "rows": rows,
        "data": {curve: plain(values) for curve, values in data.items()},
        "seconds": round(time.perf_counter() - start, 3),
    }
    return result | {"why": judged} if isinstance(judged, str) else result
