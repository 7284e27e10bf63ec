"""The number of CPU threads of a training."""

import logging
from dataclasses import replace

import pytest
import torch

from qs3.training import fit, read_run
from qs3.training.run import RunSettings, claim_run

from .common import Stop, stop_at


def test_the_setting_counts_then_the_run_then_the_machine(source, settings, tmp_path):
    cases = [(3, None, 3), (None, None, 4), (None, 2, 2), (3, 2, 3)]  # asked, begun with, chosen
    for case, (asked, begun, chosen) in enumerate(cases):
        wanted = RunSettings.of("source-only", source, None, settings, None, None)
        if begun is not None:
            with claim_run(tmp_path / str(case), replace(wanted, threads=begun), 4):
                pass
        with claim_run(tmp_path / str(case), replace(wanted, threads=asked), 4) as claimed:
            assert claimed.threads == chosen


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
    assert "began with threads = 2 and continues with 1: its last bits may differ" in caplog.text
    assert read_run(tmp_path).threads == 1
