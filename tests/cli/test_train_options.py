"""Options of ``qs3 train`` that end a run, share it out or write more of it."""

import re
import tomllib
from dataclasses import fields
from pathlib import Path

import pytest
import tyro

from qs3.cli.train import TrainOptions, defaults, run_toml
from qs3.training.run import read_run

QUICK = ("--model", "pointnet", "--num-points", 64, "--batch-size", 5, "--threads", 1,
         "--accelerator", "cpu")  # fmt: skip


def test_max_time_stops_with_its_own_code_and_goes_on(qs3, store, tmp_path):
    command = ("train", "--source", store, "--out", tmp_path / "run", "--epochs", 2, *QUICK,
               "--max-time")  # fmt: skip
    assert "such as 00:30:00" in qs3.refuses(*command, "10")
    assert not (tmp_path / "run").exists()
    # PyTorch alone takes longer to load than a second; one epoch is always made.
    stopped = qs3(*command[:-1], "--max-time", "00:00:01", "--epochs", 400, code=3)
    assert stopped.stdout == ""
    assert "run the same command again to continue" in stopped.stderr
    done = len((tmp_path / "run" / "history.jsonl").read_text().splitlines())
    assert 1 <= done < 400


def parsed(*words) -> TrainOptions:
    words = list(map(str, words))
    return tyro.cli(TrainOptions, args=words, default=defaults(words)["options"])


LINES = [
    ("--source", "a b\\"),
    ("--source", "ü", "--method", "gast-spst", "--target", "t", "--self-training.rounds", 2),
    ("--source", "a", "--method", "dann", "--target", "t", "--self-training", "qbst", "--preset",
     "released", "--source-split", "train", "--classes", "pointda10", "--map", "m.toml"),
    ("--method", "qbst", "--warm-up", "rooms", "--target", "t", "--clip-norm", "None",
     "--augmentation.sight", 0.5, "--threads", 2),
    ("--method", "qbst", "--preset", "paper", "--source", "s", "--target", "t", "--no-rotate-z"),
]  # fmt: skip


@pytest.mark.parametrize("line", LINES)
def test_a_file_of_the_options_gives_the_options(line, tmp_path):
    wanted, file = parsed(*line, "--out", "o"), tmp_path / "my.toml"
    file.write_text(run_toml(wanted), "utf-8")
    got = parsed("--config", file, "--out", "o")
    for part in fields(TrainOptions):
        if part.name != "config":
            assert getattr(got, part.name) == getattr(wanted, part.name), part.name
    assert run_toml(got) == run_toml(wanted)


def test_the_command_line_wins_and_a_preset_replaces_what_it_sets(tmp_path):
    file = tmp_path / "my.toml"
    file.write_text('source = "s"\ntarget = "t"\nmethod = "qbst"\n[train]\nepochs = 7\n'
                    "[train.preparation]\nalign = true\n[train.augmentation]\nplane = 0.5\n"
                    "[self_training]\nrounds = 3\n")  # fmt: skip
    common = ("--config", file, "--out", "o")
    got = parsed(*common)
    assert (got.source, got.train.epochs, got.self_training.rounds) == ("s", 7, 3)
    assert (
        got.train.preparation == parsed("--source", "s", "--out", "o", "--align").train.preparation
    )
    got = parsed(*common, "--epochs", 8, "--self-training.rounds", 4, "--source", "other")
    assert (got.source, got.train.epochs, got.self_training.rounds) == ("other", 8, 4)
    paper = "--source s --target t --method qbst --preset paper --out o"
    got, plain = parsed(*common, "--preset", "paper"), parsed(*paper.split())
    assert got.self_training == plain.self_training
    assert got.train.preparation == plain.train.preparation
    assert got.train.augmentation == plain.train.augmentation
    assert got.train.epochs == 7
    got = parsed(*common, "--method", "spst")
    assert got.train.augmentation.plane == 0.5
    assert (got.preset, got.self_training.rule) == ("spst", "spst")
    assert got.self_training.weight_step == 0.005


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("epoch = 3", "'epoch' is unknown"),
        ("[train]\nepoch = 3", "'train.epoch' is unknown; did you mean train.epochs?"),
        ("train = 3", "not a table"),
        ('[train]\nepochs = "many"', "'train.epochs'"),
        ('method = "qbst"\n[self_training]\nrule = "spst"', "rounds_rule"),
        ("[train", "cannot be read as TOML"),
        ("[train]\nepochs = 0", "epochs = 0 must be above 0"),
    ],
)
def test_a_fault_of_the_file_names_it(typed, tmp_path, text, fault):
    (tmp_path / "my.toml").write_text(text)
    line = typed.refuses("train", "--config", tmp_path / "my.toml", "--out", tmp_path / "run")
    assert "my.toml" in line
    assert fault in line
    line = typed.refuses("train", "--config", tmp_path / "none.toml", "--out", tmp_path / "run")
    assert "none.toml: no such file" in line


def test_a_run_writes_the_file_that_repeats_it(qs3, store, tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    qs3("train", "--source", store, "--out", one, "--epochs", 2, *QUICK, "--model-set",
        "hidden=[16]", "--no-redraw")  # fmt: skip
    written = tomllib.loads((one / "run.toml").read_text("utf-8"))
    assert written["source"] == str(store)
    assert written["train"]["model_settings"] == {"hidden": [16]}
    assert not {"out", "config", "max_time"} & set(written)
    qs3("train", "--config", one / "run.toml", "--out", other)
    for name in ("run.toml", "settings.json", "model.safetensors"):
        assert (one / name).read_bytes() == (other / name).read_bytes()
    assert read_run(Path(other)).source == read_run(Path(one)).source
    qs3("train", "--config", one / "run.toml", "--out", other)  # finished: nothing to do


def test_a_dry_run_tells_what_would_be_trained_and_writes_nothing(
    qs3, store, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    before = set(store.rglob("*"))
    words = ("train", "--source", store, *QUICK, "--epochs", 3, "--holdout", 0, "--dry-run")
    told = qs3(*words).stdout
    for part in ("10 clouds, 0 of them held out", "chair 1", "3 epochs of 2 steps of 5 clouds: 6",
                 "pointnet, 3.4", "64 points", "holdout 0.0"):  # fmt: skip
        assert part in told, told
    rounds = ("--target", store, "--method", "qbst", "--self-training.rounds", 2,
              "--self-training.epochs", 4)  # fmt: skip
    told = qs3(*words, *rounds).stdout
    assert "qbst, 2 rounds of 4 epochs of at most 2 steps: 16" in told
    assert "10 clouds, 0 of them held out" in qs3(*words[:-1], "--dry_run").stdout
    assert set(store.rglob("*")) == before
    assert not list(tmp_path.iterdir())
    assert "--target" in qs3.refuses(*words, "--method", "dann")


@pytest.mark.parametrize("verb", ["train", "generate"])
def test_help_shows_common_options_first_and_all_once(verb, typed):
    text = typed(verb, "--help").stdout
    common, advanced = text.split("\n advanced options\n")
    flags = re.findall(r"^  --(\w[\w.-]*)", text, re.M)
    assert len(flags) == len({*flags}) > 40
    assert {"out", "seed", "dry-run"} <= {*re.findall(r"^  --([\w-]+)", common, re.M)}
    assert "\n  --dry-run" not in advanced
