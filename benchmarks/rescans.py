"""Rescans: CAD scanned again in the poses that were found in the user's scans, as more training.

Run: python benchmarks/rescans.py --shared DIR --parts OUT --table OUT --demo OUT --out out/rescans
         [--sets parts table demo] [--seeds 0 1 2] [--results DIR]

The folders are those of the shared data, of benchmarks/parts.py, of benchmarks/table_parts.py and
of ``qs3 demo``. For each scan of the target, the CAD of the likeliest classes, by forest and CAD
together, is scanned by the simulated sensor of the source: in its best pose in the scan, from the
same side, and from the same distance if that is known. The forest learns from these besides its
source; no label of the target takes part. Writes ``rescans.md`` into --results, by default results/
in --out. Intervals: 95 %, paired over scans and seeds. What is in --out is not made again.
"""

import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np
import trimesh
from common import arguments, held_out, keep, real_parts, searched, weighed
from parts import described, principal, row_of
from real import bootstrap_difference
from scipy.spatial import KDTree
from tqdm import tqdm

from qs3.clouds.files import read_cloud
from qs3.clouds.layouts.store import read_ragged
from qs3.clouds.types import CloudKind
from qs3.errors import InputError
from qs3.evaluation.metrics import class_mean_accuracy
from qs3.meshes.collections import collect
from qs3.meshes.poses import resting_poses
from qs3.parts import Forest, Library, fit_forest, locate
from qs3.parts.forest_and_cad import Fusion
from qs3.parts.loaded import cleaned
from qs3.parts.places import Place, place_of
from qs3.parts.views import Part
from qs3.parts.visible import directions, frame_of, visible
from qs3.sensor.scan import scan
from qs3.sensor.stage.stage import Streams
from qs3.store.scan_item import RECIPES, GenerateSettings, scan_seed

SOURCE: tuple[CloudKind, ...] = ("points", "clean", "surface")
TOP, LIKELY, SURE = 3, 0.02, 0.8
"""Classes of a scan that are rescanned, at most; of the second and third those with so much
probability. An answer is sure from the last on."""
FEWEST = 30
"""Points of a rescan, at least."""
NEAR = 0.006
"""Metres across the line of sight: a rescan is cut where no point of the scan is so near."""
ELEVATIONS, RIM = (10.0, 85.0), 5.0
"""Degrees: of a rescan's camera, and those by which a resting pose may miss the sensor's."""
SPLIT = "parts"
"""Scans of which one half judges what was learnt from the other, and that weigh rescans."""
JUDGED, WEIGHED = {"parts": 200, "table": 100, "demo": 100}, 80
"""Simulated scans, and rescans, that forest and CAD are weighed on."""
LEARNT = {
    "plain": "nothing",
    "control": "as many ordinary scans",
    "top1": "rescans of the likeliest class",
    "top1 sure": f"of these the sure ones, above {SURE:g}",
    "top1 cut": "rescans of the likeliest class, cut",
    "top1 cut other": "likewise, of the other half of the scans",
    "top3 by p": "rescans of three classes",
    "top3 by p cut": "rescans of three classes, cut",
    "calibrated on rescans": "nothing; weighed on rescans",
}
KINDS, SEEDS = ("forest", "fused"), (0, 1, 2)
"""What answers, and the sources that there are."""
LARGEST, SHOWN = 0.2, 2338
"""Metres of a scan on the table, and points that ``qs3 adapt`` gives the demo's simulated scans."""
HEAD = ("| scans | the forest learns besides from | forest: right % | class mean % | difference | "
        "with CAD: right % | class mean % | difference | right ones lost % |")  # fmt: skip
Lesson = tuple[np.ndarray, np.ndarray, np.ndarray]
"""Descriptors, labels and weights."""
Pair = tuple[np.ndarray, np.ndarray]
"""Noisy and clean points."""


