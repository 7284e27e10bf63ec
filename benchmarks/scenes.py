"""Tables with several parts, seen by a simulator that shares no code with qs3's.

Run: python benchmarks/scenes.py --out out/scenes [--results results/scenes] [--others | --cad DIR]
     python benchmarks/scenes.py --out out/scenes --times [--results results/scenes]

Twenty pictures of parts that stand apart, twenty of pairs that touch, twenty of heaps of five to
eight in any pose, and six of a bin with 15 to 25 copies of one part, whose CAD alone is searched;
of other parts by --others or --cad, of other seeds by --first. --foreign puts as many things that
no CAD file is of among the parts: they are not to be found. What is in --out
is not made again, so that other parts need another folder. Ray casting (trimesh) gives true depth,
`table_parts.photograph` the faults of a stereo camera. A part counts if the camera sees 40 % of
what it would see of it alone; it is found if its class is right and ADD-S is below a tenth of its
diameter.
"""

import json
import time
from pathlib import Path

import cv2
import numpy as np
import trimesh
from common import arguments, camera_of, rays_of
from table_parts import FOCAL, HEIGHT, PARTS, WIDTH, at, see

from qs3.evaluation.poses import adds
from qs3.files import write_text
from qs3.frames.camera_files import read_intrinsics
from qs3.frames.images import read_depth
from qs3.frames.intrinsics import Intrinsics
from qs3.parts import Library, find
from qs3.parts.views import view_of

BIN, BINS = "bin", 6
KINDS = ("apart", "touching", "heap", BIN)
"""Kinds of scenes, of which the last has so many at most."""
FLOOR, WALL = (0.3, 0.22), 0.08
"""Length and width of the bin inside, and height of its walls, metres."""
CHOSEN = {"bolt": 1, "flange": 1, "bracket": 2, "gear": 0, "housing": 1, "elbow": 0}
OTHERS = {"bolt": 2, "flange": 0, "bracket": 0, "gear": 1, "housing": 0, "elbow": 2}
"""The CAD file of each class, and of --others."""
FOREIGN = 21
"""Seed of the foreign things."""
VISIBLE, NEAR = 0.4, 0.1
GRID = 0.0012
"""Metres between the rays that tell how far a part may be pushed."""


def solids(chosen: dict[str, int], cad: Path | None) -> dict[str, trimesh.Trimesh]:
    """Return the parts in metres: the chosen, or those of a folder of STL in millimetres."""
    if cad is not None:
        return {path.stem: trimesh.load(path).apply_scale(1e-3) for path in sorted(cad.iterdir())}
    return {
        name: trimesh.util.concatenate(PARTS[name][i]).apply_scale(1e-3)
        for name, i in chosen.items()
    }


def keep_cad(folder: Path, meshes: dict[str, trimesh.Trimesh]) -> None:
    """Write the CAD of the scenes beside them, in millimetres; refuse a folder of other CAD."""
    wanted = {
        f"{name}.stl": mesh.copy().apply_scale(1e3).export(file_type="stl")
        for name, mesh in meshes.items()
    }
    if folder.is_dir():
        if {path.name: path.read_bytes() for path in folder.iterdir()} != wanted:
            raise SystemExit(f"{folder}: holds other CAD, and its scenes are of that; name another "
                             "--out")  # fmt: skip
        return
    folder.mkdir(parents=True)
    for name, text in wanted.items():
        (folder / name).write_bytes(text)


def gap(fixed: trimesh.Trimesh, moving: trimesh.Trimesh, way: np.ndarray) -> float:
    """Return how far ``moving`` can go along a unit vector until it touches ``fixed``."""
    aside = np.eye(3)[np.abs(way).argmin()]
    aside = np.cross(way, aside) / np.linalg.norm(np.cross(way, aside))
    over = np.stack([aside, np.cross(way, aside)])
    flat = moving.vertices @ over.T
    low, high = flat.min(axis=0), flat.max(axis=0)
    a, b = np.meshgrid(*(np.arange(*ends, GRID) for ends in zip(low, high, strict=True)))
    spots = np.stack([a.ravel(), b.ravel()], axis=1) @ over
    start = (moving.vertices @ way).max() + 0.01
    # Backwards through the moving part: its front; forwards from there: the fixed one.
    fronts = np.full(len(spots), np.nan)
    hit, ray, _ = moving.ray.intersects_location(
        spots + start * way, np.broadcast_to(-way, spots.shape), multiple_hits=False
    )
    fronts[ray] = hit @ way
    kept = np.isfinite(fronts)
    begin = (moving.vertices @ way).min() - 1.0
    hit, ray, _ = fixed.ray.intersects_location(
        spots[kept] + begin * way, np.broadcast_to(way, (int(kept.sum()), 3)), multiple_hits=False
    )
    return float((hit @ way - fronts[kept][ray]).min()) if len(ray) else np.inf


