"""Foreign things and touching pairs on a table: how many are lost, and how many known parts.

Run: python benchmarks/strange.py --table DIR --out out/strange [--seeds 0 1 2]

DIR is the --out of ``table_parts.py``: its scans of known parts, its CAD and its runs, one for each
seed, whose simulated camera is noisier than that of the table. Simple things of kinds that no part
is of, and pairs of the parts side by side of which each is well seen, are photographed alike and
cut out by ``qs3 segment``. All clouds are answered with the limit that the run measured on
simulated scans, and with that which ``qs3 adapt`` tightens on the known parts' scans, without their
labels. The last column has no limit of the product: it moves that of ``adapt`` until 5 % of the
known parts are lost, and says how far the disagreement separates the kinds.
"""

import json
from pathlib import Path
from shutil import copytree

import cv2
import numpy as np
import trimesh
from common import arguments, camera_of, keep
from scenes import foreign
from table_parts import FOCAL, HEIGHT, PARTS, SEGMENT, WIDTH, run, see

from qs3.answers.answer import Answer
from qs3.answers.classifier import Classifier
from qs3.answers.cloud_files import read_each
from qs3.answers.deviating import answer_within
from qs3.runs.loaded import Loaded

THINGS, VIEWS, PAIRS = 5, 2, 60
"""Sets of foreign things, views of each, and touching pairs."""
SEEN = 0.15
"""Share of the pixels that each part of a pair has."""


def lying(mesh: trimesh.Trimesh, rng: np.random.Generator) -> trimesh.Trimesh:
    """Return a mesh in a likely pose on the table, turned at random."""
    mesh = mesh.copy()
    poses, shares = trimesh.poses.compute_stable_poses(mesh)
    if len(poses):  # a ball has none
        mesh.apply_transform(poses[rng.choice(len(poses), p=shares / shares.sum())])
    turn = trimesh.transformations.rotation_matrix(rng.uniform(0, 2 * np.pi), (0, 0, 1))
    mesh.apply_transform(turn)
    return mesh.apply_translation((0, 0, -mesh.bounds[0, 2]))


def pair(rng: np.random.Generator) -> tuple[trimesh.Trimesh, int]:
    """Return two parts side by side, in metres, and the number of faces of the first."""
    both = []
    for name in rng.choice(sorted(PARTS), 2):
        solids = PARTS[name][rng.integers(len(PARTS[name]))]
        both.append(lying(trimesh.util.concatenate(solids).apply_scale(1e-3), rng))
    one, other = both
    aside = other.bounds.mean(axis=0)[1] - one.bounds.mean(axis=0)[1]
    other.apply_translation((one.bounds[1, 0] - other.bounds[0, 0], -aside, 0))
    return trimesh.util.concatenate(both), len(one.faces)


def make(out: Path) -> None:
    """Write frames of foreign things and of touching pairs, and cut them."""
    frames = out / "frames"
    frames.mkdir(parents=True)

    def write(name: str, image: np.ndarray) -> None:
        (frames / f"{name}.png").write_bytes(cv2.imencode(".png", image)[1].tobytes())

    for seed in range(THINGS):
        for name, mesh in foreign(seed).items():
            for view in range(VIEWS):
                rng = np.random.default_rng([seed, view, *name.encode()])
                write(f"{name}-{seed}-{view}", see(lying(mesh, rng), rng)[0])
    number = kept = 0
    while kept < PAIRS:
        rng = np.random.default_rng([THINGS, number])
        mesh, first = pair(rng)
        image, _, faces = see(mesh, rng)
        share = np.mean(faces[(faces >= 0) & (image > 0)] < first)
        if SEEN < share < 1 - SEEN:
            write(f"pair-{kept}", image)
            kept += 1
        number += 1
    (out / "camera.json").write_text(json.dumps(camera_of(WIDTH, HEIGHT, FOCAL)))
    words = f"--intrinsics {out / 'camera.json'} {SEGMENT}"
    run(f"segment {frames} --out {out / 'objects'} {words}")


def margin(model: Loaded, answer: Answer) -> float:
    """Return by how much a cloud disagrees more than the limit of lost allows, in logarithms."""
    assert model.witness is not None
    if answer.found is None or answer.place is None:
        return np.inf
    fusion = model.witness.fusion_for(answer.place)
    assert fusion.worst is not None
    if answer.found.visible < fusion.shown or np.isinf(answer.found.disagreement):
        return np.inf
    return fusion.excess(answer.found.class_name, answer.found.disagreement) - fusion.worst


def main() -> None:
    parser = arguments(__doc__, "out", seeds=(0, 1, 2))
    parser.add_argument("--table", type=Path, required=True)
    options = parser.parse_args()
    out = options.out
    if not (out / "objects").is_dir():
        make(out)
    kinds: dict[str, list[Path]] = {"known parts": [], "foreign things": [], "touching pairs": []}
    for folder in sorted([*(options.table / "objects").iterdir(), *(out / "objects").iterdir()]):
        objects = sorted(folder.glob("object_*.ply"))
        known = folder.parent.parent == options.table
        word = folder.name.split("-")[0]
        kind = "known parts" if known else "touching pairs" if word == "pair" else "foreign things"
        if known or len(objects) == 1:  # else the pair was cut into its parts
            kinds[kind] += objects[:1]
    paths = [path for some in kinds.values() for path in some]
    lost = np.zeros((len(options.seeds), 3, len(paths)), bool)
    kind_of = np.array([kind for kind, some in kinds.items() for _ in some])
    for row, seed in zip(lost, options.seeds, strict=True):
        model = Classifier.load(options.table / f"run-{seed}")._loaded
        known, place = [*read_each(kinds["known parts"])], out / f"run-{seed}"
        copytree(options.table / f"run-{seed}", place, dirs_exist_ok=True)
        answer_within(model, known, 0.0, camera=True)[1].save(place)
        adapted = Classifier.load(place)._loaded
        answers = []
        for k, one in enumerate((model, adapted)):
            answers = answer_within(one, [*read_each(paths)], 0.0)[0]
            row[k] = [each.lost for each in answers]
        margins = np.array([margin(adapted, each) for each in answers])
        ranked = np.sort(margins[kind_of == "known parts"])
        row[2] = margins > ranked[int(0.95 * len(ranked))]
    lines = ["| clouds (n) | lost by the simulated limit % | lost by the limit of `adapt` % | "
             "lost where 5 % of the known parts are % |",
             "|---|---|---|---|"]  # fmt: skip
    for kind, some in kinds.items():
        cells = []
        for k in range(3):
            each = 100 * lost[:, k, kind_of == kind].mean(axis=1)
            cells.append(f"{each.mean():.1f} ({each.min():.1f} to {each.max():.1f})")
        lines.append(f"| {kind} ({len(some)}) | {' | '.join(cells)} |")
    keep(options, "strange", lines)


if __name__ == "__main__":
    main()
