import contextlib
import copy
import logging
from dataclasses import replace

import numpy as np
import pytest
import torch

from qs3.adaptation.selection import SingleClassWarning, select_quasi_balanced
from qs3.answers import evaluate
from qs3.clouds.preparation import ROBUST
from qs3.clouds.types import UnlabelledClouds
from qs3.errors import InputError
from qs3.runs import PRESETS, Augmentation, SelfTrainingSettings, read_run
from qs3.runs.rounds import STATE, kept_clouds, remarks
from qs3.runs.weights import CHECKPOINT, new_model
from qs3.training import fit, load_model
from qs3.training.predict import predict_probabilities
from qs3.training.prepared import prepare_clouds
from qs3.training.self_training import self_train

from .common import SWITCHES, Stop, history_of, plain, same, stop_at

WIDE = {
    "preparation": replace(ROBUST, size_input=True, align=True),
    "augmentation": Augmentation(
        sight=0.3, plane=0.3, patches=0.3, stretch=1.0, tilt=1.0, floor=0.2, noise=0.5
    ),
    "num_points": 40,
}
"""Outliers removed, points drawn anew, sizes told, clouds augmented."""
ROUNDS = SelfTrainingSettings(rounds=3, epochs=2, threshold=0.4)


@pytest.fixture(scope="module")
def warm(source, settings, tmp_path_factory):
    """Folder of a warm-up that knows the three shapes."""
    folder = tmp_path_factory.mktemp("warm") / "run"
    fit("source-only", source, None, replace(settings, epochs=25), run_dir=folder)
    return folder


@pytest.fixture(scope="module")
def domains(source, target, settings):
    def ready(clouds):
        return replace(clouds, points=prepare_clouds(clouds, settings.num_points).points)

    return ready(source), ready(target.without_labels())


@pytest.fixture
def arguments(source, target, settings):
    """What is adapted, and how, but for the rounds."""
    return "qbst", source, target.without_labels(), settings


def test_improves_or_keeps_an_easy_target(arguments, target, warm, tmp_path):
    result = fit(*arguments, ROUNDS, run_dir=tmp_path / "run", warm_up=warm)
    predictions = predict_probabilities(result.model, target.points).argmax(axis=1)
    assert (predictions == target.labels).mean() >= 0.9
    assert [record.round for record in result.rounds] == [1, 2, 3]
    assert [record.theta for record in result.rounds] == pytest.approx([0.4, 0.405, 0.41])
    for record in result.rounds:
        assert sum(record.kept) <= sum(record.confident) <= record.pool == 30
        assert all(k <= c for k, c in zip(record.kept, record.confident, strict=True))
        assert len(record.losses) == 2
    assert result.rounds[0].agreement is None
    assert 0 <= result.rounds[1].agreement <= 1


@pytest.mark.parametrize("preset", ["paper", "spst", "released", "robust", "switches"])
def test_resumed_in_a_round_is_uninterrupted(source, target, settings, tmp_path, preset):
    settings = replace(settings, epochs=12, seed=1)
    if preset == "robust":
        settings, preset = replace(settings, **WIDE), "default"
    # From scratch, a shrinking pool is too small here to go on; `released` covers that start.
    changes = {"init": "warm-up"} if preset == "paper" else {}
    each = 8 if preset == "released" else 3  # epochs of a round
    if preset == "switches":
        rounds = replace(SWITCHES, rounds=3, epochs=each)
    else:
        schedule = {"rounds": 3, "epochs": each, "threshold": 0.34}
        rounds = replace(PRESETS[preset], **schedule | changes)
    arguments = (rounds.rule, source, target.without_labels(), settings, rounds)
    whole = fit(*arguments, run_dir=tmp_path / "whole")
    stop = stop_at(12 + each + 2)
    assert not any(record.skipped for record in whole.rounds[:2])
    with pytest.raises(Stop):
        fit(*arguments, run_dir=tmp_path / "cut", on_epoch=stop)
    with pytest.raises(InputError, match="not finished"):
        load_model(tmp_path / "cut")
    going_on = stop_at(None)
    resumed = fit(*arguments, run_dir=tmp_path / "cut", on_epoch=going_on)
    assert same(whole.model, resumed.model)
    assert plain(whole.rounds) == plain(resumed.rounds)
    trained = sum(not record.skipped for record in whole.rounds)
    assert len(stop.seen + going_on.seen) == 12 + each * trained  # nothing is done twice


