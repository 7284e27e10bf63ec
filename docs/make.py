"""Make the parts of the documentation that code or records fill in: ``python docs/make.py PART``.

- ``models``: the table of sizes in docs/models.md.
- ``own-parts``: the tables in docs/own-parts.md, from results/parts and results/table-parts.
- ``parts``: the picture of that name, from the folder of ``make demo``.
- ``sensor``, ``pipeline``, ``quasi-balanced``, ``edges``, ``reliability``: the picture of that
  name, the last one from results/parts.
- ``results OUT NAME``: records and tables in results/NAME from those of a reproduction in OUT; with
  ``results/NAME NAME`` the tables again.
"""

import argparse
import dataclasses
import hashlib
import importlib.util
import json
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from jaxtyping import Bool, Float, UInt8
from matplotlib.axes import Axes
from matplotlib.figure import Figure

import qs3
from qs3.errors import InputError
from qs3.evaluation import wilson_interval
from qs3.report.clouds import draw_cloud
from qs3.report.figure import house_style, write_png
from qs3.sensor.light.materials import MATERIALS
from qs3.sensor.presets import SENSORS, Sensor, load_sensor, settings_dict
from qs3.sensor.view import ViewImages

if TYPE_CHECKING:
    from torch import nn

DOCS = Path(__file__).parent
ROOT = DOCS.parent
IMAGES = DOCS / "images"
Picture = UInt8[np.ndarray, "h w 3"]

# The table of networks

_START, _END = "<!-- sizes: docs/make.py models -->", "<!-- end of sizes -->"
PUBLISHED = {
    "pointnet": ("3.5", "440", "PointNet, Table 6"),
    "pointnet2": ("1.48", "1,684", "RS-CNN, complexity"),
    "rscnn": ("1.41", "295", "RS-CNN, complexity"),
    "simpleview": ("0.8", "–", "SimpleView, §4"),
}
"""Parameters in millions, multiply-adds in millions, and their source."""


def multiply_adds(model: "nn.Module") -> float:
    """Count the multiply-adds of one forward pass in evaluation, in millions.

    Those of matrix products and convolutions, at one cloud of 1,024 points.
    """
    import torch
    from torch.utils.flop_counter import FlopCounterMode

    points = torch.randn(1, 1024, 3, generator=torch.Generator().manual_seed(0)) * 0.4
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        model.eval()(points)
    return counter.get_total_flops() / 2e6