@dataclass(frozen=True)
class Target:
    """Scans without labels, the CAD of their classes, and sources; the labels only score."""

    name: str
    out: Path
    cad: Path
    names: tuple[str, ...]
    clouds: list[np.ndarray]
    labels: np.ndarray
    places: list[Place]
    source: Callable[[int], Path]
    settings: GenerateSettings
    distance: tuple[float, float]
    """Of cameras whose place is unknown."""
    up: bool = True
    """Whether z is up; if not, scans are turned into their principal axes."""

    @cached_property
    def library(self) -> Library:
        return Library.of_folder(self.cad, "mm")

    @cached_property
    def seen(self) -> dict[str, np.ndarray]:
        """Return what the best CAD file of each class says of each scan, its pose and its name.

        ``eye`` is the camera's place, or the direction to it if that is unknown.
        """
        path, n, k = self.out / "seen-7.npz", len(self.clouds), len(self.names)
        if not path.is_file():
            pose, eye = np.full((n, k, 4, 4), np.nan), np.full((n, k, 3), np.nan)
            cads, rows = np.full((n, k), "", "U40"), []
            parts = {part.cad: part for part in self.library}
            for i, cloud in enumerate(tqdm(self.clouds, f"CAD, {self.name}")):
                found = locate(self.library, cloud, self.places[i]).candidates
                rows.append(row_of(found, self.names))
                for one in reversed(found):
                    at = i, self.names.index(one.class_name)
                    pose[at], cads[at] = one.pose, one.cad
                    camera = self.places[i].camera
                    eye[at] = sight(cloud, one.pose, parts[one.cad]) if camera is None else camera
            np.savez(path, agreed=rows, pose=pose, eye=eye, cads=cads)
        return dict(np.load(path))

    def rescan(self, seed: int, i: int, k: int) -> Pair:
        """Return noisy and clean points of the CAD of a class in its pose in scan i, in its axes.

        If up is unknown, the part lies in a resting pose that shows the camera the same side, if
        one does; the turn about the line of sight then is that pose's.
        """
        pose, eye = self.seen["pose"][i, k], self.seen["eye"][i, k]
        name = str(self.seen["cads"][i, k])
        part = next(part for part in self.library if part.cad == name)
        mesh = next(item for item in collect(self.cad) if item.id == name).load()
        code = scan_seed(seed, f"{i}-{name}", 0)
        rng = np.random.default_rng(code)
        vertices, turn = np.asarray(mesh.vertices) * part.scale, pose[:3, :3]
        is_known = self.places[i].camera is not None
        sight = turn.T @ (eye - pose[:3, 3]) - middle_of(vertices) if is_known else turn.T @ eye
        up = turn if self.up else self.lying(mesh, sight, rng)
        distance = float(np.linalg.norm(sight) if is_known else rng.uniform(*self.distance))
        x, y, z = up @ sight / np.linalg.norm(sight)
        sensor = self.settings.make_sensor()
        yaw = Streams.of(code).place.uniform(0, 2 * np.pi)  # by which the scan turns the part
        azimuth = float(np.degrees(np.arctan2(y, x) + yaw) % 360)
        placement = replace(sensor.placement, azimuth=(azimuth, azimuth))
        elevation = float(np.clip(np.degrees(np.arcsin(z)), *ELEVATIONS))
        lying = trimesh.Trimesh(vertices @ up.T, mesh.faces, process=False)
        result = scan(
            lying, self.settings, sensor=replace(sensor, placement=placement), seed=code,
            pose="upright", units="m", distance=(distance, distance),
            elevation=(elevation, elevation),
        )  # fmt: skip
        off = middle_of(lying.vertices) - np.asarray(result.mesh.bounds).mean(axis=0)
        noisy, clean = (((points + off) @ up) @ turn.T + pose[:3, 3]
                        for points in (result.points, result.clean))  # fmt: skip
        return noisy, clean

    def lying(
        self, mesh: trimesh.Trimesh, sight: np.ndarray, rng: np.random.Generator
    ) -> np.ndarray:
        """Return the turn of a resting pose whose camera has an elevation of the sensor's."""
        low, high = self.settings.make_sensor().placement.elevation
        rest = resting_poses(mesh)
        found = np.degrees(np.arcsin([np.clip(one.rotation[2] @ sight, -1, 1) for one in rest]))
        share = np.array([one.probability for one in rest])
        share *= (found >= low - RIM) & (found <= high + RIM)
        if not share.any():
            return rest[int(np.abs(found - (low + high) / 2).argmin())].rotation
        return rest[rng.choice(len(rest), p=share / share.sum())].rotation

    def rescans(self, seed: int, wanted: Sequence[tuple[int, int]]) -> "Rescans":
        """Return those that show enough; each is kept in a file."""
        folder, rows, clouds = self.out / f"rescans-{seed}", [], []
        folder.mkdir(exist_ok=True)
        for i, k in tqdm(wanted, f"rescans, {self.name}"):
            path = folder / f"{i}-{k}.npz"
            if not path.is_file():
                try:
                    points, clean = self.rescan(seed, i, k)
                except InputError as error:
                    print(f"{self.name}: {error}", file=sys.stderr)
                    points = clean = np.empty((0, 3))
                np.savez(path, points=points.astype(np.float32), clean=clean.astype(np.float32))
            held = np.load(path)
            if len(held["points"]) >= FEWEST:
                rows.append((i, k))
                clouds.append((held["points"].astype(float), held["clean"].astype(float)))
        return Rescans(self, np.array(rows), clouds)

    def features(self, clouds: Sequence[np.ndarray]) -> np.ndarray:
        """Return descriptors of clouds and of their copies, turned as the scans are."""
        whole = [np.unique(cloud, axis=0) for cloud in clouds]
        return described(whole if self.up else [principal(cloud) for cloud in whole])


