"""The weights of `qs3.parts.scenes.confidence`, fitted on scenes of parts that judge nothing.

Run: python benchmarks/confidence.py --out out/confidence

Parts apart, touching pairs and heaps of the third CAD file of each class of `table_parts` and of
qs3's own eight shapes in other sizes, and of four of these each in two sizes that are hardly told
apart, and the third files once more among foreign things, which no CAD file is of: the parts and
things of ``benchmarks/scenes.py`` are others. A part is right if its class is right and
ADD-S is below a tenth of its diameter. Prints the weights to copy, and, with scenes left out in
turn, precision and kept right parts at the least score, and the calibration error of each kind.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import trimesh
from scenes import BIN, NEAR, foreign, keep_cad, make, reliability, solids
from scenes import KINDS as ALL
from sklearn.linear_model import LogisticRegression
from sklearn.metrics import log_loss, roc_auc_score
from sklearn.model_selection import GroupKFold, cross_val_predict
from table_parts import FOCAL, HEIGHT, WIDTH

from qs3 import shapes
from qs3.evaluation.poses import adds
from qs3.frames.images import read_depth
from qs3.frames.intrinsics import Intrinsics
from qs3.objects.segment import SegmentSettings
from qs3.parts import Library
from qs3.parts.scenes.confidence import FEATURES, features
from qs3.parts.scenes.found import GAP, FindSettings
from qs3.parts.scenes.picture import picture_of
from qs3.parts.scenes.searching import chosen_in

KINDS = tuple(kind for kind in ALL if kind != BIN)
THIRD = {"bolt": 0, "flange": 2, "bracket": 1, "gear": 2, "housing": 2, "elbow": 1}
SHAPE_SEED, SIZES = 11, (0.65, 1.15)
"""Seed of the shapes, and the least and largest factor of their sizes."""
TWIN_SEED, TWINS = 12, (0.8, 0.9)
"""The same of pairs of shapes, whose classes are often a toss-up."""
FOREIGN_SEED = 13
"""The same of foreign things."""
CAMERA = Intrinsics(FOCAL, FOCAL, (WIDTH - 1) / 2, (HEIGHT - 1) / 2, WIDTH, HEIGHT)


def meshes_of_shapes() -> dict[str, trimesh.Trimesh]:
    rng = np.random.default_rng(7)
    return {
        name: shapes.make(name, SHAPE_SEED).apply_scale(rng.uniform(*SIZES))
        for name in shapes.PARTS
    }


def twins() -> dict[str, trimesh.Trimesh]:
    """Return four shapes, each in two sizes that are hardly told apart."""
    return {
        f"{name}{k}": shapes.make(name, TWIN_SEED).apply_scale(size)
        for name in shapes.PARTS[::2]
        for k, size in enumerate(TWINS)
    }


def rows(
    out: Path,
    meshes: dict[str, trimesh.Trimesh],
    kind: str,
    first: int,
    count: int,
    strange: dict[str, trimesh.Trimesh],
) -> tuple:
    """Return features, whether each part is right, and the number of its scene and kind.

    What is ``strange`` lies among the parts, and is no part of the library.
    """
    keep_cad(out / "cad", meshes)
    library, settings = Library.of_folder(out / "cad", "mm"), FindSettings()
    cut = SegmentSettings(gap=GAP, min_points=settings.min_points)
    points = {name: trimesh.sample.sample_surface(m, 1500, seed=0)[0] for name, m in meshes.items()}
    found, right, scene = [], [], []
    for number in range(first, first + count):
        path = out / kind / f"{number:06d}.json"
        if not path.is_file():
            make(out, meshes | strange, kind, number)
        depth = read_depth(out / kind / "depth" / f"{number:06d}.png", 1e-4)
        picture = picture_of(depth, CAMERA, cut)
        left, chosen = json.loads(path.read_text()), chosen_in(library, picture, settings)
        for h in sorted(chosen, key=lambda h: -h.value):
            name = h.part.class_name
            near = NEAR * float(np.linalg.norm(meshes[name].extents))
            errors = [adds(h.pose, np.array(t["pose"]), points[name]) if t["class"] == name
                      else np.inf for t in left]  # fmt: skip
            right.append(bool(min(errors, default=np.inf) < near))
            if right[-1]:
                del left[int(np.argmin(errors))]
            found.append(features(h, chosen, picture))
            scene.append(number + 1000 * KINDS.index(kind))
    return np.array(found), np.array(right), np.array(scene)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--scenes", type=int, default=24)
    options = parser.parse_args()
    sets = [
        rows(options.out / name, meshes, kind, first, options.scenes, strange)
        for name, meshes, first, strange in (
            ("third", solids(THIRD, None), 200, {}),
            ("shapes", meshes_of_shapes(), 300, {}),
            ("twins", twins(), 400, {}),
            ("foreign", solids(THIRD, None), 500, foreign(FOREIGN_SEED)),
        )
        for kind in KINDS
    ]
    x, y, scene = (np.concatenate(columns) for columns in zip(*sets, strict=True))
    model = LogisticRegression(C=10.0, max_iter=5000)
    apart = GroupKFold(6)
    p = cross_val_predict(model, x, y, groups=scene, cv=apart, method="predict_proba")[:, 1]
    model.fit(x, y)
    kept = p >= FindSettings().least_score
    print(f"{len(y)} parts, {y.mean():.1%} right; AUROC {roc_auc_score(y, p):.3f}, "
          f"log loss {log_loss(y, p):.3f}; at the least score precision {y[kept].mean():.1%}, "
          f"{kept[y].mean():.1%} of the right ones")  # fmt: skip
    for k, kind in enumerate(KINDS):
        of_fold = scene // 1000 == k
        print(kind, reliability(p[of_fold & kept].tolist(), y[of_fold & kept].tolist()), sep="\n")
    print("WEIGHTS =", tuple(np.round(model.coef_[0], 2).tolist()), "# of", FEATURES)
    print("BIAS =", round(float(model.intercept_[0]), 2))


if __name__ == "__main__":
    main()
