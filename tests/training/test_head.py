"""A head that learns from a few labelled scans: its name, its reach, its file."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.special import log_softmax

from qs3.answers import Classifier, evaluate
from qs3.errors import InputError
from qs3.evaluation.tables import average, frame
from qs3.runs import TrainSettings, read_run
from qs3.training import fit, load_model
from qs3.training.head import BIAS_DECAY, DECAY, fit_correction, train_head
from qs3.workflow.labels import read_labels
from qs3.workflow.training import HeadTraining

from .common import TRAIN, make_clouds, same

SETTINGS = TrainSettings(model="pointnet", **TRAIN)


def stretched(count, seed):
    """Clouds four times as wide as those of the source: labels help."""
    clouds = make_clouds(count, seed, noise=0.02)
    return replace(clouds, points=clouds.points * np.float32([4, 4, 1]))


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    folder = tmp_path_factory.mktemp("head") / "network"
    fit("source-only", make_clouds(), None, SETTINGS, run_dir=folder)
    return folder


FEW, REST = stretched(12, 1), stretched(30, 2)


def test_poisoned_labels_of_the_target_change_no_bit(network, tmp_path):
    """Labels come from the table alone, not from the folders where its files lie."""
    heads = []
    for case, shift in (("true", 0), ("wrong", 1), ("named", 1)):
        rows = ["file,class"]
        for number, label in enumerate(FEW.labels.tolist()):
            folder = tmp_path / case / FEW.class_names[(label + shift) % 3]
            folder.mkdir(parents=True, exist_ok=True)
            np.save(folder / f"{number}.npy", FEW.points[number])
            named = FEW.class_names[(label + (case == "named")) % 3]
            rows.append(f"{folder.name}/{number}.npy,{named}")
        table = tmp_path / f"{case}.csv"
        table.write_text("\n".join(rows))
        labelled = read_labels(table, FEW.class_names, tmp_path / case)
        train_head(network, labelled, run_dir=tmp_path / f"{case} run")
        heads.append((tmp_path / f"{case} run" / "model.safetensors").read_bytes())
    assert heads[0] == heads[1]
    assert heads[1] != heads[2]  # the poison would show


def test_labels_lift_the_accuracy_and_the_network_stays(network, tmp_path):
    run = train_head(network, FEW, run_dir=tmp_path / "few")
    before, after = (evaluate(place, REST) for place in (network, tmp_path / "few"))
    assert after.scores.accuracy > before.scores.accuracy + 0.1
    assert same(load_model(tmp_path / "few").model.model, load_model(network).model)
    assert (run.method, after.method) == ("few-label-head", "few-label-head")
    assert evaluate(tmp_path / "few", FEW).marks == ("training clouds",)
    assert "warm-up" in run.cpu_seconds
    assert read_run(tmp_path / "few").source == read_run(network).source
    both = frame([before, replace(after, seed=before.seed + 1)], [{"row": "a"}] * 2)
    with pytest.raises(InputError, match="not in the seed alone"):  # they never share a mean
        average(both, ["row"])


def test_a_saved_head_predicts_as_the_run(network, tmp_path):
    train_head(network, FEW, run_dir=tmp_path / "few")
    classifier = Classifier.load(tmp_path / "few")
    alone = Classifier.load(classifier.save(tmp_path / "copy") / "model.safetensors")
    assert np.array_equal(alone.predict_proba(REST), classifier.predict_proba(REST))
    with pytest.raises(InputError, match="labelled scans alone; use the network before it"):
        classifier.predict(REST, unknown=0.05)


@pytest.mark.slow
def test_a_head_is_exported_with_its_network(network, typed, tmp_path):
    train_head(network, FEW, run_dir=tmp_path / "few")
    lines = typed("export", tmp_path / "few", "--out", tmp_path / "few.onnx").stderr.splitlines()
    assert "on 16 random clouds" in lines[0]
    assert "resample(cloud" in lines[1]


def test_the_same_call_gives_the_same_bits_and_other_labels_are_another_run(network, tmp_path):
    for _ in range(2):
        train_head(network, FEW, run_dir=tmp_path / "few")
    again = train_head(network, FEW, run_dir=tmp_path / "again")
    first, second = (place / "model.safetensors" for place in (tmp_path / "few", again.folder))
    assert first.read_bytes() == second.read_bytes()
    wrong = replace(FEW, labels=(FEW.labels + 1) % 3)
    with pytest.raises(InputError, match="another --labels"):
        train_head(network, wrong, run_dir=tmp_path / "few")


def test_a_dry_run_refuses_what_the_training_refuses_and_writes_nothing(network, tmp_path):
    few = tmp_path / "few"
    plan = HeadTraining(network, FEW)
    assert plan.dry_run(few) == plan.dry_run(None) == [f"a head on {network}, 12 labelled scans"]
    assert not few.exists()
    train_head(network, FEW, run_dir=few)
    held = {path: path.read_bytes() for path in few.rglob("*") if path.is_file()}
    plan.dry_run(few)
    wrong = replace(FEW, labels=(FEW.labels + 1) % 3)
    with pytest.raises(InputError, match="another --labels"):
        HeadTraining(network, wrong).dry_run(few)
    with pytest.raises(InputError, match="without --labels"):
        plan.dry_run(network)
    with pytest.raises(InputError, match="few-label-head itself"):
        HeadTraining(few, FEW).dry_run(None)
    assert held == {path: path.read_bytes() for path in few.rglob("*") if path.is_file()}


@pytest.mark.parametrize(
    ("labelled", "fault"),
    [
        (replace(FEW, points=FEW.points * np.nan), "not finite"),
        (replace(FEW, class_names=("ball", "disc", "pole")), "other classes"),
    ],
)
def test_labelled_scans_are_checked(network, tmp_path, labelled, fault):
    with pytest.raises(InputError, match=fault):
        train_head(network, labelled, run_dir=tmp_path / "few")
    assert not (tmp_path / "few").exists()


def test_a_head_gets_no_second_head_and_no_rounds(network, tmp_path):
    train_head(network, FEW, run_dir=tmp_path / "few")
    with pytest.raises(InputError, match="few-label-head itself"):
        train_head(tmp_path / "few", FEW, run_dir=tmp_path / "more")
    with pytest.raises(InputError, match="is a run of method few-label-head"):
        fit("qbst", make_clouds(), REST.without_labels(), SETTINGS, run_dir=tmp_path / "rounds",
            warm_up=tmp_path / "few")  # fmt: skip
    # The file alone does not know its method.
    (tmp_path / "few" / "model.safetensors").rename(tmp_path / "alone.safetensors")
    with pytest.raises(InputError, match="name the network before its head"):
        fit("qbst", make_clouds(), REST.without_labels(), SETTINGS, run_dir=tmp_path / "rounds",
            warm_up=tmp_path / "alone.safetensors")  # fmt: skip


def test_labelled_scans_in_another_unit_are_refused(tmp_path):
    sized = replace(SETTINGS, preparation=replace(SETTINGS.preparation, size_input=True))
    fit("source-only", make_clouds(), None, sized, run_dir=tmp_path / "network")
    with pytest.raises(InputError, match="are they in millimetres"):
        far = FEW.points.copy()
        far[-1] *= 1000
        far = replace(FEW, points=far)
        train_head(tmp_path / "network", far, run_dir=tmp_path / "few")


def test_the_correction_is_the_minimum_of_its_loss():
    """An independent optimiser, in PyTorch, finds the same map."""
    rng = np.random.default_rng(0)
    features, logits = rng.normal(2, 3, size=(20, 4)), rng.normal(size=(20, 3))
    labels = rng.integers(3, size=20)
    weight, bias = fit_correction(features, logits, labels)
    centred = torch.from_numpy(features - features.mean(axis=0))
    inputs = centred / centred.square().sum(dim=1).mean().sqrt()
    counts = np.bincount(labels, minlength=3)[labels]
    shares = torch.from_numpy(counts**-0.5 / np.mean(counts**-0.5))
    shifts = [torch.zeros(size, dtype=torch.float64, requires_grad=True) for size in ((4, 3), (3,))]
    optimiser = torch.optim.LBFGS(shifts, max_iter=500, tolerance_grad=1e-9, tolerance_change=1e-14)

    def step():
        optimiser.zero_grad()
        scores = torch.from_numpy(logits) + inputs @ shifts[0] + shifts[1]
        losses = torch.nn.functional.cross_entropy(
            scores, torch.from_numpy(labels), reduction="none"
        )
        decay = DECAY * shifts[0].square().sum() + BIAS_DECAY * shifts[1].square().sum()
        value = (losses * shares).sum() + decay / 2
        value.backward()
        return value

    optimiser.step(step)
    wanted = (torch.from_numpy(logits) + inputs @ shifts[0] + shifts[1]).detach().numpy()
    found = logits + features @ weight + bias
    assert log_softmax(found, 1) == pytest.approx(log_softmax(wanted, 1), abs=1e-3)
