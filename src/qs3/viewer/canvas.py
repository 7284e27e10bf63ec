"""The part that both pages share: the cloud, its colours, the legend and the facts."""

import html
import logging
import threading
from typing import Any

import numpy as np

from qs3.errors import QS3Error
from qs3.io.clouds import CloudKind
from qs3.report.clouds import bar_length
from qs3.viewer.display import compose, frame_of, modes
from qs3.viewer.exhibits import KINDS, Answers, Exhibit

_LOG = logging.getLogger(__name__)
_CAMERA = (-0.9, -1.5, 0.7)
_GROUND = 2.0  # side, in lengths of the object
BLOCK = '<div style="padding:0.2em 0.9em;font-size:0.85em;line-height:1.45">{}</div>'
"""A text of a panel."""


class Canvas:
    """Draws one exhibit at a time on a viser server."""

    def __init__(self, server: Any, answers: Answers | None = None) -> None:
        self._server, self._answers = server, answers
        self._lock = threading.RLock()
        self._shown: tuple[Exhibit, int] | None = None
        server.initial_camera.position = _CAMERA
        server.initial_camera.look_at = (0.0, 0.0, 0.0)
        server.on_client_connect(_make_way)
        self._state = server.gui.add_html("")
        self._text = server.gui.add_html("")

    def add_controls(self, mesh: bool = False) -> None:
        """Add the controls of the look, and of a ``mesh`` if there is one, below those so far."""
        gui = self._server.gui
        with gui.add_folder("Look"):
            self._kind = gui.add_dropdown("Cloud", tuple(KINDS.values())[: 2 if mesh else 3])
            offered = modes(self._answers)
            first = "error" if mesh else ("predicted class" if self._answers else "view")
            self._mode = gui.add_dropdown("Colour by", offered, initial_value=first)
            self._limit = gui.add_number(
                "Error scale up to", 0.0, min=0.0, step=0.001, hint="0: as each cloud needs it"
            )
            self._size = gui.add_slider("Point size", 0.002, 0.04, 0.001, 0.015)
            self._mesh = gui.add_checkbox("Show the mesh", False, visible=mesh)
            self._legend = gui.add_html("")
        for handle in (self._kind, self._mode, self._limit, self._size, self._mesh):
            handle.on_update(lambda _: self.redraw())

    def show(self, exhibit: Exhibit, row: int = 0) -> None:
        """Show an exhibit from now on; ``row`` is its own among the network's answers."""
        with self._lock:
            self._shown = exhibit, row
            self.say("")
            self.redraw()

    def say(self, text: str) -> None:
        """State what is under way, such as a scan; empty takes it away."""
        self._state.content = BLOCK.format(f"<i>{html.escape(text)}</i>") if text else ""

    def fail(self, error: Exception) -> None:
        """State a fault; it stays until something is shown or said again."""
        if isinstance(error, QS3Error):
            text = str(error)
        else:
            text = f"{type(error).__name__}: {error}"
            _LOG.error("the viewer could not show something", exc_info=error)
        with self._lock:
            before = "<br>What is drawn is from before." if self._shown else ""
            self._state.content = BLOCK.format(
                f'<div style="color:#b00020" role="alert"><b>{html.escape(text)}</b>{before}</div>'
            )

    def redraw(self) -> None:
        """Draw the exhibit with the look that the controls ask for."""
        with self._lock:
            if self._shown is None:
                return
            try:
                self._draw(*self._shown)
            except Exception as error:
                self.fail(error)

    def _draw(self, exhibit: Exhibit, row: int) -> None:
        kind: CloudKind = next(key for key in KINDS if KINDS[key] == self._kind.value)
        limit = float(self._limit.value) or None
        shown = compose(exhibit, kind, self._mode.value, self._answers, row, limit)
        middle, side = frame_of(exhibit)
        drawn = (shown.points - middle) / side
        cell = bar_length(side)
        ground = f"ground: squares of {cell:g}{exhibit.unit}"
        with self._server.atomic():
            self._server.scene.add_point_cloud(
                "/cloud",
                drawn.astype(np.float32),
                shown.colouring.colours,
                point_size=float(self._size.value),
                point_shape="square",  # more of a disc is rim, which is blended with white
                point_shading="flat",
                precision="float32",
            )
            self._server.scene.add_grid(
                "/ground",
                width=_GROUND,
                height=_GROUND,
                cell_size=cell / side,
                section_size=_GROUND,
                shadow_opacity=0.0,
                position=(0.0, 0.0, float(drawn[:, 2].min())),
            )
            if exhibit.mesh is not None:
                self._server.scene.add_mesh_simple(
                    "/mesh",
                    ((exhibit.mesh.vertices - middle) / side).astype(np.float32),
                    np.asarray(exhibit.mesh.faces, dtype=np.uint32),
                    color=(200, 200, 200),
                    opacity=0.5,
                    side="double",
                    flat_shading=True,
                    visible=bool(self._mesh.value),
                )
            self._text.content = BLOCK.format(shown.text())
            self._legend.content = BLOCK.format(shown.colouring.legend() + f"<div>{ground}</div>")


def _make_way(client: Any) -> None:
    """On a phone, whose lower half the panel takes, show the object above it."""
    if client.camera.aspect < 1:
        client.camera.position = tuple(1.9 * value for value in _CAMERA)
        client.camera.look_at = (0.0, 0.0, -1.1)