def lying(mesh: trimesh.Trimesh, rng: np.random.Generator) -> np.ndarray:
    """Return a stable pose with any turn."""
    poses, shares = trimesh.poses.compute_stable_poses(mesh, threshold=0.03)
    if not len(poses):  # a ball
        poses, shares = trimesh.poses.compute_stable_poses(mesh)
    pose = poses[rng.choice(len(poses), p=shares / shares.sum())]
    return trimesh.transformations.rotation_matrix(rng.uniform(0, 2 * np.pi), (0, 0, 1)) @ pose


def moved(pose: np.ndarray, *shift: float) -> np.ndarray:
    return trimesh.transformations.translation_matrix(shift) @ pose


def posed(mesh: trimesh.Trimesh, pose: np.ndarray) -> trimesh.Trimesh:
    return mesh.copy().apply_transform(pose)


def arrange(kind: str, meshes: dict[str, trimesh.Trimesh], rng: np.random.Generator) -> list:
    """Return names of parts with their poses on the table z = 0."""
    names = sorted(meshes)
    if kind == "apart":
        spots = [(x, y) for x in (-0.13, 0.0, 0.13) for y in (-0.075, 0.075)]
        few = rng.permutation(len(spots))[: rng.integers(4, 6)]
        return [
            (name := names[rng.integers(len(names))],
             moved(lying(meshes[name], rng), *spots[k], 0))
            for k in few
        ]  # fmt: skip
    if kind == "touching":
        placed = []
        for x in (-0.1, 0.1):
            one, two = (names[k] for k in rng.integers(len(names), size=2))
            first = moved(lying(meshes[one], rng), x, rng.uniform(-0.05, -0.03), 0)
            far = np.inf
            while far == np.inf:  # it passes the first by
                way = -np.array([np.cos(turn := rng.uniform(-2.2, -0.9)), np.sin(turn), 0])
                second = moved(lying(meshes[two], rng), *(first[:3, 3] + 0.3 * way) * (1, 1, 0))
                second[2, 3] = lift_to_table(meshes[two], second)
                far = gap(posed(meshes[one], first), posed(meshes[two], second), -way)
            placed += [(one, first), (two, moved(second, *(-(far - 3e-4) * way)))]
        return placed
    placed, heap = [], at(trimesh.creation.box((1.2, 1.2, 0.02)), z=-0.01)
    for _ in range(rng.integers(5, 9)):
        name = names[rng.integers(len(names))]
        pose = lying(meshes[name], rng)
        if placed:
            tilt = np.radians(rng.uniform(0, 35))
            pose = trimesh.transformations.rotation_matrix(tilt, [*rng.normal(size=2), 0]) @ pose
        x, y = rng.uniform(-0.055, 0.055, 2)
        middle = posed(meshes[name], pose).bounds.mean(axis=0)
        pose = moved(pose, x - middle[0], y - middle[1], 0.5)
        down = np.array([0.0, 0, -1])
        pose = moved(pose, 0, 0, -gap(heap, posed(meshes[name], pose), down))
        placed.append((name, pose))
        heap = trimesh.util.concatenate([heap, posed(meshes[name], pose)])
    return placed


def fill(mesh: trimesh.Trimesh, rng: np.random.Generator) -> tuple[list, list]:
    """Return poses of copies of a part that lie in a bin, each low among four, and its walls."""
    (wide, deep), thick = FLOOR, 0.005
    front = trimesh.creation.box((wide + 2 * thick, thick, WALL))
    end = trimesh.creation.box((thick, deep, WALL))
    walls = [at(front.copy(), y=side * deep / 2, z=WALL / 2) for side in (-1, 1)]
    walls += [at(end.copy(), x=side * wide / 2, z=WALL / 2) for side in (-1, 1)]
    poses: list[np.ndarray] = []
    heap = trimesh.util.concatenate([at(trimesh.creation.box((1.2, 1.2, 0.02)), z=-0.01), *walls])
    for _ in range(rng.integers(15, 26)):
        tried = []
        for _ in range(4):
            pose = lying(mesh, rng)
            if poses:
                tilt, axis = np.radians(rng.uniform(0, 30)), [*rng.normal(size=2), 0]
                pose = trimesh.transformations.rotation_matrix(tilt, axis) @ pose
            low, high = posed(mesh, pose).bounds
            room = np.array(FLOOR) / 2 - thick - (high - low)[:2] / 2
            x, y = rng.uniform(-room, room) - (low + high)[:2] / 2
            pose = moved(pose, x, y, 0.5)
            pose = moved(pose, 0, 0, -gap(heap, posed(mesh, pose), np.array([0.0, 0, -1])))
            tried.append((posed(mesh, pose).bounds[1, 2], pose))
        poses.append(min(tried, key=lambda one: one[0])[1])
        heap = trimesh.util.concatenate([heap, posed(mesh, poses[-1])])
    return poses, walls