def reference(name: str) -> ModuleType | None:
    """Return the textbook form of a network in benchmarks/reference; None if ours is it."""
    stem = name.replace("-", "_")
    path = ROOT / "benchmarks" / "reference" / f"{stem}.py"
    if not path.is_file():
        return None
    spec = importlib.util.spec_from_file_location(f"reference_{stem}", path)
    assert spec is not None and spec.loader is not None  # noqa: S101
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def models() -> None:
    """Write parameters and multiply-adds of every network, ours and published."""
    import torch

    from qs3.models import create_model, list_models

    lines = [
        "| network | parameters, M | published | multiply-adds, M: ours | textbook | published "
        "| source |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in list_models():
        torch.manual_seed(0)
        model = create_model(name, 40)
        size = sum(p.numel() for p in model.parameters()) / 1e6
        ours, book = multiply_adds(model), reference(name)
        textbook = f"{multiply_adds(book.from_ours(model)):,.0f}" if book else "–"
        size_there, adds_there, source = PUBLISHED.get(name, ("–", "–", ""))
        lines.append(
            f"| `{name}` | {size:.2f} | {size_there} | {ours:,.0f} | {textbook} "
            f"| {adds_there} | {source} |"
        )
    page = DOCS / "models.md"
    before, rest = page.read_text(encoding="utf-8").split(_START)
    table, after = "\n".join(lines), rest.split(_END)[1]
    page.write_text(f"{before}{_START}\n{table}\n{_END}{after}", encoding="utf-8")


# The tables of parts

PARTS_TABLES = {
    "parts/parts.md": "own-parts.md",
    "parts/adapt.md": "own-parts.md",
    "parts/reliability.md": "own-parts.md",
    "table-parts/table.md": "own-parts.md",
    "table-parts/strange.md": "own-parts.md",
    "demo/demo.md": "start.md",
    "scenes/scenes.md": "live.md",
    "scenes/others.md": "live.md",
    "scenes/cad.md": "live.md",
    "scenes/times.md": "live.md",
    "scenes/stereo.md": "live.md",
}
"""The page that shows each table."""


def own_parts() -> None:
    """Show the tables of the benchmarks of parts as they were recorded."""
    for name, shown in PARTS_TABLES.items():
        page = DOCS / shown
        text = page.read_text(encoding="utf-8")
        start, end = f"<!-- table: results/{name} -->", f"<!-- end of results/{name} -->"
        before, rest = text.split(start)
        table = (ROOT / "results" / name).read_text(encoding="utf-8")
        text = f"{before}{start}\n\n{table}\n{end}{rest.split(end)[1]}"
        page.write_text(text, encoding="utf-8")


# The contact sheet of the sensor

_SCENES = ("alone", "floor", "wall", "room", "behind", "beside")
_CELL, _LINE = 190, 22
SENSOR_PICTURE = IMAGES / "sensor.png"


def presets() -> str:
    """Return a fingerprint of all presets; the picture holds that of its own."""
    plain = {name: settings_dict(sensor) for name, sensor in SENSORS.items()}
    return hashlib.sha256(json.dumps(plain, sort_keys=True).encode()).hexdigest()


def sensor() -> None:
    """Draw materials in a room and scenes as a D435 sees them, and all presets."""
    from PIL import Image
    from PIL.PngImagePlugin import PngInfo

    d435 = load_sensor("d435")
    rows = [
        # In a room: of a mirror or a pane that stands alone there is nothing to be seen.
        [
            cell(name, dataclasses.replace(d435, material=material), "room")
            for name, material in MATERIALS.items()
        ],
        [cell(name, d435, name) for name in _SCENES],
        [cell(name, preset) for name, preset in SENSORS.items()],
    ]
    width = max(len(row) for row in rows)
    blank = np.full_like(rows[0][0], 255)
    picture = np.vstack([np.hstack(row + [blank] * (width - len(row))) for row in rows])
    about = PngInfo()
    about.add_text("presets", presets())
    Image.fromarray(picture[..., ::-1]).save(SENSOR_PICTURE, pnginfo=about, optimize=True)


def cell(title: str, sensor: Sensor, scene: str = "alone") -> Picture:
    """Draw one scan of a chair: left image, depth and true depth, with its figures above."""
    from qs3.sensor.light.mitsuba import MitsubaRenderer

    neighbour = qs3.shapes.make("cabinet", seed=2) if scene in ("behind", "beside") else None
    # Shiny surfaces are path traced and need many rays; the others do not.
    renderer = MitsubaRenderer(samples=4 if sensor.material.rough else 64)
    try:
        made = qs3.scan(
            qs3.shapes.make("chair", seed=3),
            sensor=sensor,
            views=1,
            seed=4,
            scene=scene,
            neighbour=neighbour,
            crop="none",
            renderer=renderer,
            keep_images=True,
        )
    except InputError as error:
        if "saw no point" not in str(error):
            raise
        return _labelled(title, "no point seen", [np.full((_CELL, _CELL, 3), 40, np.uint8)] * 3)
    view, images = made.views[0], made.images[0]
    left = images.left if images.left.dtype == np.uint8 else (images.left >> 2).astype(np.uint8)
    known = images.true_depth[np.isfinite(images.true_depth)]
    limits = (float(known.min()), float(known.max()))
    pictures = [
        np.repeat(left[..., None], 3, axis=2),
        _coloured(images.depth, limits),
        _coloured(images.true_depth, limits),
    ]
    figures = f"fill {view.valid_fraction or 0:.0%}"
    if view.disparity_sigma is not None:
        figures += f", sigma {view.disparity_sigma:.3f} px"
    return _labelled(title, figures, pictures)


def _coloured(depth: Float[np.ndarray, "h w"], limits: tuple[float, float]) -> Picture:
    low, high = limits
    share = np.clip((depth - low) / max(high - low, 1e-9), 0, 1)
    levels = np.nan_to_num(255 * (1 - share)).astype(np.uint8)
    picture = cv2.applyColorMap(levels, cv2.COLORMAP_VIRIDIS)
    picture[~np.isfinite(depth)] = 40
    return picture


def _labelled(title: str, figures: str, pictures: list[np.ndarray]) -> Picture:
    head = np.full((2 * _LINE, _CELL, 3), 255, np.uint8)
    for line, text in enumerate((title, figures)):
        place = (4, _LINE * (line + 1) - 6)
        cv2.putText(head, text, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 1, cv2.LINE_AA)
    return np.vstack([head, *(_fitted(picture) for picture in pictures)])


def _fitted(picture: Picture) -> Picture:
    """Fit a picture into a square cell; its shape stays."""
    height, width = picture.shape[:2]
    scale = _CELL / max(height, width)
    size = (max(1, round(width * scale)), max(1, round(height * scale)))
    small = cv2.resize(picture, size, interpolation=cv2.INTER_AREA)
    square = np.full((_CELL, _CELL, 3), 255, np.uint8)
    top, left = (_CELL - small.shape[0]) // 2, (_CELL - small.shape[1]) // 2
    square[top : top + small.shape[0], left : left + small.shape[1]] = small
    return square


# Pictures of the first page, of QBST and of the matchers

_MARGIN = 12
"""Pixels of the depth image that are shown around the object."""
_GREY: dict[str, Any] = {"cmap": "gray"}


def _depths(view: ViewImages) -> dict[str, Any]:
    """Colours from the nearest to the farthest true depth."""
    near, far = np.nanmin(view.true_depth), np.nanmax(view.true_depth)
    return {"cmap": "viridis_r", "vmin": near, "vmax": far}


def _draw(
    axes: Iterable[Axes],
    panels: Sequence[tuple[str, np.ndarray, dict[str, Any]]],
    seen: Bool[np.ndarray, "h w"],
    aside: int = _MARGIN,
) -> None:
    """Draw titled pictures, each in its colours, around the seen pixels."""
    rows, columns = np.flatnonzero(seen.any(axis=1)), np.flatnonzero(seen.any(axis=0))
    for axis, (title, picture, colours) in zip(axes, panels, strict=True):
        share = picture.shape[0] / seen.shape[0]
        top, bottom = int((rows[0] - _MARGIN) * share), int((rows[-1] + _MARGIN) * share)
        first, last = int((columns[0] - aside) * share), int((columns[-1] + aside) * share)
        axis.imshow(picture[max(top, 0) : bottom, max(first, 0) : last], **colours)
        axis.set_title(title)
        axis.set_axis_off()


@house_style
def parts() -> None:
    """Draw the CAD over ten scans of the demo; run ``make demo`` before."""
    demo = ROOT / "demo"
    names = (
        "bolt_1 bracket_1 bushing_1 elbow_1 flange_1 flange_3 gear_1 housing_1 housing_4 lever_1"
    )
    scans = [demo / "scans" / name.partition("_")[0] / f"{name}.ply" for name in names.split()]
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "qs3", "predict", demo / "few", *scans]
        subprocess.run([*command, "--pictures", f"{folder}/poses"], check=True)
        shutil.copyfile(f"{folder}/poses/poses.png", IMAGES / "parts.png")


