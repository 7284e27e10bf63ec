"""What stands before a camera: the objects of the last frame, and what each was answered by."""

import html
from typing import Any

from qs3.adaptation.confidence import UNKNOWN
from qs3.report.figure import class_colour
from qs3.training.watch import SeenFrame
from qs3.viewer.canvas import BLOCK
from qs3.viewer.colouring import rgb

_GREY = "#8c8c8c"


class Live:
    """Draws one frame at a time on a viser server."""

    def __init__(self, server: Any) -> None:
        self._server, self._drawn = server, []
        # Above the camera that sees the table.
        server.initial_camera.position = (0.0, -0.6, 0.9)
        server.initial_camera.look_at = (0.0, 0.7, 0.0)
        server.scene.add_grid("/ground", width=4.0, height=4.0, cell_size=0.1, section_size=1.0)
        self._text = server.gui.add_html("")

    def show(self, frame: SeenFrame, rate: str) -> None:
        """Draw the objects of a frame in place of those before, each in the colour of its class.

        The rate, such as how many frames a second, is told below it.
        """
        lines = []
        with self._server.atomic():
            for handle in self._drawn:
                handle.remove()
            self._drawn = []
            for number, (item, answer) in enumerate(frame.objects):
                ((name, share),), (x, y, _) = answer.best(), item.centre
                names = sorted(answer.probabilities)
                colour = _GREY if name == UNKNOWN else class_colour(names.index(name))
                text = f"{name} {share:.2f}"
                lines.append(f'<span style="color:{colour}">■</span> {html.escape(text)}')
                scene, drawn = self._server.scene, (item.points, rgb(colour))
                self._drawn += [
                    scene.add_point_cloud(f"/object/{number}", *drawn, point_size=0.002),
                    scene.add_label(f"/label/{number}", text, position=(x, y, item.size[2])),
                ]
        lines = lines or [html.escape(frame.fault)]
        head = f"<b>{html.escape(frame.name)}</b><br>"
        self._text.content = BLOCK.format(head + "<br>".join([*lines, html.escape(rate)]))