class Rescans:
    """Rescans of scans ``i`` by CAD of classes ``k``, which are their labels."""

    def __init__(self, target: Target, rows: np.ndarray, clouds: list[Pair]) -> None:
        self.target, self.clouds = target, clouds
        self.i, self.k = rows.T

    @cache  # noqa: B019
    def described(self, cut: bool) -> np.ndarray:
        """Return descriptors of noisy and clean points, on the first axis; whole or cut."""
        each = zip(self.i, self.k, self.clouds, strict=True)
        pairs = [self.beside(i, k, pair) if cut else pair for i, k, pair in each]
        return np.stack([self.target.features([pair[kind] for pair in pairs]) for kind in (0, 1)])

    def beside(self, i: int, k: int, pair: Pair) -> Pair:
        """Return the points that have a point of the scan beside them in the picture."""
        eye = self.target.seen["eye"][i, k]
        if self.target.places[i].camera is not None:
            eye = eye - self.target.clouds[i].mean(axis=0)
        axes = frame_of(eye / np.linalg.norm(eye))[:, :2]
        tree = KDTree(self.target.clouds[i] @ axes)
        noisy, clean = (cloud[tree.query(cloud @ axes)[0] < NEAR] for cloud in pair)
        return (noisy, clean) if min(len(noisy), len(clean)) >= FEWEST else pair

    def lesson(self, used: np.ndarray, weights: np.ndarray, cut: bool = False) -> Lesson:
        """Return what a forest learns from the used ones, noisy and clean."""
        rows = np.flatnonzero(used)
        noisy, clean = self.described(cut)[:, :, rows]
        both = np.concatenate([noisy, clean], axis=1)
        return both, np.tile(self.k[rows], 2), np.tile(weights[rows], 2)


