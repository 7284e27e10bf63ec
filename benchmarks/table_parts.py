"""Eighteen parts of six kinds on a table, seen by a simulator that shares no code with qs3's.

Run: python benchmarks/table_parts.py --out out/table [--seeds 0 1 2] [--workers N]

Ray casting (trimesh) gives true depth; to it come disparity noise, so that depth noise grows with
z², steps of 1/32 px, points that one of two imagers does not see, lost edges and dropouts.
``qs3 segment`` cuts the parts out, and ``qs3 extract depth`` with the true masks and with masks
that bleed; ``qs3 generate --recipe parts`` makes the source of each seed. What is in --out is not
made again; the tables are written into --results, by default results/ in --out. Unknown: each kind
is left out of the source in turn.

Of the clouds of bleeding masks: *raw* are all their points, *extract* what ``qs3 extract depth``
makes of them.
"""

import csv
import json
import os
import subprocess
import sys
import time
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import trimesh
from common import arguments, camera_of, keep, rays_of
from parts import described
from scipy.ndimage import gaussian_filter, maximum_filter, minimum_filter
from scipy.stats import rankdata
from sklearn.metrics import roc_auc_score
from tqdm import tqdm
from trimesh.creation import annulus, box, cylinder, revolve

from qs3.adaptation.confidence import energy
from qs3.clouds.files import read_cloud
from qs3.clouds.layouts.store import read_ragged
from qs3.clouds.types import CloudKind
from qs3.evaluation.poses import adds, mssd
from qs3.parts import Forest, describe, fit_forest, locate
from qs3.parts.library import Library
from qs3.parts.loaded_forest import answers_of, cleaned
from qs3.parts.locating import Candidate, located
from qs3.parts.places import Place, place_of
from qs3.parts.witness import Seen

WIDTH, HEIGHT, FOCAL, BASELINE = 320, 240, 430.0, 0.05
VIEWS, BLEEDS = 8, (0, 1, 2, 3)
SOURCES: dict[str, tuple[CloudKind, ...]] = {
    "M": ("surface",),
    "C": ("clean",),
    "S": ("points",),
    "S+C+M": ("points", "clean", "surface"),
}
FEWEST = 60
SEGMENT = f"--tolerance 0.005 --noise 0.003 --min-points {FEWEST} --gravity 0 0.57 0.82"
"""The camera looks down by 35 to 75 degrees, 55 in the middle."""
GENERATE = "--recipe parts --units mm"
LARGEST = 0.2
"""Metres: a longer object is a strip of the table."""


def at(mesh: trimesh.Trimesh, x: float = 0, y: float = 0, z: float = 0) -> trimesh.Trimesh:
    return mesh.apply_translation((x, y, z))


def bolt(flats: float, head: float, shank: float, length: float) -> list[trimesh.Trimesh]:
    turned = [at(cylinder(shank / 2, length, sections=32), z=head + length / 2)]
    return [at(cylinder(flats / 3**0.5, head, sections=6), z=head / 2), *turned]


def flange(disc: float, thick: float, neck: float, high: float, bore: float) -> list:
    wide, narrow, hole = disc / 2, neck / 2, bore / 2
    profile = [(hole, 0), (wide, 0), (wide, thick), (narrow, thick), (narrow, high), (hole, high)]
    return [revolve([*profile, profile[0]], sections=64)]


def bracket(width: float, foot: float, high: float, thick: float, sides: int) -> list:
    parts = [at(box((foot, width, thick)), z=thick / 2)]
    for side in (-1, 1)[:sides]:
        x = side * (foot - thick) / 2
        parts.append(at(box((thick, width, high)), x=x, z=high / 2))
    return parts


def gear(root: float, tooth: float, wide: float, teeth: int, bore: float, hub: float) -> list:
    parts = [at(annulus(bore / 2, root / 2, wide, sections=64), z=wide / 2)]
    parts.append(at(annulus(bore / 2, 0.8 * bore, hub, sections=32), z=hub / 2))
    for i in range(teeth):
        across = 1.5 * root / teeth
        one = at(box((2 * tooth, across, wide)), x=root / 2, z=wide / 2)
        turn = trimesh.transformations.rotation_matrix(2 * np.pi * i / teeth, (0, 0, 1))
        parts.append(one.apply_transform(turn))
    return parts


