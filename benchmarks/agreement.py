"""Whether Cycles and Mitsuba give the same noise: ten meshes, the same rig, poses and matching.

For each mesh: robust σ and bias of the disparity, share of valid pixels, and a two-sample test of
the distances from the cloud to the mesh (Kolmogorov–Smirnov; the statistic is the greatest
difference between the two distributions).

    QS3_SHARED_DATA=… python benchmarks/agreement.py --out agreement.json [--samples 128]

Cycles photographs the object's region with --samples rays a pixel. A mesh that the file holds
already is not measured again.
"""

import argparse
import json
import os
from pathlib import Path

import numpy as np
import trimesh
from scipy.stats import ks_2samp

from qs3.meshes import load_mesh
from qs3.sensor.render.cycles import CyclesRenderer
from qs3.sensor.render.mitsuba import MitsubaRenderer
from qs3.sensor.scan import scan

CLASSES = ("bathtub", "bed", "bookshelf", "cabinet", "chair")
CLASSES += ("lamp", "monitor", "plant", "sofa", "table")
KEYS = ("disparity_sigma", "disparity_bias", "valid_fraction", "gross_share")


def measure(path: Path, seed: int, samples: int, views: int) -> dict:
    mesh = load_mesh(path)
    result: dict = {"mesh": f"{path.parent.name}/{path.name}"}
    distances = {}
    renderers = {
        "mitsuba": MitsubaRenderer(),
        "mitsuba-path": MitsubaRenderer(indirect="path", samples=samples),
        "cycles": CyclesRenderer(samples=samples),
    }
    for name, renderer in renderers.items():
        made = scan(mesh, seed=seed, renderer=renderer, views=views)
        rows = [[getattr(view, key) for key in KEYS] for view in made.views]
        means = np.nanmean(np.array(rows, dtype=float), axis=0)
        result[name] = dict(zip(KEYS, means.tolist(), strict=True))
        _, distance, _ = trimesh.proximity.closest_point(made.mesh, made.points)
        distances[name] = distance
        result[name]["distance"] = [float(q) for q in np.quantile(distance, (0.5, 0.9))]
    for name in ("mitsuba", "mitsuba-path"):
        test = ks_2samp(distances[name], distances["cycles"])
        result[name]["ks"] = [float(test.statistic), float(test.pvalue)]
    return result


def table(rows: list[dict]) -> str:
    lines = []
    for name in ("mitsuba", "mitsuba-path"):
        lines += [
            f"\n{name} against cycles\n",
            "| mesh | σ px | σ cycles | ratio | bias − cycles px | valid − cycles | gross "
            "| gross cycles | distance median | cycles | KS statistic | p |",
            "|" + "---|" * 12,
        ]
        figures = []
        for row in rows:
            ours, theirs = row[name], row["cycles"]
            ratio = ours["disparity_sigma"] / theirs["disparity_sigma"]
            bias = ours["disparity_bias"] - theirs["disparity_bias"]
            valid = ours["valid_fraction"] - theirs["valid_fraction"]
            figures.append([ratio, bias, valid])
            lines.append(
                f"| {row['mesh']} | {ours['disparity_sigma']:.3f} | "
                f"{theirs['disparity_sigma']:.3f} | {ratio:.2f} | {bias:+.3f} | {valid:+.1%} | "
                f"{ours['gross_share']:.2%} | {theirs['gross_share']:.2%} | "
                f"{ours['distance'][0]:.4f} | {theirs['distance'][0]:.4f} | "
                f"{ours['ks'][0]:.3f} | {ours['ks'][1]:.2g} |"
            )
        ratio, bias, valid = np.array(figures).T
        good = (np.abs(ratio - 1) <= 0.15, np.abs(bias) <= 0.02, np.abs(valid) <= 0.03)
        lines.append(
            f"\nwithin 15 % in σ: {good[0].sum()} of {len(rows)}; within 0.02 px in bias: "
            f"{good[1].sum()}; within 3 points of valid pixels: {good[2].sum()}; medians "
            f"{np.median(ratio):.2f}, {np.median(bias):+.3f} px, {np.median(valid):+.1%}"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--samples", type=int, default=128)
    parser.add_argument("--views", type=int, default=2)
    options = parser.parse_args()
    root = Path(os.environ["QS3_SHARED_DATA"]) / "cad"
    rows = json.loads(options.out.read_text()) if options.out.is_file() else []
    for seed, name in enumerate(CLASSES):
        path = sorted((root / name).iterdir())[0]
        if any(row["mesh"].startswith(name) for row in rows):
            continue
        rows.append(measure(path, seed, options.samples, options.views))
        options.out.write_text(json.dumps(rows, indent=1))
        print(rows[-1]["mesh"], flush=True)
    print(table(rows))


if __name__ == "__main__":
    main()