def test_a_finished_run_is_not_done_again(arguments, source, warm, tmp_path):
    where = {"run_dir": tmp_path / "run", "warm_up": warm}
    first = fit(*arguments, ROUNDS, **where)
    epochs, run = [], tmp_path / "run"
    left = [run / CHECKPOINT, run / ".0123456789abcdef.tmp.safetensors"]  # by a stop
    for path in left:
        path.touch()
    again = fit(*arguments, ROUNDS, **where, on_epoch=lambda r, m: epochs.append(r))
    assert not epochs
    assert not any(path.exists() for path in left)
    assert same(first.model, again.model)
    loaded = load_model(tmp_path / "run")
    assert same(loaded.model, first.model)
    assert loaded.class_names == source.class_names
    assert loaded.settings["self_training"]["rounds"] == 3
    kinds = [line["kind"] for line in history_of(tmp_path / "run")]
    assert sorted(kinds) == ["checkpoint"] * 4 + ["round"] * 3


def test_history_keeps_finished_rounds_over_stops(arguments, warm, tmp_path):
    """Stopped in round 2, and again right after going on: round 1's line stays."""
    run = tmp_path / "run"
    rounds = replace(ROUNDS, rounds=2, epochs=3, threshold=0.34)
    for calls in (4, 1):
        stop = stop_at(calls)
        with pytest.raises(Stop):
            fit(*arguments, rounds, run_dir=run, warm_up=warm, on_epoch=stop)
        lines = [line for line in history_of(run) if line["kind"] != "checkpoint"]
        kinds = [(line["kind"], line.get("stage", line.get("round"))) for line in lines]
        assert kinds == [("round", 1)] + [("epoch", "round-2")] * (2 if calls == 1 else 1)
        if calls == 4:
            first = stop.seen[:3]
    done = next(line for line in history_of(run) if line["kind"] == "round")
    assert done["accuracies"] == [epoch.accuracy for epoch in first]
    assert done["learning_rates"] == [epoch.learning_rate for epoch in first]
    assert done["losses"] == [epoch.losses for epoch in first]


def test_too_few_selected_keeps_the_network(domains, settings, caplog):
    model = new_model(settings, 3, 0)
    with caplog.at_level(logging.WARNING):
        adapted, records = self_train(model, *domains, settings, replace(ROUNDS, threshold=0.98))
    assert same(model, adapted)
    assert adapted is not model
    assert [record.skipped for record in records] == [True] * 3
    assert "fewer than 6 (2 for each of 3 classes" in caplog.text


def one_round(domains, settings, select=None, model=None, on_epoch=None, **changes):
    """One round, or more, on all clouds unless a rule says otherwise."""
    rounds = replace(ROUNDS, **({"rounds": 1} | changes))
    model = model or new_model(settings, 3, 0)
    select = select or (lambda probabilities, theta: np.ones(len(probabilities), dtype=bool))
    return self_train(model, *domains, settings, rounds, select=select, on_epoch=on_epoch)


def test_source_labels_matter_only_with_a_source_loss(domains, settings):
    source, target = domains
    swapped = replace(source, labels=(source.labels + 1) % 3)
    for source_loss in (True, False):
        a, _ = one_round((source, target), settings, source_loss=source_loss)
        b, _ = one_round((swapped, target), settings, source_loss=source_loss)
        assert same(a, b) is not source_loss


def test_scratch_forgets_the_warm_up_weights(domains, settings):
    models = [new_model(settings, 3, seed) for seed in (0, 0)]
    with torch.no_grad():
        # Nearly the same function, so that pseudo labels agree, with other weights.
        first = models[1].early[0]
        first.linear.weight.mul_(2.0)
        first.norm.running_mean.mul_(2.0)
        first.norm.running_var.mul_(4.0).add_(3e-5)
    for init, equal in (("scratch", True), ("warm-up", False)):
        a, b = (one_round(domains, settings, model=m, init=init)[0] for m in models)
        assert same(a, b) is equal, init


def test_pool_split_leaves_a_fifth_aside(domains, settings):
    sizes = []

    def note(probabilities, theta):
        sizes.append(len(probabilities))
        return np.ones(len(probabilities), dtype=bool)

    one_round(domains, settings, note, pool="split", rounds=2)
    assert sizes == [24, 24]


@pytest.mark.parametrize(
    ("count", "teacher", "trained_on"), [(5, "latest", []), (6, "latest", [6]), (9, "best", [8])]
)
def test_a_round_needs_two_clouds_a_class_and_trains_without_those_held_out(
    domains, settings, monkeypatch, count, teacher, trained_on
):
    trained = []

    def train(trainer, method, clouds, *arguments, **options):
        trained.append(len(clouds[0]))
        return [], {}

    monkeypatch.setattr("qs3.training.trainer.Trainer.train", train)
    rounds = replace(ROUNDS, rounds=1, teacher=teacher)
    _, records = self_train(
        new_model(settings, 3, 0), *domains, settings, rounds,
        select=lambda p, theta: np.arange(len(p)) < count,
    )  # fmt: skip
    assert trained == trained_on
    assert records[0].skipped is (not trained_on)