def foreign(seed: int) -> dict[str, trimesh.Trimesh]:
    """Return six simple things of 2 to 9 cm, of whose class no part is."""
    rng = np.random.default_rng(seed)
    a, b, c = rng.uniform(0.01, 0.025, (3, 6))
    piece = trimesh.creation
    things = {
        "box": piece.box((2 * a[0], 3 * b[0], 1.5 * c[0])),
        "plate": piece.box((3.5 * a[1], 3 * b[1], 0.5 * c[1])),
        "rod": piece.cylinder(0.6 * a[2], 4 * b[2], sections=16),
        "ball": piece.icosphere(3, a[3]),
        "cone": piece.cone(a[4], 2.5 * b[4], sections=16),
        "ring": piece.torus(1.3 * a[5], 0.4 * b[5]),
    }
    return {f"foreign_{name}": mesh for name, mesh in things.items()}


def lift_to_table(mesh: trimesh.Trimesh, pose: np.ndarray) -> float:
    return float(pose[2, 3] - posed(mesh, pose).bounds[0, 2])


def make(out: Path, meshes: dict[str, trimesh.Trimesh], kind: str, number: int) -> None:
    """Write one picture and its truth: names, poses camera from part, shares that are seen."""
    rng = np.random.default_rng([KINDS.index(kind), number])
    around: list[trimesh.Trimesh] = []
    if kind == BIN:
        name = sorted(meshes)[number % len(meshes)]
        poses, around = fill(meshes[name], rng)
        placed = [(name, pose) for pose in poses]
    else:
        placed = arrange(kind, meshes, rng)
    whole = trimesh.util.concatenate([posed(meshes[name], pose) for name, pose in placed] + around)
    views = ((0.8, 0.9), (66.0, 75.0)) if kind == BIN else ((0.55, 0.75),)
    depth, seen_from, owner = see(whole, rng, *views)
    counts = np.cumsum([len(meshes[name].faces) for name, _ in placed])
    owners = np.where(owner >= 0, np.searchsorted(counts, owner, side="right"), -1)
    truth = []
    for k, (name, pose) in enumerate(placed):
        pose = seen_from @ pose
        alone = footprint(meshes[name], pose)
        share = (owners == k).sum() / max(alone, 1)
        truth.append({"class": name, "pose": pose.tolist(), "share": float(share)})
    write(out / kind, number, depth, truth)


def write(folder: Path, number: int, depth: np.ndarray, truth: list) -> None:
    """Write a depth picture, in steps of a tenth of a millimetre, and then its truth."""
    path = folder / "depth" / f"{number:06d}.png"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(cv2.imencode(".png", depth)[1].tobytes())
    (folder / f"{number:06d}.json").write_text(json.dumps(truth))


def measures(
    meshes: dict[str, trimesh.Trimesh],
) -> tuple[dict[str, np.ndarray], dict[str, float]]:
    """Return points of the surface of each part, and its diameter."""
    points = {name: trimesh.sample.sample_surface(m, 1500, seed=0)[0] for name, m in meshes.items()}
    return points, {name: float(np.linalg.norm(mesh.extents)) for name, mesh in meshes.items()}


def footprint(mesh: trimesh.Trimesh, pose: np.ndarray) -> int:
    """Return the number of pixels of a part alone."""
    rays = rays_of(WIDTH, HEIGHT, FOCAL)
    return int(posed(mesh, pose).ray.intersects_any(np.zeros_like(rays), rays).sum())


