"""The two pages: objects to step through, and a mesh that is scanned live."""

import contextlib
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from qs3.errors import InputError
from qs3.sensor.presets import SENSORS, sensor_toml
from qs3.sensor.settings import ScanSettings
from qs3.viewer.canvas import Canvas
from qs3.viewer.exhibits import Answers, Exhibit, Exhibits
from qs3.viewer.rescan import Rescanner
from qs3.viewer.scan_controls import Control, make_controls, with_controls

ALL = "all classes"


@contextlib.contextmanager
def gallery_page(
    server: Any, exhibits: Exhibits, answers: Answers | None = None, class_name: str | None = None
) -> Iterator[Canvas]:
    """Put controls on a `viser.ViserServer` to step through objects, until the block ends.

    Answers are those of a network, row by row; objects of ``class_name`` are shown first.

    Raises:
        InputError: where there is no object of that class.
    """
    classes = sorted(set(filter(None, exhibits.labels)))
    if class_name is not None and class_name not in classes:
        raise InputError(
            f"--class-name {class_name}: no object of it; classes here: "
            f"{', '.join(classes) or 'not known'}"
        )

    labels = np.array(exhibits.labels, dtype=object)

    def rows() -> np.ndarray:
        """Rows of the objects to choose from."""
        chosen = (labels == which.value) | (which.value == ALL)
        if only.value and answers is not None:
            chosen &= answers.wrong
        return np.flatnonzero(chosen)

    def pick(row: int | None) -> tuple[Exhibit, int]:
        if row is None:
            raise InputError("no such object: none of this class is wrong")
        return exhibits[row], row

    gui, canvas = server.gui, Canvas(server, answers)
    with gui.add_folder("Object"):
        which = gui.add_dropdown(
            "Class", (ALL, *classes), initial_value=class_name or ALL, visible=bool(classes)
        )
        labelled = answers is not None and answers.truth is not None
        only = gui.add_checkbox("Wrong ones only", False, visible=labelled)
        first = max(len(rows()), 1)
        slider = gui.add_slider("Object", 1, first, 1, 1, disabled=first < 2)
        step = gui.add_button_group("Step", ("previous", "next"))
    canvas.add_controls()
    worker = Rescanner(pick, lambda picked: canvas.show(*picked), canvas.fail, delay=0.0)

    def ask(_: Any = None) -> None:
        found = rows()
        worker.ask(int(found[min(slider.value, len(found)) - 1]) if len(found) else None)

    def narrow(_: Any) -> None:
        most = max(len(rows()), 1)
        slider.max, slider.disabled = most, most < 2
        slider.value = 1
        ask()

    def move(_: Any) -> None:
        along = 1 if step.value == "next" else -1
        slider.value = min(max(slider.value + along, 1), slider.max)

    which.on_update(narrow)
    only.on_update(narrow)
    step.on_click(move)
    slider.on_update(ask)
    ask()
    with contextlib.closing(worker):
        yield canvas


@contextlib.contextmanager
def scan_page(
    server: Any,
    scan: Callable[[ScanSettings, int], Exhibit],
    start: ScanSettings,
    draws: int = 0,
) -> Iterator[Canvas]:
    """Put sliders for the sensor on a server, and scan whenever one moves, until the block ends.

    Args:
        server: A `viser.ViserServer`.
        scan: Scans the mesh with settings; takes the draw of a built-in shape too.
        start: Settings to start with, from `resolve`.
        draws: Number of draws of a built-in shape to step through, from that of the seed; 0 for a
            mesh file.
    """
    gui, canvas = server.gui, Canvas(server)
    canvas.add_controls(mesh=True)
    states = {"waiting": "scanning soon …", "working": "scanning …"}

    def work(asked: tuple[ScanSettings, dict[str, Any], int]) -> Exhibit:
        settings, values, draw = asked
        return scan(with_controls(settings, values), draw)

    worker = Rescanner(work, canvas.show, canvas.fail, tell=lambda state: canvas.say(states[state]))

    def ask(_: Any = None) -> None:
        worker.ask((sliders.base, sliders.values(), which.value))

    draw = start.seed if draws else 0
    with gui.add_folder("Mesh", visible=draws > 0):
        which = gui.add_slider("Draw of the shape", 0, max(draws - 1, draw, 1), 1, draw)
    sliders = _Sliders(gui, start, ask)
    which.on_update(ask)
    ask()
    with contextlib.closing(worker):
        yield canvas


class _Sliders:
    """The settings of the sensor; built anew where another sensor is chosen."""

    _KEPT = ("views", "view_layout", "seed", "num_points", "samples", "scene", "crop")

    def __init__(self, gui: Any, start: ScanSettings, ask: Callable[[Any], None]) -> None:
        self._gui, self._ask, self.base = gui, ask, start
        own = start.make_sensor()
        self._sensors = {own.name: own} | {n: s for n, s in SENSORS.items() if n != own.name}
        with gui.add_folder("Sensor") as self._place:
            self._sensor = gui.add_dropdown("Sensor", tuple(self._sensors))
            save = gui.add_button("Save these settings as TOML", hint="for --sensor")
        self._sensor.on_update(self._change)
        save.on_click(self._save)
        self._fill()

    def values(self) -> dict[str, Any]:
        return {name: handle.value for name, handle in self._handles.items()}

    def _change(self, event: Any) -> None:
        values = self.values()
        base = with_controls(self.base, {name: values[name] for name in self._KEPT})
        self.base = base.with_sensor(self._sensors[self._sensor.value], base.make_renderer())
        self._folder.remove()
        self._fill()
        self._ask(event)

    def _save(self, event: Any) -> None:
        if event.client is not None:
            sensor = with_controls(self.base, self.values()).make_sensor()
            event.client.send_file_download(f"{sensor.name}.toml", sensor_toml(sensor).encode())

    def _fill(self) -> None:
        with self._place, self._gui.add_folder("Settings") as self._folder:
            self._handles = {c.name: self._add(c) for c in make_controls(self.base)}
        for handle in self._handles.values():
            handle.on_update(self._ask)

    def _add(self, control: Control) -> Any:
        """A dropdown or a slider; the slider's ends make way for the value it begins with."""
        label, value, step = control.label, control.value, control.step
        if control.choices:
            return self._gui.add_dropdown(label, control.choices, initial_value=value)
        if isinstance(value, tuple):
            first, last = map(float, value)
            ends = min(float(control.low), first), max(float(control.high), last)
            return self._gui.add_multi_slider(label, *ends, step, (first, last))
        kind = type(step)
        ends = kind(min(control.low, value)), kind(max(control.high, value))
        return self._gui.add_slider(label, *ends, step, kind(value))
