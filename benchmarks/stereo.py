"""Parts that stand apart on a table, seen by the simulated stereo cameras of qs3, found by CAD.

Run: python benchmarks/stereo.py --out out/stereo [--cad DIR] [--results results/scenes]
         [--frames 12]

Unlike the pictures of `scenes.py`, these are smoothed by a block matcher. Five parts lie on a plain
table: of the six of `scenes.py`, and with --cad of a folder of STL in millimetres without its
container, which hides others. Frames that are in --out are not made again.
"""

import json
import os
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # before anything counts the cores

import numpy as np
import trimesh
from common import arguments, keep
from scenes import CHOSEN, judge, keep_cad, lying, measures, moved, posed, solids, write
from table_parts import at, box

from qs3.frames.images import read_depth
from qs3.frames.intrinsics import Intrinsics
from qs3.parts import Library, find
from qs3.sensor.light import Body
from qs3.sensor.light.materials import Material
from qs3.sensor.light.mitsuba import MitsubaRenderer
from qs3.sensor.light.raycast import DepthCaster
from qs3.sensor.presets import load_sensor
from qs3.sensor.rig import Pose
from qs3.sensor.view import Clock, photograph, take_views

ROWS = (("d415", 0.5, 0.7), ("d435", 0.5, 0.7), ("d435", 0.25, 0.45))
"""Cameras, and metres from them to the middle of the parts."""
PARTS, SCALE, SEED = 5, 1e-4, 7
"""Parts per frame, metres per step of its depth, and seed of all frames."""
ALBEDO, TABLE = 0.6, 0.5
"""Albedos of parts and table."""


def make(
    out: Path, meshes: dict[str, trimesh.Trimesh], row: tuple[str, float, float], number: int
) -> None:
    """Write one depth picture and its truth: names and poses camera from part."""
    rng, sensor = np.random.default_rng([SEED, number]), load_sensor(row[0])
    names, spots = sorted(meshes), [(x, y) for x in (-0.13, 0, 0.13) for y in (-0.075, 0.075)]
    placed = []
    for k in rng.permutation(len(spots))[:PARTS]:
        name = names[rng.integers(len(names))]
        placed.append((name, moved(lying(meshes[name], rng), *spots[k], 0)))
    whole = trimesh.util.concatenate([posed(meshes[name], pose) for name, pose in placed])
    table = at(box((1.6, 1.6, 0.02)), z=-0.01)
    turn, down = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(45, 75))
    flat = np.cos(down)
    ahead = np.array([np.cos(turn) * flat, np.sin(turn) * flat, -np.sin(down)])
    eye = whole.bounds.mean(axis=0) - rng.uniform(*row[1:]) * ahead
    pose = Pose.looking_at(eye, eye + ahead)
    bodies = [Body(whole, Material(albedo=ALBEDO)), Body(table, Material(albedo=TABLE))]
    frame = [sensor.rig.full_frame]
    pairs = photograph(MitsubaRenderer(), bodies, sensor, [pose], [number], frame)
    noise = np.random.default_rng(number)
    (view,) = take_views(
        pairs, sensor, frame, frame, DepthCaster(whole, table), None, noise, Clock()
    )
    steps = np.where(np.isfinite(view.depth), np.rint(view.depth / SCALE), 0).astype(np.uint16)
    seen = np.linalg.inv(pose.camera_to_world)
    truth = [
        {"class": name, "pose": (seen @ stand).tolist(), "share": 1.0} for name, stand in placed
    ]
    write(out, number, steps, truth)


def score(
    out: Path, meshes: dict[str, trimesh.Trimesh], row: tuple[str, float, float], frames: int
) -> str:
    """Return a line of the table."""
    rig = load_sensor(row[0]).rig
    camera = Intrinsics(rig.focal, rig.focal, *rig.principal_point, rig.width, rig.height)
    keep_cad(out / "cad", meshes)
    library = Library.of_folder(out / "cad", "mm")
    points, sizes = measures(meshes)
    sought, right, answers = 0, 0, 0
    for number in range(frames):
        if not (out / f"{number:06d}.json").is_file():
            make(out, meshes, row, number)
        truth = json.loads((out / f"{number:06d}.json").read_text())
        depth = read_depth(out / "depth" / f"{number:06d}.png", SCALE)
        parts = find(library, depth, camera).parts
        flags = judge(truth, list(parts), points, sizes)[2]
        sought, right, answers = sought + len(truth), right + sum(flags), answers + len(flags)
        print(row, number, len(truth), sum(flags), len(flags), flush=True)
    return (
        f"| {row[0].upper()} | {len(meshes)} | {row[1]:g} to {row[2]:g} m | {sought} | {right} "
        f"| {answers - right} |"
    )


def main() -> None:
    parser = arguments(__doc__, "out")
    parser.add_argument("--cad", type=Path, help="a folder of STL in millimetres, a file a class")
    parser.add_argument("--frames", type=int, default=12)
    options = parser.parse_args()
    sets = {"six": solids(CHOSEN, None)}
    if options.cad:
        sets["cad"] = solids({}, options.cad)
        sets["cad"].pop("container", None)
    lines = ["| camera | CAD files | distance | parts | right | wrong |", "|---" * 6 + "|"]
    for row in ROWS:
        for name, meshes in sets.items():
            folder = options.out / f"{row[0]}-{row[1]:g}-{name}"
            lines.append(score(folder, meshes, row, options.frames))
    keep(options, "stereo", lines)


if __name__ == "__main__":
    main()
