"""``qs3 train`` with methods of adaptation, and every checkpoint's score."""

import json

import numpy as np
import pytest
import tyro

from qs3.cli.train import TrainOptions, _note_old_name, defaults, parse_settings
from qs3.errors import InputError
from qs3.evaluation import read_record
from qs3.meshes.classes import POINTDA10
from qs3.training import PRESETS

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
def adapted(qs3, store, source, tmp_path_factory):
    run = tmp_path_factory.mktemp("runs") / "dann"
    qs3("train", "--source", source, "--target", store, "--out", run, "--method", "dann",
        "--method-set", "hidden=[8]", "gamma=5", "--self-training", "qbst",
        "--self-training.rounds", 2, "--self-training.epochs", 1, "--rule", "im",
        *QUICK)  # fmt: skip
    return run


def test_a_method_its_settings_and_rounds_after_it(adapted):
    settings = json.loads((adapted / "settings.json").read_text())
    assert settings["method"] == "dann"
    assert settings["train"]["method_settings"] == {"hidden": [8], "gamma": 5}
    assert settings["train"]["model_settings"] == {"channels": [8, 8, 16], "hidden": [8]}
    assert settings["self_training"]["rule"] == "qbst"
    told = json.loads((adapted / "run.json").read_text())
    assert (told["method"], told["selection"], told["preset"]) == ("dann+qbst", "im", "default")
    assert len(told["target_clouds"]) == 10
    names = sorted(path.name for path in (adapted / "checkpoints").iterdir())
    rounds, warm_up = (["round-0001", "round-0002"], ["warm-up-0001", "warm-up-0002"])
    assert names == [f"{name}.safetensors" for name in rounds + warm_up]


def test_every_validators_choice_is_scored_and_the_oracle_stands_apart(qs3, adapted, store):
    done = qs3("evaluate", adapted, "--data", store, "--checkpoints")
    assert "chosen by" in done.stdout
    assert "* looks at the labels of this data: an upper bound" in done.stdout
    record = read_record(next((adapted / "records").glob("*.json")))
    assert set(record.choices) >= {"last", "source-val", "im", "snd", "dev", "oracle"}
    assert record.choices["im"]["accuracy"] == record.scores.accuracy
    best = max(choice["accuracy"] for choice in record.choices.values())
    assert record.choices["oracle"]["accuracy"] == best
    assert {choice["stage"] for choice in record.choices.values()} == {"round"}
    assert record.selection == "im"


def test_source_only_looks_at_a_target_without_learning_from_it(qs3, store, source, tmp_path):
    weights = []
    for name, target in {"with": ("--target", store), "without": ()}.items():
        run = tmp_path / name
        qs3("train", "--source", source, *target, "--out", run, *QUICK)
        weights.append((run / "model.safetensors").read_bytes())
        lines = [json.loads(line) for line in (run / "history.jsonl").read_text().splitlines()]
        told = [line["validators"] for line in lines if line["kind"] == "checkpoint"]
        assert all((one["im"] is None) == (not target) for one in told)
        assert all(one["source-val"] is not None for one in told)
        assert json.loads((run / "run.json").read_text())["target_clouds"] == []
    assert weights[0] == weights[1]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--method", "dann"), "method dann needs --target"),
        (("--method", "qbst", "--self-training", "spst"), "method qbst is source-only with qbst"),
        (("--method", "spst", "--preset", "paper"), "single_class = drop is not read by rule spst"),
        (("--self-training.rounds", 3), "has no rounds to set; add --self-training"),
        (("--method-set", "weight=1"), "unknown setting 'weight' of method source-only"),
        (("--model-set", "k"), "--model-set k: give each setting once, as name=value"),
    ],
)
def test_what_does_not_go_together_is_refused(qs3, store, tmp_path, arguments, said):
    line = qs3.refuses("train", "--source", store, "--out", tmp_path / "run", *arguments)
    assert said in line
    assert not (tmp_path / "run").exists()


def test_a_setting_that_the_rule_does_not_read_is_refused(qs3, store, tmp_path):
    done = qs3("train", "--source", store, "--out", tmp_path / "run", "--self-training", "spst",
               "--self-training.selection", "least-confident", code=2)  # fmt: skip
    assert "not read by rule spst" in " ".join(done.stderr.replace("│", " ").split())
    assert not (tmp_path / "run").exists()


def test_settings_are_json_or_words():
    given = parse_settings("--x", ["a=1.5", "b=true", "c=[1, 2]", "d=voxels", "e="])
    assert given == {"a": 1.5, "b": True, "c": [1, 2], "d": "voxels", "e": ""}
    with pytest.raises(InputError, match="--x a=2: give each setting once"):
        parse_settings("--x", ["a=1", "a=2"])


@pytest.mark.parametrize(
    ("arguments", "preset"),
    [
        ([], "default"),
        (["--method", "qbst"], "default"),
        (["--method=spst"], "spst"),
        (["--method", "gast-spst"], "spst"),
        (["--method", "gast", "--self-training", "spst"], "spst"),
        (["--method", "gast", "--self-training", "qbst"], "default"),
        (["--method", "qbst", "--preset", "paper"], "paper"),
    ],
)
def test_a_preset_follows_the_method(arguments, preset):
    chosen = defaults(arguments)["options"]
    assert chosen.preset == preset
    assert chosen.self_training == PRESETS[preset]


def test_a_method_of_an_earlier_release_is_taken_with_a_note(capsys):
    _note_old_name.cache_clear()
    words = ["--source", "a", "--out", "b", "--method", "qs3"]
    options = tyro.cli(TrainOptions, args=words, default=defaults(words)["options"])
    assert options.method == "qbst"
    assert capsys.readouterr().err.count("--method qs3 is qbst now") == 1
