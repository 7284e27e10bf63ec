"""What the tests of trainings share."""

import json

import torch

from qs3.training import history


class Stop(Exception):  # noqa: N818
    """Ends a run from a callback, as a kill would."""


def stop_after(epoch):
    """A callback that ends a training after an epoch."""

    def callback(record, method):
        if record.epoch == epoch:
            raise Stop

    return callback


def same(a, b):
    a, b = a.state_dict(), b.state_dict()
    return all(torch.equal(a[name], b[name]) for name in a)


def history_of(run_dir):
    return [json.loads(line) for line in (run_dir / history.HISTORY).read_text().splitlines()]
