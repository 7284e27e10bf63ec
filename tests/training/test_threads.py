"""The number of CPU threads of a training."""

import logging
from dataclasses import replace

import pytest
import torch

from qs3.runs import read_run
from qs3.training import fit

from .common import Stop, stop_at


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
