"""Every method on every kind of network: it trains, goes on after a stop, and sees no label."""

import functools
import itertools
import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from qs3.adaptation import Batch, create_method, list_methods, method_class
from qs3.adaptation.names import COMPOSED
from qs3.clouds.load import load_clouds, load_unlabelled
from qs3.clouds.types import UnlabelledClouds
from qs3.errors import InputError
from qs3.models import create_model
from qs3.paper.names import WITHOUT_TARGET, MethodName
from qs3.runs import SelfTrainingSettings, TrainSettings
from qs3.runs.rounds import STATE
from qs3.runs.weights import read_tensors
from qs3.training import fit, load_model
from qs3.training.trainer import best_on_source, held_out, read_checkpoints

from ..models.common import SMALL
from ..training.common import SWITCHES, Stop, history_of, make_clouds, plain, same, stop_at

NETWORKS = {
    "dgcnn": SMALL["dgcnn"],
    "pointnet": SMALL["pointnet"] | {"transforms": False},
    "pointnet2": SMALL["pointnet2"] | {"local": False},
}
METHODS = (*list_methods(), "dann:DANN")
ROUNDS = SelfTrainingSettings(rounds=2, epochs=1, threshold=0.34)
SWITCHED = replace(SWITCHES, epochs=1, threshold_share=0.8)
pytestmark = pytest.mark.filterwarnings("ignore::qs3.adaptation.SingleClassWarning")
SMALLER = {"pointdan": {"nodes": 8, "neighbours": 6}, "dann:DANN": {"hidden": (16,)}}
"""Settings that only save time; all else is a method's default."""


clouds = functools.partial(make_clouds, points=40)
SOURCE, TARGET = clouds(14, 0), clouds(9, 1).without_labels()


def settings(method, network="pointnet", **changes):
    plain = TrainSettings(
        model=network,
        model_settings=NETWORKS[network],
        method_settings=SMALLER.get(method, {}),
        num_points=32,
        epochs=3,
        batch_size=6,
        holdout=0.15,
        validate_every=1,
        accelerator="cpu",
        threads=1,
    )
    return replace(plain, **changes)


def fit_after_a_stop(*arguments, run_dir):
    """Fit, end it after the first epoch as a kill would, and take it up again."""
    with pytest.raises(Stop):
        fit(*arguments, run_dir=run_dir, on_epoch=stop_at(1))
    return fit(*arguments, run_dir=run_dir)


def batch(count=4, seed=0, points=24):
    generator = torch.Generator().manual_seed(seed)
    labels = torch.arange(count) % 3
    return Batch(torch.randn(count, points, 3, generator=generator) * 0.4, labels)


def make(method, network, seed=0):
    torch.manual_seed(seed)
    local = {"local": True} if network == "pointnet2" else {}
    model = create_model(network, 3, **NETWORKS[network] | local)
    return create_method(method, model, **SMALLER.get(method, {})).train()


def test_command_line_knows_every_method():
    assert set(MethodName.__args__) == set(list_methods()) | set(COMPOSED)
    assert set(WITHOUT_TARGET) == {n for n in METHODS if not method_class(n).uses_target}
    assert {warm_up for warm_up, _ in COMPOSED.values()} <= set(METHODS)


@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("method", METHODS)
def test_losses_are_finite_scalars_that_reach_every_weight(method, network):
    learner = make(method, network)
    target = batch(5, seed=1, points=20).points if learner.uses_target else None
    left = {n for n, p in learner.named_parameters() if p.requires_grad and "transform" not in n}
    for trial in range(6):  # what a step draws decides which weights it needs
        losses = learner(batch(seed=trial), target, 0.5, torch.Generator().manual_seed(trial))
        assert all(loss.ndim == 0 and torch.isfinite(loss) for loss in losses.values())
        learner.zero_grad()
        sum(losses.values()).backward()
        left -= {n for n, p in learner.named_parameters() if p.grad is not None and p.grad.any()}
        if not left:
            return
    assert left == set()