def housing(long: float, wide: float, high: float, wall: float, boss: float) -> list:
    parts = [at(box((long, wide, wall)), z=wall / 2)]
    for side in (-1, 1):
        parts.append(at(box((long, wall, high)), y=side * (wide - wall) / 2, z=high / 2))
        parts.append(at(box((wall, wide, high)), x=side * (long - wall) / 2, z=high / 2))
        parts.append(at(box((1.5 * boss, wide / 2, wall)), x=side * (long + boss) / 2, z=wall / 2))
    return [*parts, at(annulus(0.3 * boss, boss / 2, 0.7 * high), z=0.35 * high)]


def elbow(pipe: float, wall: float, bend: float, leg: float, degrees: float) -> list:
    angle = np.radians(np.linspace(0, degrees, 25))
    path = np.stack([bend * np.cos(angle), 0 * angle, bend * np.sin(angle)], axis=1)
    ahead = np.stack([-np.sin(angle), 0 * angle, np.cos(angle)], axis=1)
    path = np.stack([path[0] - leg * ahead[0], *path, path[-1] + leg * ahead[-1]])
    ahead = np.stack([ahead[0], *ahead, ahead[-1]])
    turn = np.arange(32) * 2 * np.pi / 32
    rings = []
    for radius, order in ((pipe / 2, 1), (pipe / 2 - wall, -1)):
        for centre, forward in [*zip(path, ahead, strict=True)][::order]:
            aside = np.cross((0, 1, 0), forward)
            ring = np.outer(np.cos(turn), aside) + np.outer(np.sin(turn), (0, 1, 0))
            rings.append(centre + radius * ring)
    grid = np.arange(len(rings) * 32).reshape(-1, 32)
    a, b = grid, np.roll(grid, -1, axis=0)
    c, d = np.roll(a, -1, axis=1), np.roll(b, -1, axis=1)
    faces = np.stack([np.stack([a, c, b], -1), np.stack([c, d, b], -1)]).reshape(-1, 3)
    return [trimesh.Trimesh(np.concatenate(rings), faces)]


PARTS = {
    "bolt": [bolt(13, 5.3, 8, 45), bolt(24, 10, 16, 60), bolt(30, 12.5, 20, 90)],
    "flange": [flange(95, 14, 55, 40, 42), flange(70, 10, 38, 22, 25), flange(115, 16, 60, 28, 48)],
    "bracket": [bracket(30, 45, 70, 5, 1), bracket(60, 60, 40, 4, 1), bracket(40, 70, 35, 4, 2)],
    "gear": [gear(48, 5, 16, 16, 10, 26), gear(76, 6, 12, 26, 16, 22), gear(34, 4, 24, 14, 8, 34)],
    "housing": [
        housing(90, 60, 45, 4, 14),
        housing(60, 60, 30, 3, 12),
        housing(110, 50, 32, 5, 16),
    ],
    "elbow": [elbow(28, 3, 32, 16, 90), elbow(42, 4, 45, 20, 90), elbow(34, 3, 60, 25, 45)],
}
"""Millimetres."""