def test_pool_shrinks_to_the_kept_clouds(domains, settings):
    sizes = []

    def half(probabilities, theta):
        sizes.append(len(probabilities))
        return np.arange(len(probabilities)) % 2 == 0

    _, records = one_round(domains, settings, half, pool="shrinking", rounds=4)
    assert sizes == [30, 15, 8, 8]  # a skipped round shrinks nothing
    assert [record.skipped for record in records] == [False, False, True, True]


def test_continuous_schedule_rises_again_in_round_two(domains, settings):
    rates = {"per-round": [1.0, 0.5] * 3, "continuous": [1.0, 0.5, 0.0, 0.5, 1.0, 0.5]}
    for schedule, expected in rates.items():
        seen = []
        one_round(
            domains, settings, on_epoch=lambda r, m, seen=seen: seen.append(r.learning_rate / 0.01),
            rounds=3, schedule=schedule,
        )  # fmt: skip
        assert seen == pytest.approx(expected)


def test_best_teacher_holds_a_fifth_out(domains, settings):
    _, records = one_round(domains, settings, teacher="best", rounds=2, source_loss=False)
    assert all(0 <= record.held_out <= 1 for record in records)
    assert records[0].held_out <= records[1].held_out
    _, records = one_round(domains, settings, rounds=1)
    assert records[0].held_out is None


def test_best_teacher_labels_with_the_warm_up_until_it_is_beaten(domains, settings, monkeypatch):
    """With a score that never rises, every round gets the warm-up's pseudo labels."""
    monkeypatch.setattr("qs3.training.self_training.accuracy", lambda labels, predictions: 0.0)
    _, records = one_round(domains, settings, teacher="best", rounds=3)
    assert [record.agreement for record in records] == [None, 1.0, 1.0]


def test_single_class_is_warned_of_and_recorded(domains, settings):
    model = new_model(settings, 3, 0)
    with torch.no_grad():
        model.classify.layers[-1].bias.copy_(torch.tensor([0.0, 9.0, 0.0]))
    for rule, kept in (("keep", 30), ("drop", 0)):
        rounds = replace(ROUNDS, rounds=1, single_class=rule)
        warned = pytest.warns(SingleClassWarning) if kept else contextlib.nullcontext()
        with warned:
            _, records = self_train(model, *domains, settings, rounds)
        assert records[0].single_class
        assert records[0].kept == (0, kept, 0)


@pytest.fixture(scope="module")
def adapted(source, target, settings, tmp_path_factory):
    """A run with all switches on, its result, and its settings."""
    run = tmp_path_factory.mktemp("switched") / "run"
    chosen = replace(settings, epochs=25, label_smoothing=0.2)
    return run, fit("qbst", source, target.without_labels(), chosen, SWITCHES, run_dir=run), chosen


def test_python_rounds_are_those_of_fit(adapted):
    run, result, chosen = adapted
    model = load_model(run / "warm-up").model
    arguments = (model, result.source, result.target, chosen, SWITCHES)
    loop, records = self_train(*arguments)
    assert same(loop, result.model)
    assert plain(records) == plain(result.rounds)
    assert read_run(run).chosen == {"stage": "round", "number": 2}


def answers(model, clouds):
    """Probabilities, by PyTorch alone."""
    with torch.no_grad():
        logits = model.eval()(torch.from_numpy(clouds.points[:]))
    return torch.softmax(logits.double(), dim=1).numpy()


def test_the_first_round_by_hand(adapted):
    """Quantile and QBST's counts, from the warm-up."""
    run, result, _ = adapted
    probabilities = answers(load_model(run / "warm-up").model, result.target)
    record = result.rounds[0]
    theta = np.sort(probabilities.max(axis=1))[14]
    assert record.theta == pytest.approx(theta, abs=1e-4)
    assert sum(record.confident) == 15
    chosen = select_quasi_balanced(probabilities, record.theta)
    rows, labels = kept_clouds(run)[1][0]
    assert np.array_equal(rows, np.flatnonzero(chosen))
    assert np.array_equal(labels, probabilities[chosen].argmax(axis=1))
    assert record.kept == tuple(np.bincount(labels, minlength=3))


