"""Clipping, accuracy, faults by name, logs, kills."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from dataclasses import asdict, replace

import numpy as np
import pytest
import torch

from qs3.adaptation import SourceOnly
from qs3.errors import InputError, QS3Error
from qs3.runs import SelfTrainingSettings
from qs3.runs.history import HISTORY
from qs3.runs.weights import new_model
from qs3.training import fit
from qs3.training.loop import train

from .common import Stop, history_of, plain, same


def test_accuracy_is_that_of_the_labelled_batches(source, settings):
    hits = []

    class Watch(SourceOnly):
        def losses(self, source, target, progress, generator):
            logits = self.model(source.points)
            hits.append((logits.argmax(dim=1) == source.labels).float().mean().item())
            return {"source": self.classification(logits, source)}

    history, _ = train(Watch(new_model(settings, 3, 0)), source, None, settings)
    expected = np.array(hits).reshape(settings.epochs, -1).mean(axis=1)
    assert [record.accuracy for record in history] == pytest.approx(expected.tolist())
    assert all(record.samples_per_second > 0 for record in history)

    class Silent(SourceOnly):
        def losses(self, source, target, progress, generator):
            return {"source": self.model.head(self.model.encode(source.points)).square().mean()}

    history, _ = train(Silent(new_model(settings, 3, 0)), source, None, settings)
    assert [record.accuracy for record in history] == [None] * settings.epochs


def test_loss_that_is_not_finite_names_the_clouds(source, settings, tmp_path):
    class Diverges(SourceOnly):
        def losses(self, source, target, progress, generator):
            losses = super().losses(source, target, progress, generator)
            return {"source": losses["source"] * (math.inf if progress >= 0.5 else 1.0)}

    message = (
        r"loss is inf in epoch 2, batch 0 \(clouds 0-\d+, .* and 4 more\); train .* new folder"
    )
    with pytest.raises(QS3Error, match=message):
        train(Diverges(new_model(settings, 3, 0)), source, None, settings)
    broken = source.points.copy()
    broken[7, 3, 1] = np.nan
    broken[9] = np.inf
    bad = replace(source, points=broken)
    message = "points of clouds 0-7, 0-9 are not finite; leave"
    with pytest.raises(InputError, match=message):
        train(SourceOnly(new_model(settings, 3, 0)), bad, None, settings)
    with pytest.raises(InputError, match=message):
        fit("source-only", bad, None, settings, run_dir=tmp_path / "run")
    with pytest.raises(InputError, match="target: points of clouds 000007, 000009 are not"):
        fit("qbst", source, bad.without_labels(), settings, run_dir=tmp_path / "run")
    assert not (tmp_path / "run").exists()  # the corrected call may use the folder


class _Spoilt(SourceOnly):
    """A gradient that is NaN in one step, under a finite loss."""

    def losses(self, source, target, progress, generator):
        loss = super().losses(source, target, progress, generator)["source"]
        if 0.5 <= progress < 0.51:
            loss = loss + torch.sqrt(self.model.classify.layers[-1].bias.sum() * 0.0)
        return {"source": loss}


def test_gradient_that_is_not_finite_leaves_the_checkpoint_good(source, settings, tmp_path):
    message = r"gradient is nan in epoch 2, batch 0 \(clouds 0-\d+, .*; train .* new folder"
    with pytest.raises(QS3Error, match=message):
        train(_Spoilt(new_model(settings, 3, 0)), source, None, settings, run_dir=tmp_path)
    resumed, whole = (SourceOnly(new_model(settings, 3, 0)) for _ in range(2))
    train(resumed, source, None, settings, run_dir=tmp_path)
    train(whole, source, None, settings)
    assert same(resumed, whole)


def test_history_is_there_after_each_epoch_and_repeats_nothing(source, settings, tmp_path):
    seen = []

    def look(record, method):
        epochs = [line for line in history_of(tmp_path) if line["kind"] == "epoch"]
        seen.append([line["epoch"] for line in epochs])
        if record.epoch == 1 and len(seen) == 2:
            raise Stop

    with pytest.raises(Stop):
        fit("source-only", source, None, settings, run_dir=tmp_path, on_epoch=look)
    fit("source-only", source, None, settings, run_dir=tmp_path, on_epoch=look)
    assert seen == [[0], [0, 1], [0, 1, 2], [0, 1, 2, 3]]
    assert not list(tmp_path.glob("*.csv"))


def test_statistics_stay_in_full_precision_under_bf16(source, settings):
    """Running statistics under bf16 are those of single precision, to the rounding of bf16."""
    buffers = {}
    for precision in ("32-true", "bf16-mixed"):
        method = SourceOnly(new_model(settings, 3, 0))
        changed = replace(settings, epochs=1, batch_size=24, precision=precision)
        train(method, source, None, changed)
        buffers[precision] = dict(method.model.named_buffers())
    for name, buffer in buffers["bf16-mixed"].items():
        assert buffer.dtype == buffers["32-true"][name].dtype
        torch.testing.assert_close(buffer, buffers["32-true"][name], rtol=0.05, atol=0.02)


SCRIPT = """
import json, sys
import numpy as np
from pathlib import Path
from qs3.clouds.types import PointClouds, UnlabelledClouds
from qs3.structure import structure
from qs3.runs import SelfTrainingSettings
from qs3.runs import TrainSettings
from qs3.training import fit
data, run = np.load(sys.argv[1]), Path(sys.argv[2])
settings, rounds = json.loads(sys.argv[3])
train = structure(settings, TrainSettings, "settings")
names = ("ball", "disc", "rod")
source = PointClouds(data["points"], data["labels"], names, tuple(map(str, range(24))))
target = UnlabelledClouds(data["target"], tuple(map(str, range(30))))
fit("qbst", source, target, train, SelfTrainingSettings(**rounds), run_dir=run)
"""


@pytest.mark.slow
@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGINT])
def test_killed_in_the_middle_of_an_epoch_is_uninterrupted(
    source, target, settings, tmp_path, ending
):
    settings = replace(settings, epochs=12, num_points=32)
    rounds = SelfTrainingSettings(rounds=2, epochs=40, threshold=0.34)
    arguments = ("qbst", source, target.without_labels(), settings, rounds)
    whole = fit(*arguments, run_dir=tmp_path / "whole")
    np.savez(
        tmp_path / "data.npz", points=source.points, labels=source.labels, target=target.points
    )
    cut = tmp_path / "cut"
    for lines in (4, 15):  # in the warm-up, and in the first round
        process = subprocess.Popen(
            [sys.executable, "-c", SCRIPT, str(tmp_path / "data.npz"), str(cut),
             json.dumps([asdict(settings), asdict(rounds)])],
            stderr=subprocess.DEVNULL,
        )  # fmt: skip
        while not (cut / HISTORY).exists() or len(history_of(cut)) < lines:
            assert process.poll() is None
            time.sleep(0.005)
        time.sleep(0.02)
        assert process.poll() is None
        os.kill(process.pid, ending)
        assert process.wait() != 0
    result = fit(*arguments, run_dir=cut)
    assert same(whole.model, result.model)
    assert plain(history_of(cut)) == plain(history_of(tmp_path / "whole"))
