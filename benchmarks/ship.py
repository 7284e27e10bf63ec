"""A trained run as a network that comes with qs3: weights in half precision, and its card.

Run: python benchmarks/ship.py RUN [--out src/qs3/weights/rooms] [--records results/real]
         [--data DIR --cloud all]

Writes model.safetensors (float16), settings.json, run.json without the shapes of the clouds, and
the parts of README.md between markers; the rest of the card is written by hand. RUN may be the
folder itself, to fill in the scores of records that were made since. With --data, the source of
RUN, what is unknown to the rounded network is measured on the part of it that was held out;
else this is kept as RUN has it.
"""

import argparse
import copy
import dataclasses
from pathlib import Path
from typing import get_args

import torch

from qs3.adaptation.confidence import measure_known
from qs3.answers.to_onnx import random_clouds
from qs3.clouds.load import load_clouds
from qs3.clouds.types import CloudChoice, PointClouds
from qs3.evaluation.records import RECORDS, RunRecord, read_records
from qs3.files import write_json, write_text
from qs3.models import PointClassifier
from qs3.runs.digests import fingerprint
from qs3.runs.loaded import facts_of as facts_of_run
from qs3.runs.run import MODEL, SETTINGS, Run, read_run, train_settings, write_run
from qs3.runs.settings import Augmentation, TrainSettings
from qs3.runs.weights import read_facts, save_model
from qs3.structure import unstructure
from qs3.training.loop import count_batches
from qs3.training.predict import LoadedModel, describe, load_model, predict_probabilities
from qs3.training.prepared import prepare_clouds
from qs3.training.trainer import held_out


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    parser.add_argument("--out", type=Path, default=Path("src/qs3/weights/rooms"))
    parser.add_argument("--source", default="rooms", help="what the record calls the source")
    parser.add_argument("--records", type=Path, default=Path("results/real"))
    parser.add_argument("--data", help="source of the run, to measure what is unknown")
    parser.add_argument("--cloud", choices=get_args(CloudChoice), default="all")
    options = parser.parse_args()
    data = None
    if options.data is not None:
        data = load_clouds(options.data, cloud=options.cloud, num_points=None)
    ship(options.run, options.out, options.source, options.records, data)
    for path in sorted(options.out.iterdir()):
        print(f"{path.stat().st_size / 1e3:8.0f} kB  {path}")


def ship(
    place: Path,
    out: Path,
    source: str,
    records: Path,
    data: PointClouds | None = None,
) -> None:
    """Write the folder of a network from a run."""
    run, loaded = read_run(place), load_model(place)
    if run.target is not None:
        raise SystemExit(f"{place}: was adapted to {run.target.label}; ship what saw no target")
    settings = train_settings(place)
    facts = {"rounding": read_facts(place / MODEL).get("rounding") or rounding(loaded, settings)}
    half, known = copy.deepcopy(loaded.model).half(), loaded.known
    if data is not None:
        if fingerprint(data) != loaded.settings["source"]:
            raise SystemExit(f"{place}: was not trained on this source")
        rows = held_out(data, settings)
        held = prepare_clouds(data.select(rows), settings.num_points, settings.preparation)
        known = measure_known(describe(copy.deepcopy(half).float(), held).logits, held.labels)
    out.mkdir(parents=True, exist_ok=True)
    facts |= facts_of_run(dataclasses.replace(loaded, known=known))
    save_model(out, half, loaded.class_names, settings, facts=facts)
    write_json(out / SETTINGS, loaded.settings)
    named = dataclasses.replace(run.source, name=source)
    write_run(dataclasses.replace(run, folder=out, source=named))
    parts = {"facts": facts_of(run, loaded, facts["rounding"]), "scores": scores_of(run, records)}
    card = (out / "README.md").read_text("utf-8")
    for name, lines in parts.items():
        before, _, rest = card.partition(f"<!-- {name}: benchmarks/ship.py -->\n")
        _, end, after = rest.partition(f"<!-- end of {name} -->")
        card = "\n".join([f"{before}<!-- {name}: benchmarks/ship.py -->", *lines, end + after])
    write_text(out / "README.md", card)


