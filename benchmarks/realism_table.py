"""Tables of docs/realism.md: the tests by sensor from records of `qs3 realism`, walls by matcher.

    for sensor in d415 d435 d455 kinect-v1; do qs3 realism --sensor $sensor --out out/$sensor; done
    python benchmarks/realism_table.py out/d415 out/d435 out/d455 out/kinect-v1
    python benchmarks/realism_table.py --walls [--samples 4] [--seed 0]

The first form puts one row a test and one column a record between the page's first markers. The
second photographs one wall of albedo 0.6 with the d435 at four distances, each once, hands the same
images to all matchers, and fills the last markers: once with Gaussian noise of 1.5 grey levels
alone, and once with the preset's noise. Each form leaves the rest of the page as it is.
"""

import argparse
import dataclasses
import re
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from qs3.files import read_json, write_text
from qs3.sensor.depth import depth_from_disparity
from qs3.sensor.exposure import expose_pair
from qs3.sensor.lens import blur_reach
from qs3.sensor.matching import match, matching_canvas
from qs3.sensor.matching.settings import Method
from qs3.sensor.presets import get_sensor
from qs3.sensor.realism import LAWS
from qs3.sensor.realism.bench import VIEW, painted, wall, wall_region
from qs3.sensor.realism.metrics import plane_noise
from qs3.sensor.render.mitsuba import MitsubaRenderer
from qs3.sensor.view import photograph, scene_of

PAGE = Path(__file__).resolve().parent.parent / "docs" / "realism.md"
DISTANCES = (0.6, 1.0, 1.5, 2.0)
MATCHERS: tuple[tuple[Method, int], ...] = (
    ("opencv-bm", 15),
    ("opencv-bm", 21),
    ("zncc", 15),
    ("zncc", 21),
    ("ad-census", 19),
)
UNBOUNDED = ("autocorrelation", "locking")
Record = dict[str, Any]


def put(name: str, text: str) -> None:
    """Put ``text`` between the page's markers of that name."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    page = PAGE.read_text(encoding="utf-8")
    before, _, rest = page.partition(begin)
    _, found, after = rest.partition(end)
    if not found:
        raise SystemExit(f"{PAGE.name}: no markers {begin} … {end}")
    write_text(PAGE, f"{before}{begin}\n{text.strip()}\n{end}{after}")
    print(f"{PAGE.name}: wrote {name}")


def heading(record: Record) -> str:
    """Sensor, matcher and renderer of a column."""
    matching, renderer = record["sensor"]["matching"], record["renderer"]
    engine = renderer.get("variant") or renderer.get("engine") or renderer.get("name", "")
    words = [f"`{record['sensor']['name']}`", f"{matching['method']} {matching['block_size']}"]
    words += [f"{engine}, {renderer['samples']} rays".strip(", ")]
    if record["settings"]["quick"]:
        words.append("quick")
    return "<br>".join(words)


def family(what: str) -> str:
    """A figure's name without the place it was taken at: rows of one family share a line."""
    return re.sub(r" (at [\d.]+ (m|px)|\(.*\)|to [\d.]+ m)$", "", what)


def shown(result: Record) -> dict[str, list[Record]]:
    """A test's figures that have bounds, and some of those that have none, by family."""
    found: dict[str, list[Record]] = {}
    for one in result["rows"]:
        if one["passed"] is not None or one["what"].startswith(UNBOUNDED):
            found.setdefault(family(one["what"]), []).append(one)
    return found


def figures(rows: list[Record], bounds: bool) -> str:
    """Measured values of a family, misses in bold, with their bounds where asked."""
    words = []
    for one in rows:
        text = "–" if one["measured"] is None else f"{one['measured']:.4g}"
        text = text if one["passed"] is not False else f"**{text}**"
        words.append(f"{text} ({one['expected']})" if bounds and one["expected"] else text)
    return ", ".join(words) + (f" {rows[0]['unit']}" if rows[0]["unit"] else "")


def realism_table(records: list[Record]) -> str:
    """One row a test, one column a record."""
    lines = ["| test | " + " | ".join(map(heading, records)) + " |"]
    lines.append("|" + "---|" * (len(records) + 1))
    for test, (title, _) in LAWS.items():
        results = [next((t for t in r["tests"] if t["id"] == test), None) for r in records]
        seen = [shown(result) if result else {} for result in results]
        names = list(dict.fromkeys(name for one in seen for name in one))
        shared = {
            name: {row["expected"] for one in seen for row in one.get(name, [])} for name in names
        }
        first = [f"**{test}** {title}"]
        for name in names:
            (bound, *others) = shared[name]
            unit = next(one[name][0]["unit"] for one in seen if name in one)
            first.append(f"{name}{'' if others or not bound else f': {bound} {unit}'.rstrip()}")
        cells = ["<br>".join(first).replace("|", "\\|")]
        for result, one in zip(results, seen, strict=True):
            if result is None:
                cells.append("not tested")
            else:
                cell = ["pass" if result["passed"] else "**MISS**"]
                cell += [figures(one[n], len(shared[n]) > 1) if n in one else "–" for n in names]
                cells.append("<br>".join(cell))
        lines.append("| " + " | ".join(cells) + " |")
    seconds = (sum(t["seconds"] for t in record["tests"]) for record in records)
    lines.append("| seconds | " + " | ".join(f"{value:.0f}" for value in seconds) + " |")
    return "\n".join(lines)