def test_the_average_follows_the_network_epoch_by_epoch(domains, settings):
    """Its labels are those of a mean of weights that is kept by hand."""
    model, seen, decay = new_model(settings, 3, 0), [], 0.6
    average = {name: tensor.clone() for name, tensor in model.state_dict().items()}
    averages = []

    def on_epoch(record, method):
        for name, tensor in method.model.state_dict().items():
            mean = decay * average[name] + (1 - decay) * tensor
            average[name] = mean if tensor.is_floating_point() else tensor.clone()
        averages.append(copy.deepcopy(average))

    def select(probabilities, theta):
        seen.append(probabilities)
        return np.ones(len(probabilities), dtype=bool)

    _, target = domains
    average_of = {"rounds": 3, "teacher": "average", "teacher_decay": decay}
    one_round(domains, settings, select, model, on_epoch, **average_of)
    teacher = new_model(settings, 3, 0)
    for number, weights in enumerate((model.state_dict(), averages[1], averages[3])):
        teacher.load_state_dict(weights)
        assert np.allclose(seen[number], answers(teacher, target), atol=1e-5), number


def test_evaluate_counts_right_pseudo_labels(adapted, target, settings):
    run, *_ = adapted
    before = (run / STATE).read_bytes()
    record = evaluate(run, target)
    for done, (rows, labels) in zip(record.rounds, kept_clouds(run)[1], strict=True):
        right = target.labels[rows] == labels
        assert done["known"] == list(done["kept"])
        assert done["right"] == np.bincount(labels[right], minlength=3).tolist()
    half = target.select(np.arange(30)[::-2])  # some, in another order
    done = evaluate(run, half).rounds[0]
    rows, labels = kept_clouds(run)[1][0]
    known = rows % 2 == 1
    assert done["known"] == np.bincount(labels[known], minlength=3).tolist()
    right = known & (target.labels[rows] == labels)
    assert done["right"] == np.bincount(labels[right], minlength=3).tolist()
    other = replace(target, points=target.points[:, ::-1].copy() + 0.01)
    assert "right" not in evaluate(run, other).rounds[0]
    assert (run / STATE).read_bytes() == before


def test_remarks_name_problems(domains, settings):
    _, records = one_round(domains, settings, lambda p, theta: np.arange(len(p)) < 2, rounds=2)
    (line,) = remarks(records, ROUNDS, ("ball", "disc", "rod"))[-1:]
    assert line.startswith("all 2 rounds were skipped, as they kept 2 of 30 clouds at most")
    assert "lower --self-training.threshold, give --self-training.threshold-share," in line
    assert "raise --self-training.threshold-share" in remarks(records, SWITCHES, "abc")[-1]
    few = remarks([replace(records[0], pool=5)], SWITCHES, "abc")[-1]
    assert few.endswith("give more clouds of the target: a round needs 6, 2 per class")
    assert remarks([replace(records[0], pool=6)], SWITCHES, "abc")[-1].endswith("better warm-up")
    one = replace(records[0], single_class=True, confident=(0, 9, 0), kept=(0, 9, 0), skipped=False)
    assert remarks([one], ROUNDS, ("ball", "disc", "rod")) == [
        "round 1: all 9 confident clouds were of one class, disc; 9 were kept"
    ]
    fine = replace(one, single_class=False)
    assert remarks([fine], ROUNDS, "abc") == []
    scratch, idle = replace(ROUNDS, init="scratch"), replace(records[1], kept=(0, 0, 0))
    assert remarks([fine], scratch, "abc") == remarks([fine, idle], ROUNDS, "abc") == []
    (line,) = remarks([replace(fine, steps=20), idle], scratch, "abc")
    assert line.startswith("all rounds after round 1 were skipped: the network, which began with")
    assert "trained for 20 steps on at most 9 of 30 clouds" in line


def test_empty_target(domains, settings):
    source, _ = domains
    empty = UnlabelledClouds(points=np.zeros((0, 64, 3), dtype=np.float32), ids=())
    with pytest.raises(InputError, match="target has no cloud"):
        self_train(new_model(settings, 3, 0), source, empty, settings, ROUNDS)


def test_rounds_have_a_learning_rate_of_their_own(arguments, warm, tmp_path):
    """Each round's first epoch starts at it."""
    gentle = replace(ROUNDS, learning_rate=1e-4)
    result = fit(*arguments, gentle, run_dir=tmp_path / "run", warm_up=warm)
    assert [record.learning_rates[0] for record in result.rounds] == pytest.approx([1e-4] * 3)
    with pytest.raises(InputError, match="learning_rate"):
        replace(ROUNDS, learning_rate=0.0)
