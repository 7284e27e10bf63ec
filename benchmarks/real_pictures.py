"""Real objects that self-training mended, and such that it broke, side by side.

Run: python benchmarks/real_pictures.py --out runs/real --shared DIR [--first rooms]
         [--second "rooms QBST average"] [--seed 0] [--picture docs/images/mended.png]

Two runs of `benchmarks/real.py` answer to NYU's objects of the first 70 % of the frames. Of those
that the second alone has right ten are drawn, evenly spaced in the order of filming, and ten that
the first alone has right.
"""

import argparse
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from real import parts

from qs3.report.clouds import draw_cloud
from qs3.training import load_model, predict_probabilities

SHOWN = 10


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--shared", type=Path, required=True)
    parser.add_argument("--first", default="rooms")
    parser.add_argument("--second", default="rooms QBST average")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--picture", type=Path, default=Path("docs/images/mended.png"))
    options = parser.parse_args()
    clouds = parts(options.shared)["dev"]
    answers = []
    for cell in (options.first, options.second):
        loaded = load_model(options.out / f"{cell}-{options.seed}")
        assert loaded.class_names == clouds.class_names
        answers.append(predict_probabilities(loaded, clouds.points).argmax(axis=1))
    first, second = answers
    right = [given == clouds.labels for given in answers]
    groups = {"mended": right[1] & ~right[0], "broken": right[0] & ~right[1]}
    figure = Figure(figsize=(14, 6.6), layout="constrained")
    axes = figure.subplots(4, SHOWN // 2)
    for place, (name, rows) in enumerate(groups.items()):
        found = np.flatnonzero(rows)
        print(f"{name}: {len(found)} of {len(clouds)}")
        shown = found[np.linspace(0, len(found) - 1, min(SHOWN, len(found))).astype(int)]
        for number, row in enumerate(shown):
            spot = axes[2 * place + number // 5, number % 5]
            draw_cloud(spot, np.asarray(clouds.points[row], np.float64), 30.0, 20.0)
            true, before, after = (
                clouds.class_names[label] for label in (clouds.labels[row], first[row], second[row])
            )
            spot.set_title(f"{name}: {true}\n{before} → {after}", fontsize=9)
    for spot in axes.flat:
        spot.set_axis_off()
    options.picture.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(options.picture, dpi=80)


if __name__ == "__main__":
    main()
