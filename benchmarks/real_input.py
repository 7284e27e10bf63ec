"""Artists' CAD meshes in, real depth-camera objects out: source-only, controls, and QBST.

    qs3 generate --meshes $QS3_SHARED_DATA/cad --scans-per-mesh 8 --out DATA
    python benchmarks/real_input.py DATA $QS3_SHARED_DATA/sunrgbd_objects.npz RUNS

Trains a ten-class DGCNN on (S) the noisy scans, (C) their clean twins and (M) samples of the whole
surface, jittered alike; adapts S to the unlabelled real objects (transductive) with our defaults
and with `--preset paper`; scores everything on the real objects and prints mean ± SEM over seeds
from the records. Finished runs are not repeated.
"""

import argparse
from pathlib import Path

from qs3.evaluation import mean_sem
from qs3.io import load_clouds, load_unlabelled
from qs3.training import TrainSettings, evaluate, fit, load_whole, self_training_preset

CLOUDS = {"S": "points", "C": "clean", "M": "surface"}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("data", type=Path)
    parser.add_argument("real", type=Path)
    parser.add_argument("runs", type=Path)
    parser.add_argument("--epochs", type=int, default=15)
    parser.add_argument("--num-points", type=int, default=512)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    parser.add_argument("--threads", type=int, default=None)
    parser.add_argument("--model", default="dgcnn")
    options = parser.parse_args()
    results: dict[str, list[tuple[float, float]]] = {}
    for seed in options.seeds:
        settings = TrainSettings(
            model=options.model,
            num_points=options.num_points,
            epochs=options.epochs,
            seed=seed,
            threads=options.threads,
        )
        count = options.num_points
        for name in (*CLOUDS, "default", "paper"):
            rounds = name not in CLOUDS
            run = options.runs / (f"qbst-{name}-{seed}" if rounds else f"{name}-{seed}")
            if not (run / "run.json").is_file():
                cloud = "points" if rounds else CLOUDS[name]
                fit(
                    "qbst" if rounds else "source-only",
                    load_whole(load_clouds, options.data, count, cloud=cloud),
                    load_whole(load_unlabelled, options.real, count) if rounds else None,
                    settings,
                    self_training_preset(name) if rounds else None,
                    run_dir=run,
                    warm_up=options.runs / f"S-{seed}" if rounds else None,
                    preset=name if rounds else None,
                )
            record = evaluate(run, options.real)
            scores = record.scores
            title = f"QBST, S, {name}" if rounds else f"source-only, {name}"
            results.setdefault(title, []).append((scores.accuracy, scores.class_mean_accuracy))
            kept = [sum(r["kept"]) for r in record.rounds]
            note = f", kept by round {kept}" if kept else ""
            print(f"{title}, seed {seed}: {scores.accuracy:.1%}{note}", flush=True)
    print("\n| training | accuracy | class mean | n |\n|---|---|---|---|")
    for name, rows in results.items():
        cells = []
        for values in zip(*rows, strict=True):
            found = mean_sem([100 * v for v in values])
            cells.append(f"{found.mean:.1f}" + (f" ± {found.sem:.1f}" if found.sem else ""))
        print(f"| {name} | {' | '.join(cells)} | {len(rows)} |")


if __name__ == "__main__":
    main()
