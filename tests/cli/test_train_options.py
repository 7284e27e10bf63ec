"""The dry run and the help of ``qs3 train``."""

import re

import pytest

QUICK = ("--model", "pointnet", "--num-points", 64, "--batch-size", 5, "--threads", 1,
         "--accelerator", "cpu")  # fmt: skip


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