class Learner:
    """The forest of one seed, and what weighs it against the CAD."""

    def __init__(self, target: Target, seed: int) -> None:
        self.target, self.seed = target, seed
        found = [read_ragged(target.source(seed), kind) for kind in SOURCE]
        assert all(one.class_names == target.names for one in found)
        self.own = [target.features(one.clouds) for one in found]
        self.classes = np.asarray(found[0].labels, dtype=np.int64)
        self.scans = [cleaned(np.unique(cloud, axis=0)) for cloud in found[0].clouds]
        self.real = described(target.clouds)[0]
        self.points = [len(cloud) for cloud in target.clouds]

    def fit(self, lesson: Lesson | None = None, kept: np.ndarray | None = None) -> Forest:
        """Learn from the source, or from the kept scans of it, and from more."""
        kept = np.ones(len(self.classes), dtype=bool) if kept is None else kept
        rows = np.concatenate([one[:, kept] for one in self.own], axis=1)
        labels = np.tile(self.classes[kept], len(self.own))
        weights = np.ones(len(labels))
        if lesson is not None:
            rows = np.concatenate([rows, lesson[0]], axis=1)
            labels = np.concatenate([labels, lesson[1]])
            weights = np.concatenate([weights, lesson[2]])
        return fit_forest(rows, labels, self.target.names, weights, seed=self.seed)

    def some(self, rows: np.ndarray) -> Lesson:
        """Return noisy and clean points of scans of this source."""
        both = np.concatenate([one[:, rows] for one in self.own[:2]], axis=1)
        return both, np.tile(self.classes[rows], 2), np.ones(2 * len(rows))

    def answer(self, forest: Forest) -> np.ndarray:
        """Return the probabilities of the target by a forest."""
        return forest.predict_proba(self.real)

    def weighed(self) -> Fusion:
        """Weigh forest and CAD on simulated scans that forests did not learn from."""

        def fit(kept: np.ndarray) -> Forest:
            return self.fit(kept=kept)

        shares = held_out(fit, self.own[0][0], self.classes, self.seed)
        most = JUDGED[self.target.name]
        rows = np.sort(np.random.default_rng(0).permutation(len(self.classes))[:most])
        clouds = [self.scans[row] for row in rows]
        return self.measured(f"simulated-{self.seed}", clouds, self.classes[rows], shares[rows])

    def measured(
        self, name: str, clouds: Sequence[np.ndarray], labels: np.ndarray, shares: np.ndarray
    ) -> Fusion:
        """Weigh forest and CAD on clouds; the comparison is kept in a file."""
        path, names = self.target.out / f"compared-7-{name}.npy", self.target.names
        if not path.is_file():
            rows = [row_of(locate(self.target.library, cloud.astype(float)).candidates, names)
                    for cloud in tqdm(clouds, f"CAD, {name}")]  # fmt: skip
            np.save(path, rows)
        return weighed(names, labels, clouds, shares, np.load(path))

    def fused(self, fusion: Fusion, shares: np.ndarray) -> np.ndarray:
        """Return the probabilities of the target by forest and CAD."""
        seen = searched(shares, self.target.seen["agreed"])[:, :, :3]
        each = zip(shares, seen, self.points, strict=True)
        return np.stack([fusion.probabilities(*one) for one in each])

    def lost(self, fusion: Fusion, shares: np.ndarray) -> np.ndarray:
        """Return which scans of the target are lost."""
        off = self.target.seen["agreed"][:, :, 3]
        named = [(self.target.names[k], float(off[i, k]))
                 for i, k in enumerate(shares.argmax(axis=1))]  # fmt: skip
        return np.array([fusion.lost(*one) for one in named])


def sight(cloud: np.ndarray, pose: np.ndarray, part: Part) -> np.ndarray:
    """Return the direction to the camera whose view of the posed part agrees best with a scan."""
    local = (cloud - pose[:3, 3]) @ pose[:3, :3]
    local = local[np.random.default_rng(0).permutation(len(local))[:300]]
    tree, far, ways, costs = KDTree(local), 0.1 * part.diameter, directions(90), []
    for way in ways:
        eye = part.middle + 0.6 * way
        shown = part.points[visible(part.points, part.spacing, eye, part.middle)]
        both = tree.query(shown)[0], KDTree(shown).query(local)[0]
        costs.append(sum((np.minimum(off, far) ** 2).mean() for off in both))
    return pose[:3, :3] @ ways[int(np.argmin(costs))]


