"""What stands before a camera: the objects of the last frame, and what each was answered by."""

import html
from typing import Any

import numpy as np

from qs3.adaptation.confidence import UNKNOWN
from qs3.report.figure import class_colour
from qs3.training.watch import SeenFrame

_GREY = "#8c8c8c"
_BLOCK = '<div style="padding:0.2em 0.9em;font-size:0.85em;line-height:1.45">{}</div>'


class Live:
    """Draws one frame at a time on a viser server."""

    def __init__(self, server: Any) -> None:
        """Set the camera, above the one that sees the table; nothing is drawn yet.

        Args:
            server: A `viser.ViserServer`.
        """
        self._server, self._drawn = server, []
        server.initial_camera.position = (0.0, -0.6, 0.9)
        server.initial_camera.look_at = (0.0, 0.7, 0.0)
        server.scene.add_grid("/ground", width=4.0, height=4.0, cell_size=0.1, section_size=1.0)
        self._text = server.gui.add_html("")

    def show(self, frame: SeenFrame, rate: str) -> None:
        """Draw the objects of a frame in place of those before, each in the colour of its class.

        Args:
            frame: What was seen.
            rate: Told below it, such as how many frames a second.
        """
        lines = []
        with self._server.atomic():
            for handle in self._drawn:
                handle.remove()
            self._drawn = []
            for number, one in enumerate(frame.objects):
                (name, share), (x, y, _) = one.best, one.item.centre
                names = sorted(one.probabilities)
                colour = _GREY if name == UNKNOWN else class_colour(names.index(name))
                told = f"{name} {share:.2f}"
                lines.append(f'<span style="color:{colour}">■</span> {html.escape(told)}')
                scene, points = self._server.scene, one.item.points
                rgb = np.array([int(colour[i : i + 2], 16) for i in (1, 3, 5)], np.uint8)
                self._drawn += [
                    scene.add_point_cloud(f"/object/{number}", points, rgb, point_size=0.002),
                    scene.add_label(f"/label/{number}", told, position=(x, y, one.item.size[2])),
                ]
        lines = lines or [html.escape(frame.fault)]
        head = f"<b>{html.escape(frame.name)}</b><br>"
        self._text.content = _BLOCK.format(head + "<br>".join([*lines, html.escape(rate)]))