def judge(
    truth: list, found: list, points: dict[str, np.ndarray], sizes: dict[str, float]
) -> tuple[int, int, list[bool]]:
    """Return parts to find, found of these, and whether each answer is right.

    A truth is used once.
    """
    left, right, hit = [*range(len(truth))], [], 0
    for answer in found:
        errors = {
            k: adds(np.array(answer.pose), np.array(truth[k]["pose"]), points[truth[k]["class"]])
            for k in left
            if truth[k]["class"] == answer.class_name
        }
        best = min(errors, key=errors.__getitem__, default=None)
        right.append(best is not None and errors[best] < NEAR * sizes[truth[best]["class"]])
        if right[-1]:
            left.remove(best)
            hit += truth[best]["share"] >= VISIBLE
    return sum(t["share"] >= VISIBLE for t in truth), hit, right


STEPS = (0.5, 0.6, 0.7, 0.8, 0.9, 1.0)
"""Ends of the ranges of scores in the table of reliability."""


def reliability(scores: list[float], right: list[bool]) -> str:
    """Return a table of answers by score, and the expected calibration error."""
    lines, off = ["| score | answers | mean score % | right % |", "|---" * 4 + "|"], 0.0
    stated, hit = np.array(scores), np.array(right)
    place = np.clip(np.searchsorted(STEPS, stated, side="right") - 1, 0, len(STEPS) - 2)
    for k in range(len(STEPS) - 1):
        if (inside := place == k).any():
            mean, good = 100 * stated[inside].mean(), 100 * hit[inside].mean()
            off += inside.sum() * abs(mean - good)
            span = f"{STEPS[k]:g} to {STEPS[k + 1]:g}"
            lines.append(f"| {span} | {inside.sum()} | {mean:.0f} | {good:.0f} |")
    error = off / max(len(stated), 1)
    return "\n".join([*lines, "", f"Expected calibration error: {error:.1f} %.", ""])


SHAPES = ((320, 240), (640, 480), (1280, 720))
FRAMES = 12
"""Sizes of the pictures of `times`, and the frames of each that are followed."""


def times() -> str:
    """Return tables of CPU seconds: `find` by parts and CAD files, and frame after frame by size.

    Up to ten parts stand apart in two rows; the CAD files beyond those of the parts are boxes.
    """
    meshes = solids(CHOSEN, None)
    lines = ["| parts | 1 CAD file | 6 | 12 | 20 |", "|---" * 5 + "|"]
    camera, depth = laid(meshes, 5, (320, 240))
    boxes = np.random.default_rng(0).uniform(0.02, 0.09, (14, 3))
    views = [view_of(mesh, 1.0, name, name) for name, mesh in meshes.items()]
    views += [view_of(trimesh.creation.box(size), 1.0, f"box{k}", f"box{k}")
              for k, size in enumerate(boxes)]  # fmt: skip
    find(Library(tuple(views[:6])), depth, camera)  # compile
    for parts in (1, 5, 10):
        camera, depth = laid(meshes, parts, (320, 240))
        cells = [cpu(Library(tuple(views[:n])), depth, camera) for n in (1, 6, 12, 20)]
        lines.append(f"| {parts} | " + " | ".join(f"{s:.2f}" for s in cells) + " |")
    lines += ["", "| size | parts | first frame, CPU s | next frames, CPU s | frames per CPU s |",
              "|---" * 5 + "|"]  # fmt: skip
    library = Library(tuple(views[:6]))
    for shape in SHAPES:
        for parts in (1, 5, 10):
            camera, depth = laid(meshes, parts, shape)
            rng = np.random.default_rng(0)
            found, seconds = None, []
            for _ in range(FRAMES):
                noisy = depth + (depth > 0) * rng.normal(scale=0.0005, size=depth.shape)
                start = time.process_time()
                found = find(library, noisy.astype(np.float32), camera, before=found)
                seconds.append(time.process_time() - start)
            after = float(np.median(seconds[1:]))
            lines.append(f"| {shape[0]} × {shape[1]} | {parts} | {seconds[0]:.2f} | {after:.2f} | "
                         f"{1 / after:.1f} |")  # fmt: skip
    return "\n".join([*lines, ""])


def cpu(library: Library, depth: np.ndarray, camera: Intrinsics) -> float:
    """Return the CPU seconds of one call of `find`."""
    start = time.process_time()
    find(library, depth, camera)
    return time.process_time() - start