def rounding(loaded: LoadedModel, settings: TrainSettings) -> dict[str, float]:
    """Largest difference of a probability that half precision makes, over random clouds."""
    rounded: PointClassifier = copy.deepcopy(loaded.model).half().float()
    if not all(torch.isfinite(value).all() for value in rounded.state_dict().values()):
        raise SystemExit("a weight is too large for half precision")
    preparation = dataclasses.replace(settings.preparation, remove_outliers=False, redraw=False)
    clouds = random_clouds(settings.num_points)
    before, after = (
        predict_probabilities(model, clouds, preparation=preparation)
        for model in (loaded.model, rounded)
    )
    differences = abs(after - before).max(axis=1)
    return {"clouds": len(differences), "largest": float(differences.max())}


def facts_of(run: Run, loaded: LoadedModel, moved: dict[str, float]) -> list[str]:
    """Lines of what was trained, how and on how much."""
    train = loaded.settings["train"]
    count = sum(value.numel() for value in loaded.model.parameters())
    default = unstructure(Augmentation())
    on = {name: one for name, one in train["augmentation"].items() if one != default[name]}
    steps = train["epochs"] * count_batches(
        round(run.source.clouds * (1 - train["holdout"])), train["batch_size"]
    )
    plain = ("model_settings", "preparation", "batch_size", "learning_rate")
    plain += ("weight_decay", "label_smoothing", "holdout", "rotate_z", "jitter_sigma")
    return [
        "| | |",
        "|---|---|",
        f"| classes | {', '.join(loaded.class_names)} |",
        f"| network | {train['model']}, {count / 1e6:.2f} million parameters, "
        f"{train['num_points']} points per cloud |",
        f"| method | {run.method}; network of the last epoch |",
        f"| source | {run.source.clouds} clouds ({run.source.cloud}), "
        f"SHA-256 `{run.source.checksum[:16]}…` |",
        f"| training | {train['epochs']} epochs, some {steps} steps, seed {train['seed']} |",
        *(f"| `{name}` | {worded(train[name])} |" for name in plain),
        f"| `augmentation` | {worded(on)} |",
        f"| half precision | moves a probability by at most {moved['largest']:.1e} on "
        f"{moved['clouds']} random clouds |",
    ]


def worded(value: object) -> str:
    if isinstance(value, dict):
        return ", ".join(f"{name} {one}" for name, one in value.items()) or "default"
    return str(value)


def scores_of(run: Run, folder: Path) -> list[str]:
    """Lines of the scores of this run, by record; they are those before the rounding."""
    lines = []
    for record in found(run, folder):
        scores = record.scores
        low, high = scores.interval
        part = str((record.experiment or {}).get("part", ""))
        lines.append(
            f"| {record.test.label} {f'({part})' if part else ''} | {scores.clouds} "
            f"| {scores.accuracy:.1%} ({low:.0%} to {high:.0%}) "
            f"| {scores.class_mean_accuracy:.1%} |"
        )
    if not lines:
        return [f"No record of this run is in `{folder.name}` yet."]
    head = "| data | clouds | accuracy (95 % interval) | class mean |"
    return [head, "|---|---|---|---|", *lines]


def found(run: Run, folder: Path) -> list[RunRecord]:
    """Records of the same training (method, source and all settings) on data new to it."""

    def same(record: RunRecord) -> bool:
        one, other = record.settings["train"], unstructure(run.settings["train"])
        seen = record.method != run.method or "training clouds" in record.marks
        return not seen and record.source.checksum == run.source.checksum and one == other

    path = folder / RECORDS
    pairs = read_records(path)[0] if path.is_file() else []
    return [record for _, record in pairs if same(record)]


if __name__ == "__main__":
    main()