@pytest.mark.parametrize("sizes", [(2, 3, 4, 2), (4, 20, 2, 30), (2, 1, 2, 1)], ids=str)
@pytest.mark.parametrize("method", METHODS)
def test_few_equal_and_unequal_clouds_give_finite_gradients(method, sizes):
    b, n, b_t, n_t = sizes
    source, target = batch(b, points=n), batch(b_t, seed=1, points=n_t).points
    if n == 20:
        source.points[:], target[:] = -0.5, 0.25
    learner = make(method, "dgcnn")
    losses = learner(source, target if learner.uses_target else None, 1.0, torch.Generator())
    sum(losses.values()).backward()
    for name, weight in learner.named_parameters():
        assert weight.grad is None or weight.grad.isfinite().all(), name


@pytest.mark.parametrize(
    "network",
    ["pointnet", *(pytest.param(name, marks=pytest.mark.slow) for name in ("dgcnn", "pointnet2"))],
)
@pytest.mark.parametrize("method", METHODS)
def test_resumed_is_uninterrupted_and_seeds_count(method, network, tmp_path):
    chosen = settings(method, network, epochs=2)
    whole = fit(method, SOURCE, TARGET, chosen, run_dir=tmp_path / "whole")
    assert len(whole.history) == 2
    assert all(np.isfinite(list(epoch.losses.values())).all() for epoch in whole.history)
    assert all(0 <= epoch.accuracy <= 1 for epoch in whole.history)
    resumed = fit_after_a_stop(method, SOURCE, TARGET, chosen, run_dir=tmp_path / "cut")
    assert same(whole.model, resumed.model)
    assert whole.checkpoints == resumed.checkpoints
    assert same(resumed.model, load_model(tmp_path / "cut").model)
    other = fit(method, SOURCE, TARGET, replace(chosen, seed=1), run_dir=tmp_path / "other")
    assert not same(whole.model, other.model)


@pytest.mark.parametrize("method", METHODS)
def test_draws_come_from_the_generator_alone(method):
    def values(seed, noise):
        learner = make(method, "pointnet").eval()
        torch.manual_seed(noise)
        target = batch(5, seed=1).points if learner.uses_target else None
        losses = learner(batch(), target, 0.5, torch.Generator().manual_seed(seed))
        return {name: loss.item() for name, loss in losses.items()}

    assert values(0, 0) == values(0, 1)


@pytest.mark.parametrize(
    ("method", "target"),
    [
        *((method, "one object") for method in METHODS),
        *zip(METHODS, itertools.cycle(["a class less", "more than the source"]), strict=False),
    ],
)
def test_targets_of_any_size(method, target, tmp_path):
    few = {
        "one object": clouds(1, 5),
        "a class less": clouds(8, 6, classes=2),
        "more than the source": clouds(31, 5),
    }[target].without_labels()
    smallest = settings(method, epochs=1, batch_size=2 if target == "a class less" else 6)
    result = fit(method, SOURCE, few, smallest, run_dir=tmp_path)
    assert np.isfinite(list(result.history[0].losses.values())).all()
    assert np.isfinite(result.checkpoints[-1].source_accuracy)


@pytest.mark.parametrize(("count", "seen_whole"), [(31, "target"), (4, "source")])
def test_no_domain_is_truncated(count, seen_whole, tmp_path, monkeypatch):
    kind, seen = method_class("dann:DANN"), {"source": 0, "target": 0}
    losses = kind.losses

    def watched(self, source, target, progress, generator):
        seen["source"] += len(source.labels)
        seen["target"] += len(target)
        return losses(self, source, target, progress, generator)

    monkeypatch.setattr(kind, "losses", watched)
    chosen = settings("dann:DANN", epochs=1, holdout=0.0)
    fit("dann:DANN", SOURCE, clouds(count, 5).without_labels(), chosen, run_dir=tmp_path)
    whole = {"source": len(SOURCE), "target": count - 1}  # a last batch of one cloud is left out
    assert seen[seen_whole] >= whole[seen_whole]


