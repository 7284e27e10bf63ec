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

from qs3.cli.evaluate import make_record
from qs3.cli.train import RUN, TrainOptions, run
from qs3.evaluation import mean_sem
from qs3.training import TrainSettings, self_training_preset

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
        plans = {
            f"source-only, {name}": TrainOptions(
                source=str(options.data),
                out=options.runs / f"{name}-{seed}",
                source_cloud=cloud,  # pyright: ignore[reportArgumentType]
                train=settings,
            )
            for name, cloud in CLOUDS.items()
        }
        for preset in ("default", "paper"):
            plans[f"QBST, S, {preset}"] = TrainOptions(
                source=str(options.data),
                out=options.runs / f"qbst-{preset}-{seed}",
                method="qbst",
                target=str(options.real),
                warm_up=options.runs / f"S-{seed}",
                preset=preset,
                train=settings,
                self_training=self_training_preset(preset),
            )
        for name, plan in plans.items():
            if not (plan.out / RUN).is_file():
                run(plan)
            record, _ = make_record(plan.out, options.real)
            scores = record.scores
            results.setdefault(name, []).append((scores.accuracy, scores.class_mean_accuracy))
            kept = [sum(r["kept"]) for r in record.rounds]
            note = f", kept by round {kept}" if kept else ""
            print(f"{name}, seed {seed}: {scores.accuracy:.1%}{note}", flush=True)
    print("\n| training | accuracy | class mean | n |\n|---|---|---|---|")
    for name, rows in results.items():
        cells = []
        for values in zip(*rows, strict=True):
            found = mean_sem([100 * v for v in values])
            cells.append(f"{found.mean:.1f}" + (f" ± {found.sem:.1f}" if found.sem else ""))
        print(f"| {name} | {' | '.join(cells)} | {len(rows)} |")


if __name__ == "__main__":
    main()