def laid(
    meshes: dict[str, trimesh.Trimesh], count: int, shape: tuple[int, int]
) -> tuple[Intrinsics, np.ndarray]:
    """Return the camera and the true depth of parts in two rows on a table 0.8 m below it."""
    rng, names = np.random.default_rng(0), sorted(meshes)
    parts = [
        moved(
            lying(meshes[names[k % len(names)]], rng), 0.11 * (k // 2 - 2), 0.13 * (k % 2 - 0.5), 0
        )
        for k in range(count)
    ]
    whole = [posed(meshes[names[k % len(names)]], pose) for k, pose in enumerate(parts)]
    table = at(trimesh.creation.box((1.6, 1.2, 0.02)), z=-0.01)
    scene = trimesh.util.concatenate([*whole, table])
    width, height = shape
    focal = 1.3 * height
    rays = rays_of(width, height, focal)
    away = rays * (1, -1, -1)
    start = np.broadcast_to((0.0, 0.0, 0.8), rays.shape)
    hit, ray, _ = scene.ray.intersects_location(start, away, multiple_hits=False)
    depth = np.zeros(len(rays))
    depth[ray] = 0.8 - hit[:, 2]
    depth += (depth > 0) * rng.normal(scale=0.0005, size=len(rays))
    camera = Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    return camera, depth.reshape(height, width).astype(np.float32)


def main() -> None:
    parser = arguments(__doc__, "out")
    parser.add_argument("--scenes", type=int, default=20)
    parser.add_argument("--first", type=int, default=0, help="number of the first scene: its seed")
    parser.add_argument("--others", action="store_true", help="other parts of the same classes")
    parser.add_argument("--cad", type=Path, help="a folder of STL in millimetres, a file a class")
    parser.add_argument("--foreign", action="store_true", help="foreign things among the parts")
    parser.add_argument("--kinds", nargs="*", default=KINDS, choices=KINDS)
    parser.add_argument("--times", action="store_true", help="measure CPU seconds alone")
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    out = options.out
    if options.times:
        text = times()
        if options.results is not None:
            write_text(options.results / "times.md", text)
        print(text)
        return
    meshes = solids(OTHERS if options.others else CHOSEN, options.cad)
    keep_cad(out / "cad", meshes)
    things = {**meshes, **foreign(FOREIGN)} if options.foreign else meshes
    library = Library.of_folder(out / "cad", "mm")
    points, sizes = measures(meshes)
    lines = ["| scenes | parts | recall % | precision % | CPU s per picture |", "|---" * 5 + "|"]
    scores: list[float] = []
    right: list[bool] = []
    out = out / "foreign" if options.foreign else out
    for kind in options.kinds:
        sums, seconds = np.zeros(4, int), []
        count = min(options.scenes, BINS) if kind == BIN else options.scenes
        for number in range(options.first, options.first + count):
            if not (out / kind / f"{number:06d}.json").is_file():
                make(out, meshes if kind == BIN else things, kind, number)
            (out / kind / "camera.json").write_text(json.dumps(camera_of(WIDTH, HEIGHT, FOCAL)))
            intrinsics = read_intrinsics(out / kind)
            depth = read_depth(out / kind / "depth" / f"{number:06d}.png", intrinsics.depth_scale)
            truth = json.loads((out / kind / f"{number:06d}.json").read_text())
            truth = [entry for entry in truth if entry["class"] in meshes]
            known = library.only([truth[0]["class"]]) if kind == BIN else library
            start = time.process_time()
            found = find(known, depth, intrinsics)
            seconds.append(time.process_time() - start)
            sought, hit, flags = judge(truth, list(found.parts), points, sizes)
            counts = (sought, hit, len(flags), sum(flags))
            sums += counts
            scores += [part.score for part in found.parts]
            right += flags
            if options.verbose:
                wanted = ", ".join(f"{t['class']} {t['share']:.2f}" for t in truth)
                line = ", ".join(f"{p.class_name} {p.score:.2f}" for p in found.parts)
                print(
                    f"{kind} {number} {counts} {seconds[-1]:.1f} s: {wanted} -> {line}", flush=True
                )
        sought, hit, answers, good = sums.tolist()
        lines.append(
            f"| {kind} ({count}) | {sought} | {100 * hit / max(sought, 1):.0f} | "
            f"{100 * good / max(answers, 1):.0f} | {np.median(seconds):.1f} |"
        )
    text = "\n".join([*lines, "", reliability(scores, right)])
    if options.results is not None:
        name = "others" if options.others else "cad" if options.cad else "scenes"
        name += "-foreign" if options.foreign else ""
        write_text(options.results / f"{name}.md", text)
    print(text)


if __name__ == "__main__":
    main()
