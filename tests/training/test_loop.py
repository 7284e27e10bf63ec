from dataclasses import replace

import numpy as np
import pytest
import torch

from qs3.adaptation import Method, SourceOnly
from qs3.errors import InputError
from qs3.runs.weights import CHECKPOINT, new_model
from qs3.training import fit
from qs3.training.loop import batches, cosine, count_batches, train
from qs3.training.predict import predict_probabilities
from qs3.training.prepared import prepare_clouds
from qs3.training.trainer import describe_plan

from .common import same


def run(source, settings, seed=0, **arguments):
    method = SourceOnly(new_model(settings, 3, seed))
    history, _ = train(method, source, None, settings, **arguments)
    return method.model, history


def test_learns_the_training_set(source, settings):
    source = replace(source, points=prepare_clouds(source, 64).points)
    model, history = run(source, replace(settings, epochs=40))
    predictions = predict_probabilities(model, source.points).argmax(axis=1)
    assert (predictions == source.labels).mean() >= 0.95
    assert history[-1].losses["source"] < 0.5 * history[0].losses["source"]
    assert [record.epoch for record in history] == list(range(40))


def test_random_state_of_the_caller_is_untouched(source, settings):
    torch.manual_seed(3)
    expected = torch.rand(1)
    torch.manual_seed(3)
    run(source, settings)
    assert torch.equal(torch.rand(1), expected)


def test_checkpoint_of_another_stream_is_left_aside(source, settings, tmp_path):
    run(source, settings, run_dir=tmp_path, stream=(1, 1))
    other, _ = run(source, settings, run_dir=tmp_path, stream=(1, 2))
    assert same(other, run(source, settings, stream=(1, 2))[0])
    assert not same(other, run(source, settings, stream=(1, 1))[0])


def test_damaged_checkpoint_is_refused(source, settings, tmp_path):
    (tmp_path / CHECKPOINT).write_bytes(b"nothing of use")
    with pytest.raises(InputError, match=r"checkpoint\.safetensors"):
        run(source, settings, run_dir=tmp_path)


def test_checkpoint_of_another_network_is_refused(source, settings, tmp_path):
    run(source, settings, run_dir=tmp_path)
    with pytest.raises(InputError, match="another network"):
        run(source, replace(settings, model_settings={"hidden": (4,)}), run_dir=tmp_path)


def test_two_sets_share_each_step(source, target, settings):
    shapes = []

    class Watch(SourceOnly):
        def losses(self, source, target, progress, generator):
            shapes.append((len(source.labels), progress))
            return super().losses(source, target, progress, generator)

    few = source.select(np.arange(10))
    method = Watch(new_model(settings, 3, 0))
    train(method, [few, target], None, settings)
    # One pass over the first set: 8 and 2 of it; of the second always 8.
    assert [size for size, _ in shapes] == [16, 10] * settings.epochs
    assert [progress for _, progress in shapes] == [i / 8 for i in range(8)]


def test_target_reaches_a_method_that_uses_it(source, target, settings):
    class Sees(Method):
        uses_target = True

        def losses(self, source, target, progress, generator):
            assert target.shape[1:] == (64, 3)
            logits = self.model(source.points)
            return {"a": logits.square().mean(), "b": self.model(target).square().mean()}

    model = new_model(settings, 3, 0)
    history, _ = train(Sees(model), source, target.without_labels(), settings)
    assert set(history[0].losses) == {"a", "b"}
    with pytest.raises(InputError, match="Sees needs a target"):
        train(Sees(model), source, None, settings)


def test_one_cloud_is_too_few(source, settings):
    with pytest.raises(InputError, match="1 clouds are too few"):
        run(source.select(np.array([0])), settings)


def test_rate_follows_the_cosine(source, settings):
    _, history = run(source, settings)
    expected = [settings.learning_rate * cosine(e, 4) for e in range(4)]
    assert [record.learning_rate for record in history] == pytest.approx(expected)
    reference = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=1.0)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(reference, T_max=4)
    for epoch in range(9):
        assert schedule.get_last_lr()[0] == pytest.approx(cosine(epoch, 4), abs=1e-9)
        reference.step()
        schedule.step()


@pytest.mark.parametrize("count", [2, 3, 8, 9, 10, 17])
def test_batches_hold_each_cloud_once_but_for_a_last_single_one(count):
    cut = list(batches(count, 4, np.random.default_rng(0)))
    assert len(cut) == count_batches(count, 4)
    assert min(map(len, cut)) >= 2
    rows = np.concatenate(cut)
    assert len(set(rows.tolist())) == len(rows) == count - (count % 4 == 1)


def test_steps_are_those_of_the_training(source, target, settings, tmp_path):
    """The longer of both domains is one pass, where the method uses the target."""
    settings = replace(settings, epochs=1, validate_every=0)
    for method in ("source-only", "dann:DANN"):
        plan = describe_plan(method, source, target.without_labels(), settings, None)
        done = fit(method, source, target.without_labels(), settings, run_dir=tmp_path / method)
        (epoch,) = done.history
        steps = epoch.steps
        assert plan[1] == f"training  {method}, 1 epochs of {steps} steps of 8 clouds: {steps}"