def middle_of(vertices: np.ndarray) -> np.ndarray:
    return (vertices.min(axis=0) + vertices.max(axis=0)) / 2


def answers_of(target: Target, seed: int) -> dict[str, np.ndarray]:
    """Return the probabilities of the target, by forest and by both, and who is lost."""
    path = target.out / f"answers-{seed}.npz"
    if path.is_file():
        return dict(np.load(path))
    own, found = Learner(target, seed), {}
    plain = own.fit()
    fusion, shares = own.weighed(), own.answer(plain)
    fused = own.fused(fusion, shares)
    order = np.argsort(-fused, axis=1)
    wanted = [(i, int(k)) for i, row in enumerate(order) for rank, k in enumerate(row[:TOP])
              if (not rank or fused[i, k] > LIKELY) and target.seen["cads"][i, k]]  # fmt: skip
    again = target.rescans(seed, sorted(wanted, key=lambda one: f"{one[0]}-{one[1]}.npz"))

    def put(name: str, shares: np.ndarray, weighed: Fusion) -> None:
        both = own.fused(weighed, shares)
        found[f"{name}/forest"], found[f"{name}/fused"] = shares, both
        found[f"{name}/lost"] = own.lost(weighed, both)

    put("plain", shares, fusion)
    likely = order[again.i, 0] == again.k
    ones, shares_of = np.ones(len(likely)), fused[again.i, again.k]
    rng = np.random.default_rng(seed)
    other = Learner(target, (seed + 1) % 3)
    rows = [rng.choice(np.flatnonzero(other.classes == k)) for k in again.k[likely]]
    put("control", own.answer(own.fit(other.some(np.array(rows)))), fusion)
    sure = likely & (fused[again.i].max(axis=1) > SURE)
    for name, used, cut in (
        ("top1", likely, False), ("top1 sure", sure, False), ("top1 cut", likely, True),
        ("top3 by p", ones > 0, False), ("top3 by p cut", ones > 0, True),
    ):  # fmt: skip
        weights = shares_of if name.startswith("top3") else ones
        put(name, own.answer(own.fit(again.lesson(used, weights, cut))), fusion)
    if target.name == SPLIT:
        half = np.random.default_rng(seed).permutation(len(fused)) % 2
        sides = [own.answer(own.fit(again.lesson(likely & (half[again.i] != side), ones, True)))
                 for side in (0, 1)]  # fmt: skip
        put("top1 cut other", np.where(half[:, None], sides[1], sides[0]), fusion)
        rows = np.flatnonzero(likely)[:WEIGHED]
        clouds = [cleaned(np.unique(again.clouds[row][0], axis=0)) for row in rows]
        said = plain.predict_proba(again.described(False)[0][0, rows])
        on_rescans = own.measured(f"rescans-{seed}", clouds, again.k[rows], said)
        put("calibrated on rescans", shares, on_rescans)
        found["rescans/right"] = said.argmax(axis=1) == again.k[rows]
    np.savez(path, **found)
    return found


def table_of(target: Target, seeds: Sequence[int]) -> list[str]:
    """Return a line for each way of learning."""
    found, lines = [answers_of(target, seed) for seed in seeds], []
    groups, k = np.arange(len(target.labels)), len(target.names)
    for name, text in LEARNT.items():
        if f"{name}/forest" not in found[0]:  # on `SPLIT` alone
            continue
        cells = []
        for kind in KINDS:
            said = np.stack([one[f"{name}/{kind}"].argmax(axis=1) for one in found])
            plain = np.stack([one[f"plain/{kind}"].argmax(axis=1) for one in found])
            right, before = said == target.labels, plain == target.labels
            means = [class_mean_accuracy(target.labels, row, k) for row in said]
            cells += [f"{100 * right.mean():.1f}", f"{100 * np.mean(means):.1f}"]
            off = bootstrap_difference(right, before, groups)
            cells.append("–" if name == "plain" else off.format())
        fused = np.stack([one[f"{name}/fused"].argmax(axis=1) for one in found])
        lost = np.stack([one[f"{name}/lost"] for one in found])
        cells.append(f"{100 * lost[fused == target.labels].mean():.0f}")
        lines.append(f"| {target.name} | {text} | {' | '.join(cells)} |")
    return lines