def photograph(
    mesh: trimesh.Trimesh, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a depth image of a mesh in metres, its mask, and the camera's pose.

    The image is in tenths of a millimetre; 0 is no depth. The pose is camera from world.
    """
    depth, pose, faces = see(mesh, rng)
    return depth, faces >= 0, pose


def see(
    mesh: trimesh.Trimesh,
    rng: np.random.Generator,
    away: tuple[float, float] = (0.38, 0.75),
    down: tuple[float, float] = (35.0, 75.0),
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return what `photograph` does, and the face of the mesh at each pixel; −1 for none.

    ``away`` is the range of distances in metres, and ``down`` that of degrees below the horizon.
    """
    table = at(box((1.2, 1.2, 0.02)), z=-0.01)
    scene = trimesh.util.concatenate([mesh, table])
    turn, down = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(*down))
    ahead = np.array([np.cos(turn) * np.cos(down), np.sin(turn) * np.cos(down), -np.sin(down)])
    right = np.array([ahead[1], -ahead[0], 0]) / np.cos(down)
    axes = np.stack([right, np.cross(ahead, right), ahead])
    eye = mesh.bounds.mean(axis=0) - rng.uniform(*away) * ahead
    rays = rays_of(WIDTH, HEIGHT, FOCAL)
    hit, ray, face = scene.ray.intersects_location(
        np.broadcast_to(eye, rays.shape), rays @ axes, multiple_hits=False
    )
    depth, slant = np.zeros(len(rays)), np.ones(len(rays))
    depth[ray] = (hit - eye) @ ahead
    faces = np.full(len(rays), -1)
    faces[ray] = np.where(face < len(mesh.faces), face, -1)
    sight = (hit - eye) / np.linalg.norm(hit - eye, axis=1, keepdims=True)
    slant[ray] = np.abs(np.einsum("nd,nd->n", scene.face_normals[face], sight))
    other = eye + BASELINE * right - hit
    back = other / np.linalg.norm(other, axis=1, keepdims=True)
    hidden = scene.ray.intersects_any(hit + 5e-4 * back, back)
    depth[ray[hidden]] = 0
    shape = (HEIGHT, WIDTH)
    depth, slant = depth.reshape(shape), slant.reshape(shape)
    blur = gaussian_filter(rng.normal(size=shape), 1.0)
    disparity = FOCAL * BASELINE / np.maximum(depth, 0.1) + 0.08 * blur / blur.std()
    found = FOCAL * BASELINE / (np.round(disparity * 32) / 32)
    step = maximum_filter(depth, 3) - minimum_filter(depth, 3)
    lost = (depth == 0) | ((step > 0.012) & (rng.random(shape) < 0.7))
    holes = gaussian_filter(rng.normal(size=shape), 2.0)
    lost |= (holes / holes.std() > 2.0) | (rng.random(shape) < np.clip(0.35 - slant, 0, 1) * 3)
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = axes, -axes @ eye
    image = np.where(lost, 0, np.rint(found * 1e4)).astype(np.uint16)
    return image, pose, faces.reshape(shape)


def make(out: Path, workers: int) -> None:
    """Write CAD, frames, masks, the camera, and the pose of each part: camera from file, metres."""
    for name, parts in PARTS.items():
        for i, solids in enumerate(parts):
            path = out / "cad" / name / f"{name}{i}.stl"
            path.parent.mkdir(parents=True, exist_ok=True)
            trimesh.util.concatenate(solids).export(path)
    for folder in ("frames", *(f"masks-{bleed}" for bleed in BLEEDS)):
        (out / folder).mkdir(exist_ok=True)
    jobs = [(name, i) for name, parts in PARTS.items() for i in range(len(parts))]
    with ProcessPoolExecutor(workers) as pool:
        found = pool.map(partial(make_frames, out), jobs)
        truth = dict(pair for pairs in tqdm(found, "frames", len(jobs)) for pair in pairs)
    (out / "poses.json").write_text(json.dumps(truth))
    (out / "camera.json").write_text(json.dumps(camera_of(WIDTH, HEIGHT, FOCAL)))


