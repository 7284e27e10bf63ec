"""How many CPU threads: asked for, by rule, by timing; and what is kept of it."""

import json
import logging
from dataclasses import replace

import pytest
import torch

from qs3.training import fit, read_run, threads
from qs3.training.distributed import make_fabric
from qs3.training.job import fresh_model, make_method
from qs3.training.threads import choose_threads, describe_threads, fastest, trial_step

from .common import Stop, same, stop_at


@pytest.fixture
def four():
    """A machine of four cores."""
    before = torch.get_num_threads()
    torch.set_num_threads(4)
    yield
    torch.set_num_threads(before)


def test_the_rule_needs_no_clock(settings, four, monkeypatch):
    monkeypatch.setattr(threads, "fastest", lambda step, most: most - 1)
    cases = [  # asked for, begun with, devices, chosen
        (3, None, 1, 3),
        (None, None, 1, 4),
        (None, None, 2, 1),
        (3, None, 2, 3),
        (None, 2, 1, 2),
        ("auto", None, 1, 3),
        ("auto", 2, 1, 2),
        ("auto", None, 2, 1),
    ]
    for asked, begun, devices, chosen in cases:
        changed = replace(settings, threads=asked, devices=devices)
        assert choose_threads(changed, begun, lambda: lambda: None) == chosen
    assert choose_threads(replace(settings, threads="auto"), None, None) == 4


def test_timing_takes_the_fastest_and_the_fewer_of_equals(monkeypatch):
    now = [0.0]
    monkeypatch.setattr(threads.time, "perf_counter", lambda: now[0])

    def on(seconds):
        def step():
            now[0] += seconds[torch.get_num_threads()]

        return step

    before = torch.get_num_threads()
    assert fastest(on({1: 1.0, 2: 0.6, 4: 0.5, 6: 0.5}), 6) == 4
    assert fastest(on({1: 1.0, 2: 2.0, 4: 4.0}), 4) == 1  # a busy machine
    assert fastest(on({1: 60.0, 2: 59.0}), 2) == 1
    assert now[0] < 300.0  # slow steps are timed once after the first
    assert fastest(on({}), 1) == 1
    assert torch.get_num_threads() == before


def test_a_timed_run_is_that_of_its_number(source, target, settings, tmp_path, monkeypatch):
    """Neither the random state nor the weights know of the timing; the number is kept."""
    steps = []

    def timed(step, most):
        steps.extend([step(), step()])
        return 1

    monkeypatch.setattr(threads, "fastest", timed)
    target = target.without_labels()
    results = []
    for name, count in (("asked", 1), ("timed", "auto")):
        torch.manual_seed(0)
        changed = replace(settings, epochs=1, threads=count)
        results.append(fit("dann", source, target, changed, run_dir=tmp_path / name).model)
        assert torch.initial_seed() == 0
        assert torch.rand(1).item() == pytest.approx(0.4962566)
    assert same(*results)
    assert len(steps) == 2
    for name in ("asked", "timed"):
        assert read_run(tmp_path / name).threads == 1
        assert json.loads((tmp_path / name / "settings.json").read_text())["threads"] == 1


def test_a_resumed_run_keeps_its_number(source, settings, tmp_path, caplog):
    def go_on(count, **options):
        changed = replace(settings, threads=count)
        fit("source-only", source, None, changed, run_dir=tmp_path, **options)

    def note(record, method):
        counts.append(torch.get_num_threads())
        raise Stop

    counts = []
    with pytest.raises(Stop):
        go_on(2, on_epoch=stop_at(1))
    with pytest.raises(Stop):
        go_on(None, on_epoch=note)
    assert counts == [2]
    assert not caplog.records
    with caplog.at_level(logging.WARNING):
        go_on(1)
    assert "begun with threads = 2 and goes on with 1: its last bits may differ" in caplog.text
    assert read_run(tmp_path).threads == 1


def test_a_step_to_be_timed_needs_no_clouds(settings):
    method = make_method("dann", fresh_model("dann", settings, 3), settings)
    step = trial_step(method, 3, settings, make_fabric(settings))
    before = torch.get_rng_state()
    step()
    assert torch.equal(torch.get_rng_state(), before)
    assert all(p.grad is not None for p in method.model.parameters())


def test_what_is_set_is_told(monkeypatch):
    monkeypatch.setenv("GOMP_SPINCOUNT", "1000")
    monkeypatch.delenv("OMP_WAIT_POLICY", raising=False)
    assert "GOMP_SPINCOUNT 1000" in describe_threads()
    assert "OMP_WAIT_POLICY not set" in describe_threads()