def walls_table(samples: int, seed: int) -> str:
    """RMS, bias, fill and time of each matcher on the same images."""
    sensor = get_sensor("d435")
    rig = sensor.rig
    renderer = MitsubaRenderer(samples=samples)
    own = sensor.exposure
    noises = {
        "1.5 grey levels": dataclasses.replace(
            own, noise=1.5, offset=0.0, speckle=0.0, coherent=0.0
        ),
        f"the preset's: {own.noise:g} grey levels, speckle {own.coherent:g} of the dots": own,
    }
    settings = {
        (noise, method, block): dataclasses.replace(
            sensor.matching, method=method, block_size=block, quantum=0.0, bias_correction=False
        )
        for noise in noises
        for method, block in MATCHERS
    }
    seen: dict[tuple[str, str, int], list[tuple[float, ...]]] = {key: [] for key in settings}
    for index, z in enumerate(DISTANCES):
        region = wall_region(sensor, z)
        canvases = (matching_canvas(region, rig, matching) for matching in settings.values())
        canvas = max(canvases, key=lambda one: one.width * one.height)
        wide = canvas.grown(blur_reach(sensor.exposure.psf), rig.width, rig.height)
        scene = scene_of([painted(wall(z))], sensor)
        pair = photograph(renderer, scene, sensor, [VIEW], [seed + index], [wide])[0]
        images = {
            noise: expose_pair(
                pair, canvas, region, rig, exposure, np.random.default_rng(seed + index)
            )
            for noise, exposure in noises.items()
        }
        x, y = region.x - canvas.x, region.y - canvas.y
        inner = slice(y, y + region.height), slice(x, x + region.width)
        for key, matching in settings.items():
            left, right = images[key[0]]
            seconds = []
            for _ in range(3):
                start = time.perf_counter()
                disparity = match(left, right, matching)[inner]
                seconds.append(time.perf_counter() - start)
            error = disparity[np.isfinite(disparity)] - float(rig.disparity(z))
            good = error[np.abs(error) < 1]
            depth = depth_from_disparity(disparity, rig, sensor.depth)
            total = float(np.sqrt(np.mean(good**2)))
            fill = float(np.isfinite(disparity).mean())
            gross = 1 - len(good) / max(1, len(error))
            median = float(np.median(error))
            sub_pixel = plane_noise(depth, rig, region)[1]
            seen[key].append((total, sub_pixel, median, fill, gross, min(seconds)))
    head = [
        "noise", "matcher", "block", *(f"total RMS at {z} m" for z in DISTANCES), "greatest",
        "sub-pixel RMS", "median bias", "least fill", "gross errors", "seconds a pair",
    ]  # fmt: skip
    lines = ["| " + " | ".join(head) + " |", "|" + "---|" * len(head)]
    for (noise, method, block), rows in seen.items():
        total, plane, bias, fill, gross, seconds = np.array(rows).T
        cells = [
            noise,
            method,
            str(block),
            *(f"{value:.3f}" for value in total),
            f"{total.max():.3f}",
        ]
        cells += [
            f"{plane.min():.3f} … {plane.max():.3f}",
            f"{bias.min():+.3f} … {bias.max():+.3f}",
        ]
        cells += [f"{fill.min():.2%}", f"{gross.max():.2%}", f"{seconds.mean():.2f}"]
        lines.append("| " + " | ".join(cells) + " |")
    note = (
        f"`d435`, albedo 0.6, {renderer.variant}, {samples} rays a pixel, seed {seed}; the same "
        f"images for all; {cv2.getNumThreads()} threads. RMS and bias in pixels: total RMS of "
        "errors below 1 px about the true disparity, the rest are gross errors; sub-pixel RMS by "
        "librealsense's definition. No rounding after the matcher."
    )
    return note + "\n\n" + "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="*", type=Path, help="of qs3 realism, one a column")
    parser.add_argument("--walls", action="store_true", help="measure the walls anew")
    parser.add_argument("--samples", type=int, default=MitsubaRenderer.samples)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    if not (options.folders or options.walls):
        parser.error("name folders of qs3 realism, or --walls")
    if options.folders:
        put("tests", realism_table([read_json(f / "realism.json") for f in options.folders]))
    if options.walls:
        put("walls", walls_table(options.samples, options.seed))


if __name__ == "__main__":
    main()
