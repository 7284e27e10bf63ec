"""A small SUN RGB-D: synthetic frames in the release's layout, with all three lists of boxes."""

import json
from pathlib import Path

import numpy as np
import trimesh
from scipy.io import savemat

from .depth_scene import MATRIX, box, photograph, thing, write_png

ABOVE = "/n/fs/sun3d/data/SUNRGBD/"
FRAMES = ("kv1/NYUdata/NYU0001", "xtion/sun3ddata/room/0002")
# Standing on the floor, turned in the world.
TURN = np.radians([20.0, -70.0])
PLACE = np.array([[0.1, 2.3, -1.1], [-0.2, 2.0, -1.3]])
TILT = np.radians([15.0, 24.0])


def structs(rows: list[dict]) -> np.ndarray:
    """A struct array [1 n] as SciPy writes it."""
    made = np.zeros((1, len(rows)), dtype=[(name, object) for name in rows[0]])
    for index, row in enumerate(rows):
        for name, value in row.items():
            made[name][0, index] = value
    return made


def turned(index: int) -> np.ndarray:
    c, s = np.cos(TURN[index]), np.sin(TURN[index])
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def placed(index: int) -> trimesh.Trimesh:
    """The thing in the frame's world: x right, y forward, z up, the camera at the origin."""
    mesh = thing()
    mesh.vertices = mesh.vertices @ turned(index).T + PLACE[index]
    return mesh


def truth(index: int) -> dict:
    """The thing's tight box."""
    mesh = thing()
    middle = mesh.bounds.mean(axis=0)
    return {
        "centroid": turned(index) @ middle + PLACE[index],
        "basis": turned(index).T,
        "coeffs": mesh.extents / 2,
    }


def write_sunrgbd(root: Path) -> None:
    """Two frames below ``root/SUNRGBD``, ``SUNRGBDMeta3DBB_v2.mat`` and ``boxes.json``."""
    rows, table = [], {}
    for index, name in enumerate(FRAMES):
        folder = root / "SUNRGBD" / name
        # OpenCV camera to world: tilted downwards about its x axis.
        c, s = np.cos(TILT[index]), np.sin(TILT[index])
        pose = np.eye(4)
        pose[:3, :3] = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]]) @ [
            [1, 0, 0],
            [0, c, s],
            [0, -s, c],
        ]
        floor = box((20.0, 20.0, 0.1), (-10, -10, PLACE[index, 2] - 0.1))
        depth, _ = photograph(trimesh.util.concatenate([placed(index), floor]), pose)
        steps = np.rint(np.clip(depth, 0, 65) * 1000).astype(np.uint16)
        bits = (steps << 3) | (steps >> 13)
        write_png(folder / "depth_bfx" / "d.png", bits)
        write_png(folder / "depth" / "d.png", np.where(bits % 5 == 0, 0, bits).astype(np.uint16))
        matrix = MATRIX.copy()
        matrix[:2, 2] += 1  # pixels are counted from 1
        text = "\n".join(" ".join(f"{value:.6f}" for value in row) for row in matrix)
        (folder / "intrinsics.txt").write_text(text, encoding="utf-8")
        extrinsics = np.array([[1, 0, 0], [0, c, s], [0, -s, c]])
        lines = [" ".join(f"{value:.9f}" for value in [*row, 0.0]) for row in extrinsics]
        (folder / "extrinsics").mkdir(exist_ok=True)
        (folder / "extrinsics" / "20140101.txt").write_text("1 0 0 0 0 1 0 0 0 0 1 0")
        (folder / "extrinsics" / "20150101.txt").write_text("\n".join(lines), encoding="utf-8")
        tight = truth(index)
        write_annotation(folder, tight)
        boxes = [("wall", tight), ("sofa_chair", tight), ("toilet", tight)]
        table[name] = [
            {"class": word, **{key: value.tolist() for key, value in what.items()}}
            for word, what in boxes[1:]
        ]
        rows.append(meta_row(name, matrix, pose[:3, :3], boxes[1:]))
    rows.append({**rows[0], "depthpath": f"{ABOVE}kv2/absent/0003/depth_bfx/d.png"})
    rows.append({**rows[1], "groundtruth3DBB": np.zeros((0, 0))})
    savemat(root / "SUNRGBDMeta3DBB_v2.mat", {"SUNRGBDMeta": structs(rows)}, do_compression=True)
    (root / "boxes.json").write_text(json.dumps(table), encoding="utf-8")
    cells = [np.array([f"{ABOVE}{name}"], dtype=object).reshape(1, 1) for name in FRAMES]
    savemat(root / "allsplit.mat", {"alltrain": cells[0], "alltest": cells[1]})


def meta_row(name: str, matrix, camera_to_world, boxes) -> dict:
    """One row of the .mat; Rtilt takes (x, z, −y)."""
    turned_axes = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    entries = [
        {
            "basis": tight["basis"],
            "coeffs": tight["coeffs"][None] * [1, -1, 1],
            "centroid": tight["centroid"][None],
            "classname": word,
            "sequenceName": f"SUNRGBD/{name}",
            "orientation": np.ones((1, 3)),
            "label": 1,
        }
        for word, tight in boxes
    ]
    return {
        "sequenceName": f"SUNRGBD/{name}",
        "Rtilt": camera_to_world @ turned_axes.T,
        "K": matrix,
        "depthpath": f"{ABOVE}/{name}/depth_bfx/d.png",
        "rgbpath": f"{ABOVE}{name}/image/i.jpg",
        "groundtruth3DBB": structs(entries),
    }


def write_annotation(folder: Path, tight: dict) -> None:
    """The box as the annotators' tool wrote it: four corners from above, y down."""
    (x, y, z), (a, b, height) = tight["centroid"], tight["coeffs"]
    first, second = tight["basis"][:2]
    corners = np.array([-a * first - b * second, a * first - b * second,
                        a * first + b * second, -a * first + b * second])  # fmt: skip
    polygon = {
        "rectangle": True,
        "X": (corners[:, 0] + x).tolist(),
        "Z": (corners[:, 1] + y).tolist(),
        "Ymin": -(z + height),
        "Ymax": -(z - height),
    }
    objects = [
        None,
        {"name": "wall", "polygon": [polygon]},
        {"name": "sofa_chair:truncated", "polygon": [polygon]},
        {"name": "chair", "polygon": []},
    ]
    path = folder / "annotation3Dfinal" / "index.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps({"date": "", "objects": objects}), encoding="utf-8")