def make_frames(out: Path, job: tuple[str, int]) -> list[tuple[str, list]]:
    """Write the frames of one part and their masks; return the pose in each."""
    (name, i), truth = job, []
    mesh = trimesh.util.concatenate(PARTS[name][i])
    poses, shares = trimesh.poses.compute_stable_poses(mesh, threshold=0.03)
    for view in range(VIEWS):
        rng = np.random.default_rng([i, view, *name.encode()])
        pose = poses[rng.choice(len(poses), p=shares / shares.sum())]
        lying = mesh.copy().apply_transform(pose).apply_scale(1e-3)
        image, mask, seen_from = photograph(lying, rng)
        file = f"{name}-{i}-{view}.png"
        (out / "frames" / file).write_bytes(cv2.imencode(".png", image)[1].tobytes())
        for bleed in BLEEDS:
            disc = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * bleed + 1,) * 2)
            wide = cv2.dilate(mask.astype(np.uint8), disc)
            path = out / f"masks-{bleed}" / file
            path.write_bytes(cv2.imencode(".png", wide)[1].tobytes())
        metric = np.array(pose)
        metric[:3, 3] *= 1e-3
        truth.append((Path(file).stem, (seen_from @ metric).tolist()))
    return truth


def run(words: str) -> None:
    subprocess.run([sys.executable, "-m", "qs3", *words.split()], check=True)


Compared = tuple[tuple[Candidate, ...], float]
"""The best pose of each CAD file, and CPU seconds."""


PLACES = ("table and camera", "both, but off", "nothing")
"""What is known of the place of a scan. *Off*: 2 mm more noise, the table 2 mm off, and the camera
3 cm off, in any direction."""
OFF, ASIDE = 0.002, 0.03


def compare(
    library: Library, found: dict[Path, np.ndarray], workers: int, known: str
) -> tuple[list[tuple[Candidate, ...]], float]:
    """Return the best pose of each CAD file in each scan, and CPU seconds per scan."""
    work = partial(compared, library=library, known=known)
    with ProcessPoolExecutor(workers) as pool:
        rows = list(tqdm(pool.map(work, found.items()), "CAD", len(found)))
    return [row for row, _ in rows], float(np.mean([seconds for _, seconds in rows]))


def compared(one: tuple[Path, np.ndarray], library: Library, known: str) -> Compared:
    path, cloud = one
    place = Place() if known == PLACES[2] else place_of(path)
    if known == PLACES[1] and place.camera is not None:
        rng = np.random.default_rng([*path.parent.name.encode()])
        cloud = cloud + rng.normal(0, OFF, cloud.shape) + (0, 0, rng.choice((-OFF, OFF)))
        aside = rng.normal(size=3)
        x, y, z = place.camera + ASIDE * aside / np.linalg.norm(aside)
        place = Place(place.on_table, (x, y, z))
    start = time.process_time()
    found = locate(library, cleaned(cloud).astype(float), place)
    return found.candidates, time.process_time() - start


def poses(
    out: Path, library: Library, scenes: Sequence[str], seen: list[tuple[Candidate, ...]]
) -> str:
    """Return shares of right files and poses, and how well the misfit separates right poses.

    Also the share of rightly named scans that are lost, and of scans not lost whose own CAD file is
    left out.
    """
    truth, parts = json.loads((out / "poses.json").read_text()), {p.cad: p for p in library}
    right, adds_of, mssd_of, good, misfit = [], [], [], [], []
    lost, kept = [], []
    for scene, candidates in zip(scenes, seen, strict=True):
        kind, number, _ = scene.split("-")
        part = parts[f"{kind}/{kind}{number}"]
        record = json.loads((out / "objects" / scene / "scene.json").read_text())
        true = np.linalg.inv(np.array(record["camera_from_table"])) @ np.array(truth[scene])
        points, equals = part.points.astype(float), part.symmetry.equals()
        right.append(candidates[0].cad == part.cad)
        if right[-1]:
            lost.append(candidates[0].lost)
        kept.append(not located(one for one in candidates if one.cad != part.cad).lost)
        for one in candidates:
            off = adds(one.pose, true, points) / part.diameter if one.cad == part.cad else np.inf
            good.append(off < 0.05)
            misfit.append(one.misfit)
            if one is candidates[0]:
                adds_of.append(off)
                far = mssd(one.pose, true, points, equals) if np.isfinite(off) else np.inf
                mssd_of.append(far / part.diameter)
    shares = np.array(right), np.array(adds_of) < 0.05, np.array(mssd_of) < 0.1
    cells = [f"{100 * share.mean():.1f}" for share in shares]
    cells.append(f"{roc_auc_score(good, -np.array(misfit)):.3f}")
    return " | ".join([*cells, *(f"{100 * np.mean(some):.0f}" for some in (lost, kept))])


