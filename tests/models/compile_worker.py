"""Compile networks and print how far their scores and gradients move, as JSON by name.

A process of its own: the compiler cannot trace the shape checks that the tests put around each
function, and some of its own steps warn.

Run: compile_worker.py BACKEND, with {name: [network, settings]} on standard input.
"""

import copy
import json
import sys

import torch

from qs3.models import create_model


def difference(network, settings, backend, train):
    torch.manual_seed(0)
    torch.compiler.reset()
    # In single precision gradients that cancel to almost nothing differ by all of themselves.
    model = create_model(network, 5, **settings).train(train).double()
    for layer in model.modules():
        if isinstance(layer, torch.nn.Dropout):
            layer.eval()
    points = torch.randn(4, 40, 3, generator=torch.Generator().manual_seed(0)).double()
    twin = copy.deepcopy(model)
    compiled = torch.compile(twin, backend=backend, dynamic=False)
    there, here = compiled(points), model(points)
    there.square().sum().backward()
    here.square().sum().backward()
    worst = float((there - here).abs().max() / here.abs().max())
    for one, two in zip(twin.parameters(), model.parameters(), strict=True):
        worst = max(worst, float((one.grad - two.grad).norm() / (two.grad.norm() + 1e-6)))
    return worst


if __name__ == "__main__":
    torch.set_num_threads(1)
    json.dump(
        {
            f"{name}, {'train' if train else 'eval'}": difference(*given, sys.argv[1], train)
            for name, given in json.load(sys.stdin).items()
            for train in (False, True)
        },
        sys.stdout,
    )
