"""The parts before a camera in a browser on this machine, by viser (extra ``view``)."""

import contextlib
from collections.abc import Iterator
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float
from matplotlib.colors import to_rgb
from scipy.spatial.transform import Rotation

from qs3.clouds.preparation import thin
from qs3.geometry import invert_rigid, transform_points
from qs3.objects.cut import lift
from qs3.parts import FoundPart, FoundParts, Library
from qs3.parts.scenes.picture import rectified
from qs3.report.figure import class_colour
from qs3.report.view import as_html, height_colours, serving
from qs3.workflow.watch import SeenParts

_SHOWN, _POINT = 40_000, 0.0015
"""Points of a frame on the page, and the size of a point in metres."""


_LOOK, _AWAY = np.array([0.0, -0.81, 0.58]), 1.7
"""Direction from what is shown to the eye, and its distance in radii of that: the page shows 75°
from top to bottom."""


class _Drawn(NamedTuple):
    """A part on the page."""

    cad: str
    frame: Any
    label: Any


class LivePage:
    """The page: the cloud of a frame, each part in its pose with class and score, and the rate."""

    def __init__(self, server: Any, library: Library) -> None:
        self._server = server
        self._cads = {part.cad: part for part in library}
        names = library.class_names
        self._colours = {name: to_rgb(class_colour(k)) for k, name in enumerate(names)}
        self._seconds = 0.0
        self._middle: Float[np.ndarray, 3] | None = None
        self.drawn: list[_Drawn] = []
        server.initial_camera.position = _LOOK
        server.initial_camera.look_at = (0.0, 0.0, 0.0)
        self.text = server.gui.add_html("")

    def show(self, seen: SeenParts) -> None:
        """Show a frame, with the table at z = 0; after a fault the last parts stay."""
        if not seen.fault:  # a frame without depth takes no time
            self._seconds = (
                0.8 * self._seconds + 0.2 * seen.seconds if self._seconds else seen.seconds
            )
        with self._server.atomic():
            if seen.found is not None:
                # Scores are nearly equal: by them, parts would change places in each frame.
                parts = sorted(seen.found.parts, key=lambda p: (p.class_name, p.cad, p.pose[0, 3]))
                found = replace(seen.found, parts=tuple(parts))
                seen = seen._replace(found=found)
                self._draw(seen, found)
            self.text.content = self._words(seen)

    def _words(self, seen: SeenParts) -> str:
        rate = 1 / self._seconds if self._seconds else 0.0
        lines = [f"frame {seen.frame.name}, {rate:.1f} frames/s", seen.fault]
        if seen.found is not None:
            lines += [f"{part.class_name} {part.score:.2f}" for part in seen.found.parts]
            lines += [f"unexplained, {rest.points} points" for rest in seen.found.unexplained]
        return as_html(filter(None, lines))

    def _draw(self, seen: SeenParts, found: FoundParts) -> None:
        depth, camera = rectified(seen.frame.depth, seen.frame.camera)
        points = lift(depth, np.isfinite(depth) & (depth > 0), camera)
        table = found.camera_from_table
        to_page = np.diag([1.0, -1, -1, 1]) if table is None else invert_rigid(table)
        points = transform_points(to_page, points[thin(len(points), _SHOWN)])
        if self._middle is None:
            height = 0.0 if table is not None else float(np.median(points[:, 2]))
            self._middle = np.append(np.median(points[:, :2], axis=0), height)
            to_page[:3, 3] -= self._middle
            self._look(points - self._middle, to_page, found)
        else:
            to_page[:3, 3] -= self._middle
        cloud = (points - self._middle).astype(np.float32)
        self._server.scene.add_point_cloud(
            "/cloud", cloud, height_colours(cloud), point_size=_POINT, point_shading="flat"
        )
        for k, part in enumerate(found.parts):
            if k >= len(self.drawn) or self.drawn[k].cad != part.cad:
                self.drawn[k : k + 1] = [self._added(k, part)]
            pose, drawn = to_page @ part.pose, self.drawn[k]
            drawn.frame.position = pose[:3, 3]
            drawn.frame.wxyz = Rotation.from_matrix(pose[:3, :3]).as_quat()[[3, 0, 1, 2]]
            drawn.label.text = f"{part.class_name} {part.score:.2f}"
            cad = self._cads[part.cad]
            drawn.label.position = cad.middle + pose[2, :3] * cad.diameter / 2  # above it
        for drawn in self.drawn[len(found.parts) :]:
            drawn.frame.remove()
        del self.drawn[len(found.parts) :]

    def _look(
        self, points: Float[np.ndarray, "n 3"], to_page: Float[np.ndarray, "4 4"], found: FoundParts
    ) -> None:
        """Look at all parts of the first frame; if it has none, at the cloud."""
        cads = [self._cads[part.cad] for part in found.parts]
        shown = [transform_points(to_page @ part.pose, cad.middle[None])[0]
                 for part, cad in zip(found.parts, cads, strict=True)]  # fmt: skip
        margin = max((cad.diameter for cad in cads), default=0.0)
        shown = np.array(shown) if shown else points
        middle = (shown.min(axis=0) + shown.max(axis=0)) / 2
        away = _AWAY * (float(np.linalg.norm(shown - middle, axis=1).max()) + margin)
        clients = [client.camera for client in self._server.get_clients().values()]
        for camera in (self._server.initial_camera, *clients):
            camera.position, camera.look_at = middle + away * _LOOK, middle

    def _added(self, number: int, found: FoundPart) -> _Drawn:
        """Return a new part on the page, in place of that of its number."""
        part, scene, name = self._cads[found.cad], self._server.scene, f"/part-{number}"
        if number < len(self.drawn):
            self.drawn[number].frame.remove()
        frame = scene.add_frame(name, show_axes=False)
        colours = np.broadcast_to(self._colours[found.class_name], part.points.shape)
        scene.add_point_cloud(
            f"{name}/cad", part.points, colours, point_size=_POINT, point_shading="flat"
        )
        return _Drawn(found.cad, frame, scene.add_label(f"{name}/label", ""))


@contextlib.contextmanager
def serve_live(library: Library, port: int) -> Iterator[tuple[str, LivePage]]:
    """Serve the page of a camera as `qs3.report.view.serve` does; yield its address and it."""
    with serving(port, "qs3 watch") as (address, server):
        yield address, LivePage(server, library)