def pipeline() -> Figure:
    """One scan of a built-in chair: both images, disparity, depth, true depth, and the cloud."""
    made = qs3.scan(qs3.shapes.make("chair", seed=3), views=3, seed=4, keep_images=True)
    view = made.images[0]
    seen = np.isfinite(view.true_depth)
    depth = _depths(view)
    low, high = np.nanquantile(view.disparity[seen], (0.02, 0.98))
    nearness = {"cmap": "viridis", "vmin": low, "vmax": high}
    figure = Figure(figsize=(10, 6.9), layout="constrained", facecolor="white")
    axes = figure.subplots(2, 3)
    panels = [
        ("left camera", view.left, _GREY),
        ("right camera", view.right, _GREY),
        ("disparity", view.disparity, nearness),
        ("depth, as measured", view.depth, depth),
        ("depth, true", view.true_depth, depth),
    ]
    _draw(axes.flat[:5], panels, seen)
    axis = axes.flat[5]
    draw_cloud(axis, made.points, azimuth=-55.0, elevation=20.0)
    axis.set_title("cloud of three views")
    return figure


@house_style
def quasi_balanced() -> Figure:
    """The count that Algorithm 1 keeps of a class, among a thousand confident clouds."""
    from qs3.adaptation.selection import balanced_count

    total = 1000
    confident = np.arange(0, total + 1)
    kept = [balanced_count(int(n), total) if n else 0 for n in confident]
    figure = Figure(figsize=(6, 3.4), layout="constrained", facecolor="white")
    axis: Axes = figure.subplots()
    axis.plot(confident, confident, color="0.6", linestyle="--", label="SPST: all of them")
    axis.plot(confident, kept, color="C0", label="QBST: ⌈L_k (1 − L_k/L)⌉")
    axis.set_xlabel("clouds of the class over θ, L_k, of L = 1,000")
    axis.set_ylabel("kept")
    axis.set_xlim(0, total)
    axis.set_ylim(0, total)
    axis.legend(frameon=False)
    return figure


