"""The dry run and the help of ``qs3 train``."""

import re

import pytest

QUICK = ("--model", "pointnet", "--num-points", 64, "--batch-size", 5, "--threads", 1,
         "--accelerator", "cpu")  # fmt: skip


def test_a_dry_run_tells_what_would_be_trained_and_writes_nothing(
    typed, store, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    before = set(store.rglob("*"))
    words = ("train", "--source", store, *QUICK, "--epochs", 3, "--holdout", 0, "--dry-run")
    printed = typed(*words).stdout
    for part in ("10 clouds, 0 of them held out", "chair 1", "3 epochs of 2 steps of 5 clouds: 6",
                 "pointnet, 3.4", "64 points", "holdout 0.0"):  # fmt: skip
        assert part in printed, printed
    rounds = ("--target", store, "--method", "qbst", "--self-training.rounds", 2,
              "--self-training.epochs", 4)  # fmt: skip
    printed = typed(*words, *rounds).stdout
    assert "qbst, 2 rounds of 4 epochs of at most 2 steps: 16" in printed
    assert "10 clouds, 0 of them held out" in typed(*words[:-1], "--dry_run").stdout
    assert set(store.rglob("*")) == before
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("verb", ["train", "generate"])
def test_help_shows_every_option_once(verb, typed):
    text = typed(verb, "--help").stdout
    flags = re.findall(r"^\W{2}--(\w[\w.-]*)", text, re.M)
    assert len(flags) == len({*flags}) > 40
    assert {"out", "seed", "dry-run"} <= {*flags}


def test_help_calls_positional_arguments_by_name(typed):
    for words, usage in (
        (["adapt"], "CAD SCANS …"),
        (["predict"], "RUN FILES …"),
        (["table"], "RESULTS"),
        (["extract", "nyuv2"], "SOURCE"),
    ):
        assert typed(*words, "--help").stdout.splitlines()[0].endswith(usage)


@pytest.mark.parametrize(
    ("model", "words", "message"),
    [
        ("forest", ("--method", "gast", "--target", "STORE"), "method gast needs a network"),
        ("forest", ("--num-points", 64), "num_points"),
        ("forest", ("--train.epochs", 3), "epochs"),
        (
            "forest",
            ("--method", "qbst", "--target", "STORE", "--self-training.epochs", 3),
            "epochs",
        ),
        ("forest", ("--out", "TAKEN"), "holds something else"),
        ("pointnet", ("--method", "defrec", "--target", "STORE", "--model-set", "a=1"), "a"),
        ("pointnet", ("--method-set", "weight=1"), "weight"),
        ("pointnet", ("--rule", "source-val", "--holdout", 0), "held-out part of the source"),
        ("pointnet", ("--warm-up", "rooms"), "takes no warm-up"),
        ("pointnet", ("--accelerator", "nosuch"), "nosuch"),
        ("pointnet", ("--out", "TAKEN"), "holds something else"),
        ("pointnet", ("--epochs", "0"), "epochs"),
        ("pointnet", ("--method", "gast"), "method gast needs --target"),
        ("pointnet", ("--method", "qbst", "--self-training", "spst"), "qbst is source-only with"),
        ("pointnet", ("--method", "spst", "--preset", "paper"), "is read with rule qbst only"),
        ("pointnet", ("--self-training.rounds", 3), "has no rounds to set; add --self-training"),
        ("pointnet", ("--model-set", "k"), "--model-set k: give each setting once, as name=value"),
        ("pointnet", ("--labels", "x.csv"), "or use --model forest"),
        ("pointnet", ("--meshes", "STORE"), "goes with --model forest"),
        ("forest", ("--units", "mm"), "name these"),
    ],
)
def test_a_dry_run_refuses_what_the_run_refuses(typed, store, tmp_path, model, words, message):
    (tmp_path / "taken").mkdir()
    (tmp_path / "taken" / "mine.txt").touch()
    places = {"STORE": store, "TAKEN": tmp_path / "taken"}
    words = [places.get(str(word), word) for word in words]
    out = () if "--out" in words else ("--out", tmp_path / "out")
    command = ("train", "--source", store, "--model", model, *words, *out)
    wet = typed(*command, code=2).stderr
    assert message in wet
    assert typed(*command, "--dry-run", code=2).stderr == wet
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]


def test_a_dry_run_refuses_the_folder_of_another_run(typed, store, run):
    words = ("train", "--source", store, "--model", "pointnet", "--epochs", 3, "--out", run)
    assert typed(*words, "--dry-run", code=2).stderr == typed(*words, code=2).stderr != ""
