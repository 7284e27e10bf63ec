"""The story of docs/own-parts.md, run: twelve own parts, six objects on a table, commands timed.

The parts are doll's furniture of four own classes, made from built-in shapes and written as STL in
millimetres. On the table stand five of them and a cup, which is no part; the simulated camera
photographs it from eight places as depth images, as a real one would. Nothing but the labels that
``truth`` hands out for the score knows what stands where.

    python benchmarks/own_parts.py --out out/own-parts            runs all of the page's commands
    python benchmarks/own_parts.py --out out/own-parts --only make
"""

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pandas as pd
import trimesh

from qs3 import shapes
from qs3.geometry import invert_rigid, rotation_z
from qs3.io.extract.cut import upright
from qs3.io.extract.plane import Plane
from qs3.io.extract.segment import _level
from qs3.sensor.presets import load_sensor
from qs3.sensor.scan import scan

PAGE = Path(__file__).parent.parent / "docs" / "own-parts.md"
CAMERA = '# A D435 that looks down on a table.\nbase = "d435"\nplacement.radius = [0.6, 0.9]\n' \
    'placement.elevation = [45.0, 65.0]\n'  # fmt: skip
CLASSES = {"stool": ("chair", "stool"), "armchair": ("chair", "armchair"),
           "lamp": ("lamp", "table"), "palm": ("plant", "palm")}  # fmt: skip
STANDING = (("stool", 0, -0.26, -0.13), ("armchair", 0, 0.02, -0.16), ("lamp", 1, 0.27, -0.11),
            ("palm", 2, -0.24, 0.15), ("armchair", 2, 0.26, 0.16), ("cup", 0, 0.02, 0.14),
            )  # fmt: skip
"""Class, draw and place on the table in metres."""
VIEWS, MM = 8, 1000.0


def part(name: str, draw: int) -> trimesh.Trimesh:
    """A part in millimetres, its longest side 150 to 200; the cup is none of the classes."""
    if name == "cup":
        wall = trimesh.creation.annulus(34, 38, 95)
        bottom = trimesh.creation.cylinder(36, 4, transform=_moved(0, 0, -45.5))
        handle = trimesh.creation.torus(24, 5, transform=_moved(58, 0, 0) @ _turned())
        mesh = trimesh.util.concatenate([wall, bottom, handle])
        mesh.apply_translation([0, 0, -mesh.bounds[0, 2]])
        return mesh
    shape, family = CLASSES[name]
    mesh = shapes.make(shape, seed=draw, family=family)
    mesh.apply_scale((150 + 25 * draw) / mesh.extents.max())
    mesh.metadata.pop("units")
    return mesh


def make(folder: Path) -> None:
    """Write ``my_parts``, ``my_camera.toml``, ``frames``, ``camera.json`` and the hidden truth."""
    for name in CLASSES:
        (folder / "my_parts" / name).mkdir(parents=True, exist_ok=True)
        for draw in range(3):
            part(name, draw).export(folder / "my_parts" / name / f"{name}-{draw}.stl")
    (folder / "my_camera.toml").write_text(CAMERA)
    standing = [part(name, draw).apply_translation([MM * x, MM * y, 0])
                for name, draw, x, y in STANDING]  # fmt: skip
    table = trimesh.util.concatenate(standing)
    sensor = load_sensor(folder / "my_camera.toml")
    made = scan(table, sensor=sensor, object_size="file", units="mm", views=VIEWS, crop="none",
                scene="floor", seed=1, full_frames=True)  # fmt: skip
    # The scan stands about the middle of its box, and is turned.
    centres = np.array([mesh.bounds.mean(axis=0) for mesh in standing]) / MM
    centres += made.mesh.bounds.mean(axis=0) - table.bounds.mean(axis=0) / MM
    centres = centres @ rotation_z(made.yaw).T
    (folder / "frames").mkdir(exist_ok=True)
    truth = {}
    for number, (images, pose) in enumerate(zip(made.images, made.poses, strict=True)):
        depth = np.nan_to_num(images.depth * 10_000).round().clip(0, 65535).astype(np.uint16)
        cv2.imwrite(str(folder / "frames" / f"{number:03d}.png"), depth)
        to_camera = invert_rigid(pose.camera_to_world)
        seen = (centres @ to_camera[:3, :3].T + to_camera[:3, 3]) @ upright().T
        level = _level(Plane(upright() @ to_camera[:3, 2], 0.0))
        places = (seen @ level.T)[:, :2]
        truth[f"{number:06d}"] = [
            [name, *place.tolist()] for (name, *_), place in zip(STANDING, places, strict=True)
        ]
    rig = sensor.rig
    matrix = [rig.focal, 0, (rig.width - 1) / 2, 0, rig.focal, (rig.height - 1) / 2, 0, 0, 1]
    (folder / "camera.json").write_text(json.dumps({"cam_K": matrix, "depth_scale": 0.1}))
    (folder / "truth.json").write_text(json.dumps(truth))


