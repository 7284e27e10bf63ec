"""ModelNet10's official split with one recipe for every network: accuracy, seeds, minutes.

Run: python benchmarks/modelnet10.py --data modelnet10_1024.npz --out runs/modelnet10
         [--networks dgcnn pointnet2 pointnet] [--seeds 0] [--points 512] [--epochs 15]

It runs the commands a user would, ``qs3 train`` and ``qs3 evaluate``. The hours are told before
the start, from a few timed steps. A run that is finished is not made again; one that was stopped
goes on. The table comes from the records of ``qs3 evaluate`` alone, which are written last; no
test label plays a part in the training or in the choice of the network (the last epoch's).
"""

import argparse
import statistics
import subprocess
import sys
import time
from pathlib import Path

import torch

from qs3.evaluation.records import RECORDS, RunRecord, read_records
from qs3.io import load_clouds
from qs3.models import create_model, list_models

RECIPE = ["--no-rotate-z", "--label-smoothing", "0.2", "--holdout", "0"]
"""All clouds stand upright and face the same way, so none is turned; smoothing is DGCNN's."""


def seconds_a_cloud(network: str, points: int, device: str, batch: int = 32) -> float:
    model = create_model(network, 10).to(device).train()
    optimiser = torch.optim.Adam(model.parameters())
    clouds = torch.randn(batch, points, 3, device=device)
    labels = torch.arange(batch, device=device) % 10
    seconds = []
    for _ in range(4):
        start = time.perf_counter()
        optimiser.zero_grad()
        torch.nn.functional.cross_entropy(model(clouds), labels).backward()
        optimiser.step()
        if device == "cuda":
            torch.cuda.synchronize()
        seconds.append((time.perf_counter() - start) / batch)
    return statistics.median(seconds[1:])


def command(*words: str) -> list[str]:
    return [sys.executable, "-m", "qs3", *words]


def run(options: argparse.Namespace, network: str, seed: int) -> RunRecord:
    folder = options.out / f"{network}-{options.points}-{options.epochs}-{seed}"
    records = folder / RECORDS
    if not records.is_file():
        given = ["--source", str(options.data), "--source-split", "train", "--out", str(folder)]
        given += ["--model", network, "--num-points", str(options.points), "--seed", str(seed)]
        given += ["--epochs", str(options.epochs), "--threads", str(options.threads), *RECIPE]
        given += ["--accelerator", options.accelerator]
        subprocess.run(command("train", *given), check=True)
        scored = command("evaluate", str(folder), "--data", str(options.data), "--split", "test")
        subprocess.run(scored, check=True)
    return read_records(records)[0][-1][1]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--networks", nargs="+", default=list_models())
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--points", type=int, default=512)
    parser.add_argument("--epochs", type=int, default=15)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--accelerator", choices=["cpu", "cuda"], default="cpu")
    options = parser.parse_args()
    torch.set_num_threads(options.threads)

    count = len(load_clouds(options.data, split="train", num_points=options.points))
    hours = {}
    for network in options.networks:
        rate = seconds_a_cloud(network, options.points, options.accelerator)
        hours[network] = rate * count * options.epochs * len(options.seeds) / 3600
        print(f"{network}: {rate * 1e3:.1f} ms a cloud, {hours[network]:.2f} h", flush=True)
    print(f"all: {sum(hours.values()):.2f} h", flush=True)

    lines = [
        f"{count} training clouds, {options.points} points, {options.epochs} epochs, "
        f"seeds {options.seeds}, {options.accelerator}, {options.threads} threads; "
        f"{' '.join(RECIPE)}",
        "",
        "| network | accuracy, % | class mean, % | by seed | minutes a run |",
        "|---|---|---|---|---|",
    ]
    for network in options.networks:
        records = [run(options, network, seed) for seed in options.seeds]
        scores = [100 * record.scores.accuracy for record in records]
        means = [100 * record.scores.class_mean_accuracy for record in records]
        minutes = [record.seconds["total"] / 60 for record in records]
        lines.append(
            f"| {network} | {statistics.mean(scores):.1f} | {statistics.mean(means):.1f} "
            f"| {', '.join(f'{score:.1f}' for score in scores)} "
            f"| {statistics.mean(minutes):.1f} |"
        )
        print("\n".join(lines), flush=True)


if __name__ == "__main__":
    main()