@pytest.mark.parametrize("method", [*METHODS, *COMPOSED, "qbst, switched"])
@pytest.mark.parametrize("rule", [pytest.param("last", marks=pytest.mark.slow), "source-val"])
def test_poisoned_labels_of_the_target_change_no_bit(method, rule, tmp_path):
    """The files' labels are all wrong; read, trained, stopped, resumed, chosen: the same bits."""
    method, _, switched = method.partition(", ")
    truth = clouds(12, 3)
    names = np.array(truth.class_names)
    runs = []
    cases = {"true": truth.labels, "wrong": (truth.labels + 1) % 3}
    for case, labels in cases.items():
        path = tmp_path / case / "target.npz"
        path.parent.mkdir()
        np.savez(path, points=truth.points, label=labels, class_names=names)
        assert load_clouds(path, num_points=None).labels.tolist() == labels.tolist()
        target = load_unlabelled(path, num_points=None)
        assert isinstance(target, UnlabelledClouds)
        run = path.parent / "run"
        rounds = SWITCHED if switched else None
        if method in COMPOSED and not switched:
            rounds = replace(ROUNDS, rule=COMPOSED[method][1])
        chosen = settings(method, epochs=2, rule=rule)
        result = fit_after_a_stop(method, SOURCE, target, chosen, rounds, run_dir=run)
        runs.append((result, plain(history_of(run)), (run / "settings.json").read_text()))
    (right, history, kept), (wrong, history_of_wrong, kept_of_wrong) = runs
    assert same(right.model, wrong.model)
    assert right.checkpoints == wrong.checkpoints
    assert right.known == wrong.known
    assert right.known is not None
    assert len(right.checkpoints) >= 2
    assert history == history_of_wrong
    assert kept == kept_of_wrong
    if switched:
        rounds, others = (read_tensors(tmp_path / case / "run" / STATE)[0] for case in cases)
        assert same(rounds, others)
    if rule == "source-val":
        stage = right.checkpoints[-1].stage if method not in COMPOSED else "round"
        run = tmp_path / "true" / "run"
        picked = best_on_source(
            [checkpoint for checkpoint in read_checkpoints(run) if checkpoint.stage == stage]
        )
        kept = load_model(run / picked.file).model
        assert same(kept, right.model)


def test_the_poison_would_show(tmp_path):
    """The test above can fail: labels that do reach the training change its bits."""
    truth = clouds(12, 3)
    wrong = replace(truth, labels=(truth.labels + 1) % 3)
    one, other = (
        fit("source-only", part, None, settings("source-only"), run_dir=tmp_path / name)
        for name, part in {"true": truth, "wrong": wrong}.items()
    )
    assert not same(one.model, other.model)


@pytest.mark.parametrize(
    ("method", "rule"), list(zip(METHODS, itertools.cycle(["qbst", "spst"]), strict=False))
)
def test_any_warm_up_goes_with_any_self_training(method, rule, tmp_path):
    rounds = replace(ROUNDS, rule=rule)
    result = fit(method, SOURCE, TARGET, settings(method, epochs=1), rounds, run_dir=tmp_path)
    assert len(result.rounds) == 2
    assert [(c.stage, c.number) for c in result.checkpoints] == [
        *(("round", number) for number in range(3)),
        ("warm-up", 1),
    ]
    began_with = read_tensors(tmp_path / result.checkpoints[0].file)[0]
    assert same(began_with, load_model(tmp_path / "warm-up").model)


def test_a_rule_may_keep_the_network_that_the_rounds_began_with(monkeypatch, tmp_path):
    """If the first checkpoint has the best score, no round may have moved the answers."""
    scores = itertools.count()
    monkeypatch.setattr("qs3.training.trainer.accuracy", lambda *_: -float(next(scores)))
    chosen = replace(settings("source-only", epochs=1, validate_every=5), rule="source-val")
    result = fit("source-only", SOURCE, TARGET, chosen, ROUNDS, run_dir=tmp_path)
    assert any(not record.skipped for record in result.rounds)
    assert json.loads((tmp_path / "run.json").read_text())["chosen"]["number"] == 0
    assert same(result.model, load_model(tmp_path / "warm-up").model)