def label(folder: Path) -> pd.DataFrame:
    """Copy each object that was cut out into ``labelled/<class>``, as a person would who looks."""
    truth, rows = json.loads((folder / "truth.json").read_text()), []
    for frame, standing in truth.items():
        for row in pd.read_csv(folder / "objects" / frame / "objects.csv").to_dict("records"):
            off = [float(np.hypot(row["x"] - x, row["y"] - y)) for _, x, y in standing]
            index = int(np.argmin(off))
            name = standing[index][0] if min(off) < 0.08 else "nothing"
            rows.append({"frame": frame, "object": index, "class": name, "points": row["points"],
                         "off": min(off), "file": f"objects/{frame}/{row['file']}"})  # fmt: skip
            if name in CLASSES:
                place = folder / "labelled" / name
                place.mkdir(parents=True, exist_ok=True)
                shutil.copy(folder / rows[-1]["file"], place / f"{frame}-{row['file']}")
    return pd.DataFrame(rows)


def commands() -> list[str]:
    """The page's commands, block by block."""
    return re.findall(r"^```sh\n(.*?)^```$", PAGE.read_text("utf-8"), re.DOTALL | re.MULTILINE)


def run(folder: Path) -> None:
    """Run every block of the page, print its time, and the answers object by object."""
    tools = folder / ".tools"
    tools.mkdir(exist_ok=True)
    (tools / "qs3").write_text(f'#!/bin/sh\nexec "{sys.executable}" -m qs3 "$@"\n')
    (tools / "qs3").chmod(0o755)
    path = {"PATH": f"{tools.resolve()}{os.pathsep}{os.environ['PATH']}"}
    for block in commands():
        start = time.perf_counter()
        done = subprocess.run(
            ["bash", "-e", "-c", block], cwd=folder, env=os.environ | path, capture_output=True,
            text=True,
        )  # fmt: skip
        print(f"{time.perf_counter() - start:.0f} s\n{block}{done.stdout}", flush=True)
        if done.returncode:
            raise SystemExit(f"exit code {done.returncode}\n{done.stderr}")
        if "qs3 segment" in block:
            found = label(folder)
            print(found.groupby("class").size().to_string(), flush=True)


def scores(folder: Path) -> pd.DataFrame:
    """Right answers of each object on the table, over the frames; of the cup that is unknown."""
    found = label(folder)
    for name in ("source-only", "adapted"):
        said = pd.read_csv(folder / f"{name}.csv").set_index("file")["class"]
        found[name] = found["file"].map(said)
    known = found[found["class"].isin([*CLASSES, "cup"])]
    wanted = known["class"].replace("cup", "unknown")
    right = {name: known[name] == wanted for name in ("source-only", "adapted")}
    groups = known.assign(**right).groupby(["object", "class"])
    return groups[["source-only", "adapted"]].sum().assign(cut_out=groups.size())


def _moved(x: float, y: float, z: float) -> np.ndarray:
    return trimesh.transformations.translation_matrix([x, y, z])


def _turned() -> np.ndarray:
    return trimesh.transformations.rotation_matrix(np.pi / 2, [1, 0, 0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--only", choices=("make", "run", "scores"))
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    if given.only in (None, "make"):
        make(given.out)
    if given.only in (None, "run"):
        run(given.out)
    if given.only in (None, "run", "scores"):
        print(scores(given.out).to_string())


if __name__ == "__main__":
    main()