def parts(shared: Path, finished: Path, out: Path) -> Target:
    """Return the real parts: up and camera are unknown."""
    clouds, labels, names, _ = real_parts(shared)
    camera = shared / "parts" / "xtion.toml"
    settings = GenerateSettings(
        sensor=str(camera), object_size="file", units="m", scene="table", crop="mask", views=1,
        sampling="random", num_points=4096, table_cut=(0.0, 0.01),
    )  # fmt: skip
    return Target(
        "parts", out, finished / "cad", names, [cleaned(cloud).astype(float) for cloud in clouds],
        labels, [Place()] * len(clouds),
        lambda seed: finished / f"source-{seed}", settings,
        settings.make_sensor().placement.radius, up=False,
    )  # fmt: skip


def from_files(
    name: str, files: dict[str, list[Path]], cad: Path, out: Path, source: Callable[[int], Path]
) -> Target:
    """Return scans in files, by class."""
    names, paths = tuple(sorted(files)), [path for name in sorted(files) for path in files[name]]
    settings = replace(RECIPES["parts"], units="m", scene="table")
    assert settings.distance is not None
    labels = np.repeat(np.arange(len(names)), [len(files[name]) for name in names])
    return Target(
        name, out, cad, names, [cleaned(read_cloud(path)).astype(float) for path in paths], labels,
        [place_of(path) for path in paths], source, settings, settings.distance,
    )  # fmt: skip


def table(finished: Path, out: Path) -> Target:
    """Return the parts on a table: up and camera are known."""
    files: dict[str, list[Path]] = {}
    for path in sorted((finished / "objects").glob("*/object_000.ply")):
        if np.ptp(read_cloud(path), axis=0).max() < LARGEST:
            files.setdefault(path.parent.name.partition("-")[0], []).append(path)
    source = finished.joinpath
    return from_files("table", files, finished / "cad", out, lambda seed: source(f"source-{seed}"))


def demo(finished: Path, out: Path, seeds: Sequence[int]) -> Target:
    """Return the scans of another camera than the source's: up is known."""
    files: dict[str, list[Path]] = {}
    for path in sorted((finished / "scans").rglob("*.ply")):
        files.setdefault(path.parent.name, []).append(path)
    for seed in seeds:
        words = f"--recipe parts --units mm --sensor d435 --num-points {SHOWN} --workers 1"
        words += f" --meshes {finished / 'cad'} --seed {seed} --out {out / f'source-{seed}'}"
        subprocess.run([sys.executable, "-m", "qs3", "generate", *words.split()], check=True)
    found = from_files("demo", files, finished / "cad", out, lambda seed: out / f"source-{seed}")
    return replace(found, settings=replace(found.settings, num_points=SHOWN))


def main() -> None:
    parser = arguments(__doc__, "shared", "parts", "table", "demo", "out", seeds=SEEDS)
    parser.add_argument("--sets", nargs="+", default=["parts", "table", "demo"])
    given = parser.parse_args()
    makers = {
        "parts": lambda out: parts(given.shared, given.parts, out),
        "table": lambda out: table(given.table, out),
        "demo": lambda out: demo(given.demo, out, SEEDS),
    }
    lines = [HEAD, "|---" * 9 + "|"]
    for name in given.sets:
        out = given.out / name
        out.mkdir(parents=True, exist_ok=True)
        lines += table_of(makers[name](out), given.seeds)
    keep(given, "rescans", lines)


if __name__ == "__main__":
    main()
