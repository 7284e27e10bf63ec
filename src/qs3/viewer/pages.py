"""The two pages: objects to step through, and a mesh that is scanned live."""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from qs3.errors import InputError
from qs3.sensor.presets import Sensor, sensor_toml
from qs3.viewer.colouring import rows_of
from qs3.viewer.exhibits import Answers, Exhibit, Exhibits
from qs3.viewer.rescan import Rescanner
from qs3.viewer.scan_controls import (
    SCENES,
    ScanControls,
    ScanRequest,
    material_names,
)
from qs3.viewer.stage import Stage

ALL = "all classes"


@dataclass(frozen=True)
class Choice:
    """Which object of a collection is to be shown."""

    class_name: str | None = None
    """Of this class only; None is of any."""
    wrong_only: bool = False
    """Only those that the network gets wrong."""
    place: int = 0
    """Place among those; one beyond the ends is the nearest end's."""


@contextlib.contextmanager
def gallery_page(
    server: Any, exhibits: Exhibits, answers: Answers | None = None, class_name: str | None = None
) -> Iterator[Stage]:
    """Put controls on a server to step through objects, until the block ends.

    Args:
        server: A `viser.ViserServer`.
        exhibits: The objects.
        answers: Of a network, row by row, where there is one.
        class_name: Show this class first; None shows all.

    Raises:
        InputError: where there is no object of that class.
    """
    classes = sorted(set(filter(None, exhibits.labels)))
    if class_name is not None and class_name not in classes:
        raise InputError(
            f"--class-name {class_name}: no object of it; classes here: "
            f"{', '.join(classes) or 'not known'}"
        )
    wrong = None if answers is None or answers.truth is None else answers.wrong

    def rows(choice: Choice) -> list[int]:
        return rows_of(exhibits.labels, choice.class_name, wrong if choice.wrong_only else None)

    def pick(choice: Choice) -> tuple[Exhibit, int]:
        there = rows(choice)
        if not there:
            raise InputError("no such object: none of this class is wrong")
        row = there[min(max(choice.place, 0), len(there) - 1)]
        return exhibits[row], row

    gui = server.gui
    stage = Stage(server, answers)
    count = max(len(rows(Choice(class_name))), 1)
    with gui.add_folder("Object"):
        which = gui.add_dropdown(
            "Class", (ALL, *classes), initial_value=class_name or ALL, visible=bool(classes)
        )
        only = gui.add_checkbox("Wrong ones only", False, visible=wrong is not None)
        slider = gui.add_slider("Object", 1, count, 1, 1, disabled=count < 2)
        step = gui.add_button_group("Step", ("previous", "next"))
    stage.add_controls()
    worker = Rescanner(pick, stage.outcome, delay=0.0)

    def choice() -> Choice:
        return Choice(None if which.value == ALL else which.value, only.value, slider.value - 1)

    def narrow(_: Any) -> None:
        most = max(len(rows(choice())), 1)
        slider.max, slider.disabled = most, most < 2
        slider.value = 1
        worker.ask(choice())

    def move(_: Any) -> None:
        along = 1 if step.value == "next" else -1
        slider.value = min(max(slider.value + along, 1), slider.max)

    which.on_update(narrow)
    only.on_update(narrow)
    step.on_click(move)
    slider.on_update(lambda _: worker.ask(choice()))
    worker.ask(choice())
    with contextlib.closing(worker):
        yield stage


@contextlib.contextmanager
def scan_page(
    server: Any,
    scan: Callable[[ScanRequest], Exhibit],
    sensors: Mapping[str, Sensor],
    start: ScanControls,
    draws: int = 0,
    draw: int = 0,
) -> Iterator[Stage]:
    """Put sliders for the sensor on a server, and scan whenever one moves, until the block ends.

    Args:
        server: A `viser.ViserServer`.
        scan: Scans the mesh.
        sensors: Those to choose from; the first is the one to start with.
        start: Settings to start with.
        draws: Number of draws of a built-in shape to step through; 0 for a mesh file.
        draw: The one to start with.
    """
    gui = server.gui
    stage = Stage(server)
    stage.add_controls(mesh=True)
    sliders = _Sliders(server, sensors, start)
    with gui.add_folder("Mesh", visible=draws > 0):
        which = gui.add_slider("Draw of the shape", 0, max(draws - 1, draw, 1), 1, draw)
    said = {"waiting": "scanning soon …", "working": "scanning …"}
    worker = Rescanner(
        lambda request: (scan(request), 0), stage.outcome, tell=lambda state: stage.say(said[state])
    )

    def ask() -> None:
        worker.ask(ScanRequest(sliders.base, sliders.controls(), which.value))

    sliders.build(ask)
    which.on_update(lambda _: ask())
    ask()
    with contextlib.closing(worker):
        yield stage