def test_source_val_without_a_held_out_part_is_refused_at_once(tmp_path):
    chosen = settings("source-only", holdout=0.0, rule="source-val")
    with pytest.raises(InputError, match="'source-val' needs a held-out"):
        fit("source-only", SOURCE, TARGET, chosen, run_dir=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_warm_up_must_be_of_the_method_and_leave_the_held_out_part_unseen(tmp_path, caplog):
    chosen = settings("dann:DANN", epochs=1)
    fit("dann:DANN", SOURCE, TARGET, chosen, run_dir=tmp_path / "dann")

    def adapt(name, method="dann:DANN", **changes):
        run = tmp_path / name
        changed = replace(chosen, **changes)
        warm = tmp_path / "dann"
        return fit(method, SOURCE, TARGET, changed, ROUNDS, run_dir=run, warm_up=warm)

    with pytest.raises(InputError, match="is a run of method dann:DANN, not source-only"):
        adapt("a", "qbst", method_settings=SMALLER["dann:DANN"])
    with pytest.raises(InputError, match="trained with method_settings"):
        adapt("b", method_settings={"hidden": (8,)})
    assert adapt("c").checkpoints[-1].source_accuracy is not None
    assert not caplog.records
    assert adapt("d", seed=1).checkpoints[-1].source_accuracy is None
    assert "none of it is left to validate on" in caplog.text
    with pytest.raises(InputError, match="that no warm-up has seen"):
        adapt("e", seed=1, rule="source-val")
    with pytest.raises(InputError, match="is self-trained itself"):
        fit(
            "dann:DANN",
            SOURCE,
            TARGET,
            chosen,
            ROUNDS,
            run_dir=tmp_path / "f",
            warm_up=tmp_path / "c",
        )


def test_clouds_that_a_warm_up_has_not_seen_may_judge_it(tmp_path):
    chosen = settings("dann:DANN", epochs=1)
    wider = SOURCE.points * np.float32([1, 2, 0.5])
    before = fit(
        "dann:DANN", replace(SOURCE, points=wider), TARGET, chosen, run_dir=tmp_path / "dann"
    )

    def adapt(name, rounds, **changes):
        changed, warm = replace(chosen, **changes), tmp_path / "dann"
        run = tmp_path / name
        return fit("dann:DANN", SOURCE, TARGET, changed, rounds, run_dir=run, warm_up=warm)

    result = adapt("new", ROUNDS, rule="source-val")
    assert result.checkpoints[-1].source_accuracy is not None
    # Where no round trains, the network is the warm-up's, and so is what is known of it.
    skipping = replace(ROUNDS, threshold=0.99)
    with pytest.raises(InputError, match="raise holdout above 0"):
        adapt("none", skipping, holdout=0.0, rule="source-val")
    result = adapt("skipped", skipping, holdout=0.0)
    assert all(record.skipped for record in result.rounds)
    assert result.known is not None
    assert result.known == before.known


def test_a_held_out_part_takes_of_every_class_and_never_its_last_cloud():
    rare = SOURCE.select(np.flatnonzero((SOURCE.labels < 2) | (np.arange(len(SOURCE)) == 2)))
    for seed in range(5):
        rows = held_out(rare, settings("source-only", holdout=0.5, seed=seed))
        trained, held = rare.select(~rows), rare.select(rows)
        assert np.bincount(trained.labels, minlength=3)[2] == 1
        assert np.bincount(held.labels, minlength=3).tolist() == [2, 2, 0]


@pytest.mark.parametrize("method", [n for n in METHODS if method_class(n).needs_local])
def test_networks_without_local_features_are_refused_by_name(method):
    with pytest.raises(InputError, match="RSCNN"):
        create_method(method, create_model("rscnn", 3))


@pytest.mark.gpu
@pytest.mark.parametrize("network", NETWORKS)
@pytest.mark.parametrize("method", METHODS)
def test_trains_on_a_gpu_and_is_deterministic(method, network, tmp_path):
    if not torch.cuda.is_available():
        pytest.skip("torch sees no CUDA device")
    chosen = settings(method, network, accelerator="cuda")
    one, other = (
        fit(method, SOURCE, TARGET, chosen, run_dir=tmp_path / name) for name in ("a", "b")
    )
    assert same(one.model, other.model)
