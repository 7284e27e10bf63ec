"""Two CPU processes that train together over the loopback interface."""

import copy
import json
import multiprocessing
import os
import signal
from dataclasses import replace
from operator import methodcaller

import numpy as np
import pytest
import torch

from qs3.adaptation import SourceOnly
from qs3.errors import TOLD, InputError, QS3Error
from qs3.training import SelfTrainingSettings, fit, load_model
from qs3.training import distributed as module
from qs3.training.batches import DeviceClouds, Share, make_batch
from qs3.training.checkpoint import derived_seed, new_model, read_tensors, seed_sequence
from qs3.training.distributed import all_devices, gather_rows, has_bf16_units, make_fabric
from qs3.training.prepared import prepare_clouds
from qs3.training.state import CHECKPOINT

from .common import Stop, plain, same, stop_at


@pytest.fixture
def two(settings):
    return replace(settings, devices=2)


def test_one_step_of_two_devices_is_the_step_written_out(source, two, tmp_path):
    """Each share has its own batch statistics; gradients are the mean over all clouds."""
    source = source.select(np.arange(23))  # shares of 12 and 11
    small = {**two.model_settings, "dropout": 0.0}
    settings = replace(two, epochs=1, batch_size=32, model_settings=small, clip_norm=0.05)
    result = fit("source-only", source, None, settings, run_dir=tmp_path / "run")

    model = new_model(settings, 3, derived_seed(settings.seed, 0))
    rng = np.random.default_rng(seed_sequence(settings.seed, 0, 0))
    augmentation = int(rng.integers(2**62, size=3)[0])
    order = rng.permutation(23)
    clouds = DeviceClouds(prepare_clouds(source, 64), torch.device("cpu"))
    gradients, losses, buffers = [], [], None
    for rank in range(2):
        replica = copy.deepcopy(model)
        generator = torch.Generator().manual_seed(augmentation)
        batch = make_batch([clouds], [order], settings, generator, Share(rank, 2))
        assert len(batch.labels) == (12, 11)[rank]
        loss = SourceOnly(replica).losses(batch, None, 0.0, generator)["source"]
        loss.backward()
        gradients.append([p.grad * len(batch.labels) / 23 for p in replica.parameters()])
        losses.append(float(loss.detach()) * len(batch.labels) / 23)
        buffers = buffers or dict(replica.named_buffers())
    for parameter, *parts in zip(model.parameters(), *gradients, strict=True):
        parameter.grad = parts[0] + parts[1]
    torch.nn.utils.clip_grad_norm_(model.parameters(), 0.05)
    # Adam's first moment after one step is a tenth of the gradient. (Its step itself would blow up
    # the rounding of gradients that are zero but for rounding.)
    moments, _ = read_tensors(tmp_path / "run" / CHECKPOINT)
    for index, parameter in enumerate(model.parameters()):
        expected = 0.1 * (parameter.grad + settings.weight_decay * parameter.detach())
        got = moments[f"optimiser/{index}.exp_avg"]
        torch.testing.assert_close(got, expected, rtol=1e-4, atol=1e-7)
    for name, buffer in buffers.items():  # those of the first device
        torch.testing.assert_close(result.model.get_buffer(name), buffer)
    assert result.history[0].losses["source"] == pytest.approx(sum(losses), rel=1e-5)
    assert same(load_model(tmp_path / "run").model, result.model)


def test_a_killed_process_ends_all_with_a_message(source, two, tmp_path, monkeypatch):
    monkeypatch.setattr(module.tempfile, "tempdir", str(tmp_path))

    def kill(record, method):
        assert list(tmp_path.glob("qs3-*/meeting"))
        if record.epoch == 1:
            (other,) = multiprocessing.active_children()
            os.kill(other.pid, signal.SIGKILL)

    with pytest.raises(QS3Error, match=r"device 1 was killed \(signal 9\); run the same again"):
        fit("source-only", source, None, two, run_dir=tmp_path / "run", on_epoch=kill)
    assert not multiprocessing.active_children()
    assert not torch.distributed.is_initialized()
    assert not {"MASTER_ADDR", "GLOO_SOCKET_IFNAME"} & set(os.environ)
    assert not list(tmp_path.glob("qs3-*"))
    lines = (tmp_path / "run" / "history.jsonl").read_text().splitlines()
    assert [json.loads(line)["epoch"] for line in lines] == [0, 1]


@pytest.mark.slow
def test_resumed_is_uninterrupted(source, target, two, tmp_path):
    """Averaged weights, clipping and rounds of self-training, stopped in the middle of each."""
    settings = replace(two, epochs=24, ema_decay=0.8, clip_norm=1.0)
    rounds = SelfTrainingSettings(rounds=2, epochs=4, threshold=0.34, teacher="best")
    arguments = ("qbst", source, target.without_labels(), settings, rounds)
    whole = fit(*arguments, run_dir=tmp_path / "whole")
    assert not whole.rounds[0].skipped
    for limit in (3, 23):
        with pytest.raises(Stop):
            fit(*arguments, run_dir=tmp_path / "cut", on_epoch=stop_at(limit))
    resumed = fit(*arguments, run_dir=tmp_path / "cut")
    assert same(whole.model, resumed.model)
    assert plain(whole.rounds) == plain(resumed.rounds)


def test_the_fault_of_another_process_is_told(two):
    with (
        pytest.raises(QS3Error, match=r"device 1 failed: AttributeError: .*nonsense"),
        all_devices(two, methodcaller("nonsense")) as fabric,
    ):
        fabric.barrier()


def test_settings_that_cannot_be(settings, source, tmp_path):
    with pytest.raises(InputError, match="batch_size = 3 must be at least 4, 2 a device"):
        replace(settings, devices=2, batch_size=3)
    if not torch.cuda.is_available():
        wrong = replace(settings, devices=2, accelerator="cuda")
        with pytest.raises(InputError, match="accelerator 'cuda' with devices = 2"):
            fit("source-only", source, None, wrong, run_dir=tmp_path / "run")
        assert not (tmp_path / "run").exists()


def test_one_device_gathers_its_own_rows(settings):
    rows = np.arange(6.0).reshape(3, 2)
    assert np.array_equal(gather_rows(rows, slice(0, 3), 3, make_fabric(settings)), rows)


def test_a_number_format_that_a_cpu_lacks_is_refused(settings):
    with pytest.raises(InputError, match="16-mixed needs a GPU"):
        make_fabric(replace(settings, precision="16-mixed"))


def test_slow_bf16_is_told_once(settings, monkeypatch, caplog):
    monkeypatch.setattr(module, "has_bf16_units", lambda: False)
    TOLD.clear()
    for _ in range(2):
        make_fabric(replace(settings, precision="bf16-mixed"))
    make_fabric(settings)
    assert [r.message[:10] for r in caplog.records if r.name.startswith("qs3")] == ["bf16-mixed"]
    assert isinstance(has_bf16_units(), bool)
