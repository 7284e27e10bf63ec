"""``qs3 train`` with methods of adaptation, and every checkpoint's score."""

import contextlib
import json
from pathlib import Path

import numpy as np
import pytest

from qs3.cli.train import defaults, parse_settings
from qs3.clouds.load import load_clouds, load_unlabelled
from qs3.errors import InputError
from qs3.evaluation.records import RECORDS, read_records
from qs3.files import write_json
from qs3.meshes.classes import POINTDA10
from qs3.models import create_model
from qs3.runs import PRESETS, Augmentation, TrainSettings, save_model
from qs3.runs.run import RunSettings
from qs3.structure import structure, unstructure
from qs3.training import fit

from .conftest import do

pytestmark = pytest.mark.filterwarnings("ignore::qs3.adaptation.SingleClassWarning")
EXAMPLES = Path(__file__).parents[2] / "examples" / "methods"
QUICK = ("--model", "pointnet", "--model-set", "channels=[8, 8, 16]", "hidden=[8]", "--num-points",
         64, "--batch-size", 5, "--threads", 1, "--accelerator", "cpu", "--epochs", 2,
         "--validate-every", 1, "--holdout", 0.2)  # fmt: skip


@pytest.fixture(scope="module")
def source(tmp_path_factory):
    """Four clouds of each class, so that some can be held out."""
    path = tmp_path_factory.mktemp("source") / "source.npz"
    points = np.random.default_rng(0).normal(size=(40, 80, 3))
    np.savez(path, points=points, label=np.arange(40) % 10, class_names=np.array(POINTDA10))
    return path


@pytest.fixture(scope="module")
def adapted(store, source, tmp_path_factory):
    run = tmp_path_factory.mktemp("runs") / "dann"
    with contextlib.chdir(EXAMPLES):  # where the module dann lies
        do("train", "--source", source, "--target", store, "--out", run, "--method", "dann:DANN",
           "--method-set", "hidden=[8]", "gamma=5", "--self-training", "qbst",
           "--self-training.rounds", 2, "--self-training.epochs", 1, "--rule", "source-val",
           *QUICK, code=4)  # fmt: skip  # ten clouds are too few for a round
    return run


def test_a_method_its_settings_and_rounds_after_it(adapted):
    settings = json.loads((adapted / "settings.json").read_text())
    assert settings["method"] == "dann:DANN"
    assert settings["train"]["method_settings"] == {"hidden": [8], "gamma": 5}
    assert settings["train"]["model_settings"] == {"channels": [8, 8, 16], "hidden": [8]}
    assert settings["self_training"]["rule"] == "qbst"
    facts = json.loads((adapted / "run.json").read_text())
    assert (facts["method"], facts["selection"], facts["preset"]) == (
        "dann:DANN+qbst",
        "source-val",
        "gentle",
    )
    assert len(facts["target_clouds"]) == 10
    names = sorted(path.name for path in (adapted / "checkpoints").iterdir())
    rounds, warm_up = (["round-0000", "round-0001", "round-0002"], ["warm-up-0001", "warm-up-0002"])
    assert names == [f"{name}.safetensors" for name in rounds + warm_up]


def test_rounds_with_all_switches_after_a_method(typed, source, tmp_path):
    """From the command line to the record; Python makes the same bits."""
    run = tmp_path / "run"
    typed("train", "--source", source, "--target", source, "--out", run, "--method", "pcm",
          "--self-training", "qbst",
          "--self-training.rounds", 2, "--self-training.epochs", 1, "--self-training.teacher",
          "average", "--self-training.threshold-share", 0.8, *QUICK,
          "--epochs", 1, "--no-remove-outliers", "--radius-share", 1, "--no-redraw")  # fmt: skip
    done = typed("evaluate", run, "--data", source)
    assert "checkpoint          round 2, by rule last" in done.stdout
    assert "known here" in done.stdout
    record = read_records(run / RECORDS)[0][0][1]
    assert record.method == "pcm+qbst"
    assert record.chosen == {"stage": "round", "number": 2}
    for round_ in record.rounds:
        assert not round_["skipped"]
        assert round_["known"] == round_["kept"]
        assert sum(round_["right"]) <= sum(round_["known"])
    settings = structure(json.loads((run / "settings.json").read_text()), RunSettings, run)
    again = tmp_path / "again"
    fit("pcm", load_clouds(source, num_points=None), load_unlabelled(source, num_points=None),
        settings.train, settings.self_training, run_dir=again, preset="gentle")  # fmt: skip
    weights = [(folder / "model.safetensors").read_bytes() for folder in (run, again)]
    assert weights[0] == weights[1]