@house_style
def reliability() -> Figure:
    """How many answers are right against their confidence, with 95 % intervals (Wilson)."""
    rows = (ROOT / "results" / "parts" / "reliability.md").read_text("utf-8").splitlines()[2:]
    cells = [[cell.strip() for cell in row.strip("|").split("|")] for row in rows]
    figure = Figure(figsize=(4.2, 3.6), layout="constrained", facecolor="white")
    axis: Axes = figure.subplots()
    axis.plot((0, 1), (0, 1), color="0.6", linestyle="--")
    for first, name, mark in ((1, "real clouds", "o"), (4, "simulated clouds", "s")):
        found = [[int(row[first]), int(row[first + 1]) / 100, int(row[first + 2]) / 100]
                 for row in cells if row[first] != "0"]  # fmt: skip
        shares, right = [share for _, share, _ in found], [value for *_, value in found]
        ends = [wilson_interval(round(value * count), count) for count, _, value in found]
        off = np.abs(np.array(ends) - np.array(right)[:, None]).T
        axis.errorbar(shares, right, off, fmt=mark, capsize=3, label=name)
    axis.set_xlabel("confidence, mean of a group of answers")
    axis.set_ylabel("share that is right")
    axis.set_xlim(0, 1.02)
    axis.set_ylim(0, 1.02)
    axis.legend(frameon=False, loc="upper left")
    return figure


@house_style
def edges() -> Figure:
    """A chair as the D435 sees it at 1.6 and 3 m: image, true depth, both matchers' depth."""
    camera, chair = load_sensor("d435"), qs3.shapes.make("chair", seed=3)
    figure = Figure(figsize=(10, 6.1), layout="constrained", facecolor="white")
    for row, distance in zip(figure.subplots(2, 4), (1.6, 3.0), strict=True):
        placement = dataclasses.replace(camera.placement, radius=(distance, distance))
        placed = dataclasses.replace(camera, placement=placement)
        how = {"sensor": placed, "scene": "room", "object_size": 0.9, "views": 1, "seed": 4}
        block, census = (
            qs3.scan(chair, **how, matching=matcher, crop="none", keep_images=True).images[0]
            for matcher in ("zncc", "ad-census")
        )
        depth = _depths(census)
        panels = [
            (f"left camera, {distance} m", census.left, _GREY),
            ("depth, true", census.true_depth, depth),
            ("block matching (zncc)", block.depth, depth),
            ("ad-census", census.depth, depth),
        ]
        _draw(row, panels, census.mask, aside=3 * _MARGIN)
    return figure


# Results


def results(out: Path, name: str) -> None:
    """Copy records and tables of a reproduction into results/NAME, without its data and runs.

    Tables are written from the records, for the rows and columns that have any, except those whose
    cells all stand in another.
    """
    from qs3.evaluation.records import RECORDS
    from qs3.files import write_bytes, write_text
    from qs3.paper import GALLERIES, TABLES
    from qs3.paper.setup import MARKER, read_setup
    from qs3.paper.table import Table
    from qs3.paper.table_text import markdown

    folder = ROOT / "results" / name
    for file in (MARKER, RECORDS):
        write_bytes(folder / file, (out / file).read_bytes())
    pictures = out / GALLERIES
    if pictures.is_dir() and pictures.resolve() != (folder / GALLERIES).resolve():
        shutil.copytree(pictures, folder / GALLERIES, dirs_exist_ok=True)
    made = {name: Table(name, read_setup(folder)) for name in TABLES}
    cells = {name: {cell.name for cell in table.records} for name, table in made.items()}
    written: list[set[str]] = []
    for name in sorted(made, key=lambda name: len(cells[name]), reverse=True):
        if made[name].faults or any(cells[name] <= others for others in written):
            print(f"{name}: left out", *made[name].faults)
            (folder / f"{name}.md").unlink(missing_ok=True)
        else:
            write_text(folder / f"{name}.md", markdown(made[name].with_records()))
            written.append(cells[name])


FIGURES: dict[str, Callable[[], Figure]] = {
    "pipeline": pipeline,
    "quasi-balanced": quasi_balanced,
    "edges": edges,
    "reliability": reliability,
}
OTHERS: dict[str, Callable[[], None]] = {
    "models": models,
    "own-parts": own_parts,
    "parts": parts,
    "sensor": sensor,
}


def main() -> None:
    """Make the part that the command line asks for."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("part", choices=[*OTHERS, *FIGURES, "results"])
    parser.add_argument("results", nargs="*", metavar="OUT NAME", help="of results alone")
    given = parser.parse_args()
    if len(given.results) != (2 if given.part == "results" else 0):
        parser.error("results takes OUT and NAME, other parts take nothing")
    if given.part == "results":
        results(Path(given.results[0]), given.results[1])
    elif given.part in FIGURES:
        write_png(IMAGES / f"{given.part}.png", FIGURES[given.part](), dpi=110)
    else:
        OTHERS[given.part]()


if __name__ == "__main__":
    main()
