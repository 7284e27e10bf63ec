"""The two pages: objects to step through, and a mesh that is scanned live."""

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from qs3.errors import InputError
from qs3.sensor.presets import Sensor, sensor_toml
from qs3.viewer.canvas import Canvas
from qs3.viewer.exhibits import Answers, Exhibit, Exhibits
from qs3.viewer.rescan import Rescanner
from qs3.viewer.scan_controls import SCENES, ScanControls, ScanRequest, material_names

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

    def rows(self, exhibits: Exhibits, answers: Answers | None) -> list[int]:
        """Rows of the objects to choose from."""
        return [
            row
            for row, label in enumerate(exhibits.labels)
            if self.class_name in (None, label)
            and not (self.wrong_only and answers is not None and not answers.wrong[row])
        ]


@contextlib.contextmanager
def gallery_page(
    server: Any, exhibits: Exhibits, answers: Answers | None = None, class_name: str | None = None
) -> Iterator[Canvas]:
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

    def count(choice: Choice) -> int:
        return max(len(choice.rows(exhibits, answers)), 1)

    def pick(choice: Choice) -> tuple[Exhibit, int]:
        rows = choice.rows(exhibits, answers)
        if not rows:
            raise InputError("no such object: none of this class is wrong")
        row = rows[min(max(choice.place, 0), len(rows) - 1)]
        return exhibits[row], row

    gui, canvas = server.gui, Canvas(server, answers)
    first = count(Choice(class_name))
    with gui.add_folder("Object"):
        which = gui.add_dropdown(
            "Class", (ALL, *classes), initial_value=class_name or ALL, visible=bool(classes)
        )
        labelled = answers is not None and answers.truth is not None
        only = gui.add_checkbox("Wrong ones only", False, visible=labelled)
        slider = gui.add_slider("Object", 1, first, 1, 1, disabled=first < 2)
        step = gui.add_button_group("Step", ("previous", "next"))
    canvas.add_controls()
    worker = Rescanner(pick, lambda picked: canvas.show(*picked), canvas.fail, delay=0.0)

    def choice() -> Choice:
        return Choice(None if which.value == ALL else which.value, only.value, slider.value - 1)

    def narrow(_: Any) -> None:
        most = count(choice())
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
        yield canvas


@contextlib.contextmanager
def scan_page(
    server: Any,
    scan: Callable[[ScanRequest], Exhibit],
    sensors: Mapping[str, Sensor],
    start: ScanControls,
    draws: int = 0,
    draw: int = 0,
) -> Iterator[Canvas]:
    """Put sliders for the sensor on a server, and scan whenever one moves, until the block ends.

    Args:
        server: A `viser.ViserServer`.
        scan: Scans the mesh.
        sensors: Those to choose from; the first is the one to start with.
        start: Settings to start with.
        draws: Number of draws of a built-in shape to step through; 0 for a mesh file.
        draw: The one to start with.
    """
    gui, canvas = server.gui, Canvas(server)
    canvas.add_controls(mesh=True)
    states = {"waiting": "scanning soon …", "working": "scanning …"}
    worker = Rescanner(scan, canvas.show, canvas.fail, tell=lambda state: canvas.say(states[state]))

    def ask(_: Any = None) -> None:
        worker.ask(ScanRequest(sliders.base, sliders.controls(), which.value))

    with gui.add_folder("Mesh", visible=draws > 0):
        which = gui.add_slider("Draw of the shape", 0, max(draws - 1, draw, 1), 1, draw)
    sliders = _Sliders(gui, sensors, start, ask)
    which.on_update(ask)
    ask()
    with contextlib.closing(worker):
        yield canvas


class _Sliders:
    """The settings of the sensor; built anew where another sensor is chosen."""

    def __init__(
        self,
        gui: Any,
        sensors: Mapping[str, Sensor],
        start: ScanControls,
        ask: Callable[[Any], None],
    ) -> None:
        self._gui, self._sensors, self._ask = gui, sensors, ask
        self.base = next(iter(sensors.values()))
        with gui.add_folder("Sensor") as self._place:
            self._sensor = gui.add_dropdown("Sensor", tuple(sensors))
            save = gui.add_button("Save these settings as TOML", hint="for --sensor")
        self._sensor.on_update(self._change)
        save.on_click(self._save)
        self._fill(start)

    def controls(self) -> ScanControls:
        return ScanControls(**{name: handle.value for name, handle in self._handles.items()})

    def _change(self, event: Any) -> None:
        now = self.controls()
        kept = ("views", "view_layout", "seed", "num_points", "samples", "scene", "crop")
        self.base = self._sensors[self._sensor.value]
        self._folder.remove()
        self._fill(ScanControls.of(self.base, **{name: getattr(now, name) for name in kept}))
        self._ask(event)

    def _save(self, event: Any) -> None:
        if event.client is not None:
            sensor = self.controls().sensor(self.base)
            event.client.send_file_download(f"{sensor.name}.toml", sensor_toml(sensor).encode())

    def _fill(self, now: ScanControls) -> None:
        unit, size = " (m)" if self.base.metric else "", self.base.object_size
        whole = 1 if now.num_disparities % 16 else 16
        # Field, label, and either the choices or lowest value, highest value and step.
        rows: tuple[tuple[Any, ...], ...] = (
            ("views", "Views", 1, 12, 1),
            ("view_layout", "Layout of views", ("orbit", "jitter")),
            ("distance", f"Distance{unit}", 0.05, 2 * now.distance[1], 0.05),
            ("elevation", "Elevation (°)", -80.0, 80.0, 1.0),
            ("object_size", f"Object's size{unit}", 0.05, 3 * size, 0.05),
            ("baseline", f"Baseline{unit}", 0.005, 4 * now.baseline, 0.005),
            ("projector", "Projector ×", 0.0, 4.0, 0.05),
            ("room_light", "Other light ×", 0.0, 20.0, 0.1),
            ("gain", "Gain ×", 0.1, 8.0, 0.1),
            ("image_noise", "Image noise (grey)", 0.0, 20.0, 0.1),
            ("method", "Matcher", ("opencv-bm", "zncc")),
            ("block_size", "Block (px)", 5, 31, 2),
            ("num_disparities", "Disparities", 16, 512, whole),
            ("stride", "Pixel stride", 1, 8, 1),
            ("samples", "Rays a pixel", 1, 64, 1),
            ("num_points", "Points", 64, 8192, 1),
            ("material", "Object's surface", material_names()),
            ("scene", "Scene", SCENES),
            ("crop", "Crop", ("box", "mask", "both", "none")),
            ("seed", "Seed", 0, 50, 1),
        )
        with self._place, self._gui.add_folder("Settings") as self._folder:
            self._handles = {
                name: self._control(getattr(now, name), label, *bounds)
                for name, label, *bounds in rows
            }
        for handle in self._handles.values():
            handle.on_update(self._ask)

    def _control(self, value: Any, label: str, *bounds: Any) -> Any:
        """A dropdown or a slider; a slider's bounds make way for the value it begins with."""
        if isinstance(bounds[0], tuple):
            return self._gui.add_dropdown(label, bounds[0], initial_value=value)
        low, high, step = bounds
        if isinstance(value, tuple):
            first, last = map(float, value)
            return self._gui.add_multi_slider(
                label, min(low, first), max(high, last), step, (first, last)
            )
        kind = type(step)
        ends = kind(min(low, value)), kind(max(high, value))
        return self._gui.add_slider(label, *ends, step, kind(value))