def test_a_run_whose_rounds_were_all_skipped_says_what_to_change(typed, source, tmp_path):
    run = tmp_path / "run"
    command = ("train", "--source", source, "--target", source, "--out", run, "--method", "qbst",
               "--preset", "default", "--self-training.rounds", 2, "--self-training.step", 0,
               "--self-training.threshold", 0.98, *QUICK)  # fmt: skip
    for _ in range(2):  # the same command again finds the same
        done = typed(*command, code=4)
        assert done.stdout == f"{run}\n"
        last = done.stderr.rstrip().splitlines()[-1]
        assert last.startswith("qs3: all 2 rounds were skipped, as they kept 0 of 40 clouds")
        assert "lower --self-training.threshold, give --self-training.threshold-share" in last
        assert "Next:" not in done.stderr
    assert all(round_["skipped"] for round_ in json.loads((run / "run.json").read_text())["rounds"])
    typed("evaluate", run, "--data", source)


def test_source_only_looks_at_a_target_without_learning_from_it(typed, store, source, tmp_path):
    weights = []
    for name, target in {"with": ("--target", store), "without": ()}.items():
        run = tmp_path / name
        typed("train", "--source", source, *target, "--out", run, *QUICK)
        weights.append((run / "model.safetensors").read_bytes())
        lines = [json.loads(line) for line in (run / "history.jsonl").read_text().splitlines()]
        accuracies = [line["source_accuracy"] for line in lines if line["kind"] == "checkpoint"]
        assert accuracies and all(0 <= right <= 1 for right in accuracies)
        assert json.loads((run / "run.json").read_text())["target_clouds"] == []
    assert weights[0] == weights[1]


def test_settings_are_json_or_words():
    deep = "[" * 100_000
    assert parse_settings("--x", [f"a={deep}", "b=NaN"]) == {"a": deep, "b": "NaN"}
    settings = parse_settings("--x", ["a=1.5", "b=true", "c=[1, 2]", "d=voxels", "e="])
    assert settings == {"a": 1.5, "b": True, "c": [1, 2], "d": "voxels", "e": ""}
    with pytest.raises(InputError, match="--x a=2: give each setting once"):
        parse_settings("--x", ["a=1", "a=2"])


@pytest.mark.parametrize(
    ("arguments", "preset"),
    [
        ([], "default"),
        (["--method", "qbst"], "gentle"),
        (["--method=spst"], "spst"),
        (["--method", "gast-spst"], "spst"),
        (["--method", "gast", "--self-training", "spst"], "spst"),
        (["--method", "gast", "--self-training", "qbst"], "gentle"),
        (["--method", "qbst", "--preset", "paper"], "paper"),
        (["--method", "qbst", "--source", "a", "--warm-up", "rooms"], "gentle"),
        (["--method", "spst", "--source", "a", "--warm-up", "rooms"], "spst"),
    ],
)
def test_a_preset_follows_the_method(arguments, preset):
    chosen = defaults(arguments)["options"]
    assert chosen.preset == preset
    assert chosen.self_training == PRESETS[preset]


@pytest.mark.parametrize("preset", ["paper", "released", "gentle"])
def test_the_papers_presets_augment_nothing_whatever_the_warm_up_did(preset):
    words = ["--method", "qbst", "--warm-up", "rooms", "--preset", preset]
    train = defaults(words)["options"].train
    assert (train.augmentation == Augmentation()) == (preset != "gentle")
    assert train.preparation.size_input  # without which the network is another one


def test_what_a_warm_up_tells_of_its_training_is_the_default(tmp_path):
    settings = TrainSettings(
        model="pointnet",
        model_settings={"channels": [4, 4, 8]},
        num_points=32,
        epochs=3,
        learning_rate=0.5,
    )
    network = create_model("pointnet", 10, channels=[4, 4, 8])
    save_model(tmp_path, network, POINTDA10, settings)
    write_json(
        tmp_path / "settings.json", unstructure(RunSettings("source-only", settings, POINTDA10))
    )
    bare = tmp_path / "bare" / "weights.safetensors"
    bare.parent.mkdir()
    bare.write_bytes((tmp_path / "model.safetensors").read_bytes())
    for warm_up, rate in ((tmp_path, 0.5), (tmp_path / "model.safetensors", 0.5), (bare, 1e-3)):
        words = ["--source", "a", "--method", "qbst", "--warm-up", str(warm_up)]
        train = defaults(words)["options"].train
        assert (train.model, train.num_points, train.learning_rate) == ("pointnet", 32, rate)
        assert train.model_settings == {"channels": [4, 4, 8]}
