"""A contact sheet of meshes: shaded by ray casting, one scale per class, faults in red.

Convention:
    World: z up, in metres. The viewer stands far away at azimuth 30° and elevation 20°.
"""

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qs3.meshes.inspecting import PICTURED
from qs3.report.clouds import bar_length, caption
from qs3.report.figure import house_style, short, without_frame
from qs3.sensor.light.raycast import DepthCaster
from qs3.sensor.rig import Pose, StereoRig

if TYPE_CHECKING:
    import trimesh

    from qs3.meshes.inspecting import Inspection

_PIXELS, _FINE, _CAPTION = 160, 2, 0.3
_MARGIN = 1.12  # a long part does not reach the scale bar below it
_FAR = 20.0  # lengths of the object, so that the view is nearly parallel
_FROM = np.array([0.47, -0.81, 0.34])
_LIGHT = np.array([-0.4, -0.6, -0.7]) / np.linalg.norm([0.4, 0.6, 0.7])
_COLOUR, _RED, _DARK = np.array([0.56, 0.66, 0.79]), "#cc0000", "#333333"
_WRAPPED = 6


@dataclass(frozen=True)
class MeshTile:
    """One mesh of the sheet."""

    name: str
    class_name: str
    mesh: "trimesh.Trimesh | None"
    """None if it cannot be read."""
    extents: Float[np.ndarray, "3"] | None
    """Sides in metres; None if its unit is unknown."""
    is_faulty: bool = False
    """Draw it in red, and to a scale of its own."""


def tiles_of(groups: "Mapping[str, Sequence[Inspection]]", odd: Container[str]) -> list[MeshTile]:
    """Return the first eight meshes of each class, with the parts of their names that differ."""
    tiles = []
    for name, group in groups.items():
        shown = group[:PICTURED]
        parts = [look.item.id.split("/") for look in shown]
        while len({part[-1] for part in parts}) == 1 < len(parts) and all(p[1:] for p in parts):
            parts = [part[:-1] for part in parts]
        for look, part in zip(shown, parts, strict=True):
            is_faulty = bool(look.fault) or look.size is None or look.item.id in odd
            tiles.append(MeshTile(part[-1], name, look.mesh, look.extents, is_faulty))
    return tiles


@house_style
def contact_sheet(tiles: Sequence[MeshTile], title: str) -> Figure:
    """Draw meshes: a row per class, or a grid if each class has one mesh."""
    rows: dict[str, list[MeshTile]] = {}
    for tile in tiles:
        rows.setdefault(tile.class_name, []).append(tile)
    are_classes = all(len(row) == 1 for row in rows.values())
    columns = _WRAPPED if are_classes else max(4, *map(len, rows.values()))
    places = list(rows.values())
    if are_classes:
        flat = [tile for row in places for tile in row]
        places = [flat[i : i + columns] for i in range(0, len(flat), columns)]
    names = [] if are_classes else [short(name) for name in rows]
    left, top, pitch, cell = 0.2 + 0.09 * max(map(len, names), default=0), 0.35, 1 + _CAPTION, 1.5
    width, height = left + cell * columns, top + cell * pitch * len(places)
    figure = Figure(figsize=(width, height))
    axes = figure.add_axes((left / width, 0.0, 1 - left / width, 1 - top / height))
    axes.set(xlim=(0, columns), ylim=(pitch * len(places), 0), title=short(title, 40))
    spans = _spans(rows)
    for row, shown in enumerate(places):
        for column, tile in enumerate(shown):
            _draw(axes, column, row * pitch, tile, spans[tile.class_name], column == 0)
    without_frame(axes)
    axes.set_yticks([row * pitch + 0.5 for row in range(len(names))], names)
    axes.tick_params(axis="y", length=0)
    return figure


def _spans(rows: Mapping[str, Sequence[MeshTile]]) -> dict[str, float]:
    """Return the metres that a cell of each class shows: the largest diagonal of sound meshes."""
    return {
        name: max(
            [float(np.linalg.norm(tile.extents)) for tile in row
             if tile.extents is not None and not tile.is_faulty], default=0.0,
        )
        for name, row in rows.items()
    }  # fmt: skip


def _draw(axes: Axes, x: int, y: float, tile: MeshTile, span: float, is_first: bool) -> None:
    colour = _RED if tile.is_faulty else _DARK
    sides = "unit unknown"
    if tile.extents is not None:
        sides = " × ".join(
            f"{1000 * s:.0f}" if s >= 0.1 else f"{1000 * s:.3g}" for s in tile.extents
        )
        sides += " mm"
    if tile.mesh is None:
        axes.text(x + 0.5, y + 0.5, "cannot\nbe read", ha="center", va="center", color=_RED)
        sides = ""
    else:
        mesh = tile.mesh
        across = float(np.linalg.norm(mesh.extents))
        metres = None
        if tile.extents is not None:
            metres = float(tile.extents.max() / mesh.extents.max())
            if span and not tile.is_faulty:
                across = span / metres
        across *= _MARGIN
        picture = shaded(mesh, across, _RED if tile.is_faulty else None)
        axes.imshow(picture, extent=(x, x + 1, y + 1, y), interpolation="bilinear", aspect="equal")
        if metres is not None:
            bar = bar_length(across * metres * 1000)
            length = bar / (across * metres * 1000)
            axes.plot([x + 0.05, x + 0.05 + length], [y + 0.98] * 2, color=colour, linewidth=1.4)
            axes.text(x + 0.08 + length, y + 0.98, f"{bar:g} mm", va="center", fontsize=6)
        if is_first:
            axes.annotate(
                "z", (x + 0.06, y + 0.08), (x + 0.06, y + 0.36), color=_DARK, fontsize=7,
                ha="center", arrowprops={"arrowstyle": "->", "color": _DARK},
            )  # fmt: skip
    for line, text in enumerate((caption(tile.name), sides)):
        axes.text(x + 0.5, y + 1.07 + 0.12 * line, text, ha="center", va="center", fontsize=6.5,
                  color=colour)  # fmt: skip


def shaded(
    mesh: "trimesh.Trimesh", span: float, colour: str | None = None
) -> Float[np.ndarray, "h w 3"]:
    """Cast rays at a mesh, and shade it by its normals; a pixel is ``span / 160`` of its unit."""
    from matplotlib.colors import to_rgb

    size = _PIXELS * _FINE
    rig = StereoRig(width=size, height=size, focal=_FAR * size)
    middle = np.asarray(mesh.bounds).mean(axis=0)
    body = mesh.copy()
    body.vertices = (np.asarray(mesh.vertices) - middle) / span
    eye = _FAR * _FROM / np.linalg.norm(_FROM)
    cast = DepthCaster(body).cast(rig, Pose.looking_at(eye, np.zeros(3)), rig.full_frame, True)
    if cast.normals is None:
        raise AssertionError
    normals = np.nan_to_num(cast.normals)
    light = 0.35 + 0.65 * (normals @ _LIGHT).clip(0)
    edge = np.zeros(light.shape, dtype=bool)
    for axis in (0, 1):
        turned = (normals * np.roll(normals, 1, axis=axis)).sum(axis=-1) < 0.8
        edge |= turned & (cast.mask | np.roll(cast.mask, 1, axis=axis))
    base = _COLOUR if colour is None else 0.5 + 0.5 * np.array(to_rgb(colour))
    image = np.where(cast.mask[..., None], light[..., None] * base, 1.0)
    image[edge] *= 0.45
    blocks = image.reshape(_PIXELS, _FINE, _PIXELS, _FINE, 3)
    return blocks.mean(axis=(1, 3)).clip(0, 1)