class _Sliders:
    """The settings of the sensor; built anew where another sensor is chosen."""

    def __init__(self, server: Any, sensors: Mapping[str, Sensor], start: ScanControls) -> None:
        self._server, self._sensors, self._start = server, sensors, start
        self.base = next(iter(sensors.values()))
        self._handles: dict[str, Any] = {}
        self._folder: Any = None
        self._ask: Callable[[], None] = lambda: None

    def build(self, ask: Callable[[], None]) -> None:
        gui, self._ask = self._server.gui, ask
        first = next(iter(self._sensors))
        with gui.add_folder("Sensor") as self._place:
            self._sensor = gui.add_dropdown("Sensor", tuple(self._sensors), initial_value=first)
            save = gui.add_button("Save these settings as TOML", hint="for --sensor")
        self._sensor.on_update(lambda _: self._change())
        save.on_click(self._save)
        self._fill(self._start)

    def controls(self) -> ScanControls:
        values = {name: handle.value for name, handle in self._handles.items()}
        return ScanControls(**values)

    def _change(self) -> None:
        now = self.controls()
        kept = ("views", "view_layout", "seed", "num_points", "samples", "scene", "crop")
        self.base = self._sensors[self._sensor.value]
        self._folder.remove()
        self._fill(ScanControls.of(self.base, **{name: getattr(now, name) for name in kept}))
        self._ask()

    def _save(self, event: Any) -> None:
        if event.client is not None:
            sensor = self.controls().sensor(self.base)
            text = sensor_toml(sensor).encode()
            event.client.send_file_download(f"{sensor.name}.toml", text)

    def _fill(self, now: ScanControls) -> None:
        gui, base = self._server.gui, self.base
        far, size = now.distance[1], base.object_size
        unit = " (m)" if base.metric else ""
        with self._place, gui.add_folder("Settings") as self._folder:
            self._handles = {
                "views": gui.add_slider("Views", 1, max(12, now.views), 1, now.views),
                "view_layout": gui.add_dropdown(
                    "Layout of views", ("orbit", "jitter"), initial_value=now.view_layout
                ),
                "distance": _range(gui, f"Distance{unit}", 0.05, 2 * far, 0.05, now.distance),
                "elevation": _range(gui, "Elevation (°)", -80.0, 80.0, 1.0, now.elevation),
                "object_size": _slider(
                    gui, f"Object's size{unit}", 0.05, 3 * size, 0.05, now.object_size
                ),
                "baseline": _slider(
                    gui, f"Baseline{unit}", 0.005, 4 * now.baseline, 0.005, now.baseline
                ),
                "projector": _slider(gui, "Projector ×", 0.0, 4.0, 0.05, now.projector),
                "room_light": _slider(gui, "Other light ×", 0.0, 20.0, 0.1, now.room_light),
                "gain": _slider(gui, "Gain ×", 0.1, 8.0, 0.1, now.gain),
                "image_noise": _slider(gui, "Image noise (grey)", 0.0, 20.0, 0.1, now.image_noise),
                "method": gui.add_dropdown(
                    "Matcher", ("opencv-bm", "zncc"), initial_value=now.method
                ),
                "block_size": gui.add_slider(
                    "Block (px)", 5, max(31, now.block_size), 2, now.block_size
                ),
                "num_disparities": gui.add_slider(
                    "Disparities",
                    min(16, now.num_disparities),
                    max(512, now.num_disparities),
                    1 if now.num_disparities % 16 else 16,
                    now.num_disparities,
                ),
                "stride": gui.add_slider("Pixel stride", 1, max(8, now.stride), 1, now.stride),
                "samples": gui.add_slider("Rays a pixel", 1, max(64, now.samples), 1, now.samples),
                "num_points": gui.add_slider(
                    "Points", min(64, now.num_points), max(8192, now.num_points), 1, now.num_points
                ),
                "material": gui.add_dropdown("Object's surface", material_names()),
                "scene": gui.add_dropdown("Scene", SCENES, initial_value=now.scene),
                "crop": gui.add_dropdown(
                    "Crop", ("box", "mask", "none"), initial_value=now.crop
                ),
                "seed": gui.add_slider("Seed", 0, max(50, now.seed), 1, now.seed),
            }  # fmt: skip
        for handle in self._handles.values():
            handle.on_update(lambda _: self._ask())


def _slider(gui: Any, name: str, low: float, high: float, step: float, value: float) -> Any:
    return gui.add_slider(name, float(min(low, value)), float(max(high, value)), step, float(value))


def _range(
    gui: Any, name: str, low: float, high: float, step: float, values: tuple[float, float]
) -> Any:
    first, last = map(float, values)
    return gui.add_multi_slider(name, min(low, first), max(high, last), step, (first, last))
