"""Six laws of real depth cameras, measured on a simulated one; and its matcher on a real pair."""

import time
from collections.abc import Callable
from dataclasses import dataclass

from tqdm import tqdm

from qs3.errors import InputError
from qs3.sensor.presets import Sensor
from qs3.sensor.realism import edges, faces, walls
from qs3.sensor.realism.bench import Bench
from qs3.sensor.realism.metrics import Row
from qs3.sensor.render import Renderer

LAWS: dict[str, tuple[str, Callable[[Bench], list[Row]]]] = {
    "T1": ("RMS grows with the square of the distance", walls.noise),
    "T2": ("No bias of disparity or distance", walls.bias),
    "T4": ("Left band and occlusion shadow as wide as geometry says", edges.bands),
    "T5": ("Edges reach no further than the matcher's law", edges.edges),
    "T10": ("Distances from a scanned object follow the law", faces.scanned),
    "T11": ("No strays about an object in a room", faces.strays),
}
"""Title, and test. The laws between them are tests of this package: tests/sensor/test_laws.py."""


@dataclass(frozen=True)
class RealismSettings:
    """Choice of the tests, and their size."""

    quick: bool = False
    """Fewer targets and smaller parts of the frame; the bounds stay."""
    seed: int = 0
    """All random steps follow from it."""
    tests: tuple[str, ...] = tuple(LAWS)
    """Tests to do, of T1, T2, T4, T5, T10 and T11."""

    def __post_init__(self) -> None:
        asked = {test.upper(): test for test in self.tests}
        unknown = [test for name, test in asked.items() if name not in LAWS]
        if unknown or not asked:
            name = unknown[0] if unknown else ""
            raise InputError(f"tests: unknown test {name!r}; choose of {', '.join(LAWS)}")
        object.__setattr__(self, "tests", tuple(test for test in LAWS if test in asked))
        if self.seed < 0:
            raise InputError(f"seed: {self.seed} must not be below 0")


def realism(
    sensor: Sensor, renderer: Renderer, settings: RealismSettings, progress: bool = True
) -> list[dict]:
    """Test a sensor; ``progress`` shows a bar.

    Returns:
        A dictionary for each test, in order: ``id``, ``title``, ``passed`` (every figure with
        bounds), ``rows`` (``what``, ``measured``, ``expected``, ``unit``, ``passed``), ``seconds``.
    """
    bench, results = Bench(sensor, renderer, settings.seed, settings.quick), []
    for name in tqdm(settings.tests, desc=f"realism of {sensor.name}", disable=not progress):
        start = time.perf_counter()
        title, test = LAWS[name]
        rows = test(bench)
        passed = all(row["passed"] is not False for row in rows)
        seconds = round(time.perf_counter() - start, 3)
        result = {"id": name, "title": title, "passed": passed, "rows": rows, "seconds": seconds}
        results.append(result)
    return results