def adapted(out: Path, seed: int, names: tuple[str, ...], scenes: Sequence[str]) -> np.ndarray:
    """Return what ``qs3 train`` with CAD, and ``qs3 predict``, answer: forest and CAD."""
    place, table = out / f"run-{seed}", out / f"answers-{seed}.csv"
    words = f"--source {out / f'source-{seed}'} --meshes {out / 'cad'} --units mm --seed {seed}"
    run(f"train --model forest {words} --source-cloud all --out {place}")
    run(f"predict {place} {out / 'objects'} --csv {table}")
    with table.open(encoding="utf-8", newline="") as file:
        answers = {Path(row["file"]): row["class"] for row in csv.DictReader(file)}
    found = {path.parent.name: answers[path] for path in answers if path.name == "object_000.ply"}
    return np.array([names.index(found[scene]) for scene in scenes])


def percent(right: np.ndarray) -> str:
    """Return the mean over clouds and seeds, and that of the seeds that lies lowest and highest."""
    each = 100 * right.mean(axis=1)
    return f"{each.mean():.1f} ({each.min():.1f} to {each.max():.1f})"


def main() -> None:
    parser = arguments(__doc__, "out", seeds=(0, 1, 2))
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--scans-per-mesh", type=int, default=20)
    options = parser.parse_args()
    out, seeds = options.out, options.seeds
    if not (out / "camera.json").is_file():
        make(out, options.workers)
    camera = f"--intrinsics {out / 'camera.json'}"
    run(f"segment {out / 'frames'} --out {out / 'objects'} {camera} {SEGMENT}")
    names = tuple(sorted(PARTS))
    largest = {
        path.name: read_cloud(path / "object_000.ply") for path in (out / "objects").iterdir()
    }
    found = {k: v for k, v in sorted(largest.items()) if np.ptp(v, axis=0).max() < LARGEST}
    target = describe([cleaned(cloud).astype(float) for cloud in found.values()])
    truth = np.array([names.index(scene.partition("-")[0]) for scene in found])
    source: dict[int, dict[str, np.ndarray]] = {seed: {} for seed in seeds}
    labels = np.empty(0, dtype=np.int64)
    for seed in seeds:
        place = out / f"source-{seed}"
        words = f"--scans-per-mesh {options.scans_per_mesh} --workers {options.workers}"
        run(f"generate --meshes {out / 'cad'} --out {place} {GENERATE} --seed {seed} {words}")
        for kind in SOURCES["S+C+M"]:
            scans = read_ragged(place, kind)
            assert scans.class_names == names
            assert scans.labels is not None
            source[seed][kind] = described(scans.clouds)
            labels = np.asarray(scans.labels, dtype=np.int64)
    lines = [f"| source | right % (n={len(truth)}) | {' | '.join(names)} |", "|---" * 8 + "|"]
    answers = [["source", "seed", *found], ["label", "", *truth.tolist()]]
    for name, kinds in SOURCES.items():
        expected, answered = np.tile(labels, len(kinds)), []
        for seed in seeds:
            rows = np.concatenate([source[seed][kind] for kind in kinds], axis=1)
            forest = fit_forest(rows, expected, names, seed=seed)
            answered.append(forest.predict_proba(target).argmax(axis=1))
        answers += [[name, seed, *row.tolist()] for seed, row in zip(seeds, answered, strict=True)]
        right = np.stack(answered) == truth
        each = [f"{100 * right[:, truth == k].mean():.0f}" for k in range(len(names))]
        lines.append(f"| {name} | {percent(right)} | {' | '.join(each)} |")
    first = source[seeds[0]]
    rows, expected = np.concatenate([*first.values()], axis=1), np.tile(labels, len(first))
    files = {out / "objects" / scene / "object_000.ply": cloud for scene, cloud in found.items()}
    library = Library.of_folder(out / "cad", "mm")
    lines_of_poses = ["", "| known of the place | CAD file right % | and ADD-S < 5 % | "
                      "and MSSD < 10 % | AUROC of right poses | right ones lost % | own file left "
                      "out, not lost % | CPU s per scan |", "|---" * 8 + "|"]  # fmt: skip
    places = {}
    for known in PLACES:
        places[known], seconds = compare(library, files, options.workers, known)
        shares = poses(out, library, [*found], places[known])
        lines_of_poses.append(f"| {known} | {shares} | {seconds:.2f} |")
    agreed = np.array([Seen({}, row).agreed(names) for row in places[PLACES[0]]])
    misfits = np.nan_to_num(agreed[:, :, 0], nan=1e3, posinf=1e3)
    cad = np.array([names.index(row[0].class_name) for row in places[PLACES[0]]])
    right = cad == truth
    each = [f"{100 * right[truth == k].mean():.0f}" for k in range(len(names))]
    lines.append(f"| CAD alone | {100 * right.mean():.1f} | {' | '.join(each)} |")
    answers.append(["CAD alone", "", *cad.tolist()])
    answered = [adapted(out, seed, names, [*found]) for seed in seeds]
    answers += [
        ["forest and CAD", s, *row.tolist()] for s, row in zip(seeds, answered, strict=True)
    ]
    right = np.stack(answered) == truth
    each = [f"{100 * right[:, truth == k].mean():.0f}" for k in range(len(names))]
    lines.append(f"| forest and CAD | {percent(right)} | {' | '.join(each)} |")
    areas = []
    for k in range(len(names)):
        rest, others = expected != k, names[:k] + names[k + 1 :]
        forest = fit_forest(rows[:, rest], expected[rest] - (expected[rest] > k), others)
        answer = answers_of(forest, target)
        strange = -energy(answer.logits)
        misfit = np.delete(misfits, k, axis=1)[range(len(truth)), answer.logits.argmax(axis=1)]
        both = rankdata(strange) + rankdata(misfit)
        areas.append([roc_auc_score(truth == k, score) for score in (strange, both)])
    for name, expected in zip(("", ", with CAD"), np.transpose(areas), strict=True):
        each = " | ".join(f"{area:.2f}" for area in expected)
        lines.append(f"| left out{name}: AUROC | {expected.mean():.2f} | {each} |")
    lines += lines_of_poses
    forests = [fit_forest(source[seed]["points"], labels, names, seed=seed) for seed in seeds]
    lines += ["", "| masks, S (n) | raw | extract |", "|---|---|---|"]
    lines += [bleeding(out, bleed, camera, names, forests) for bleed in BLEEDS]
    keep(options, "table", lines, answers)


def bleeding(
    out: Path, bleed: int, camera: str, names: tuple[str, ...], forests: list[Forest]
) -> str:
    """Return the line of masks that reach ``bleed`` pixels beyond the parts."""
    taken = {}
    for what, option in (("raw", "--bleed 0"), ("extract", "")):
        place = out / f"cut-{bleed}-{what}"
        words = f"--mask {out / f'masks-{bleed}'} {camera} --min-points {FEWEST} {option}"
        run(f"extract depth {out / 'frames'} --out {place} {words}")
        read = read_ragged(place, "points")
        taken[what] = dict(zip(read.ids, read.clouds, strict=True))
    both = sorted({*taken["raw"]} & {*taken["extract"]})
    truth = np.array([names.index(name.partition("-")[0]) for name in both])
    cells = [f"+{bleed} px ({len(both)})"]
    for clouds in taken.values():
        rows = describe([cleaned(clouds[name]).astype(float) for name in both])
        answers = np.stack([forest.predict_proba(rows).argmax(axis=1) for forest in forests])
        cells.append(percent(answers == truth))
    return f"| {' | '.join(cells)} |"


if __name__ == "__main__":
    main()
