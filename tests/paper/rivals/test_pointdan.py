"""PointDAN: its parts against plain formulae, its game of two, and networks of any kind."""

import math

import numpy as np
import pytest
import torch
from torch import nn

from qs3.adaptation.method import Batch, cross_entropy
from qs3.models import create_model
from qs3.paper.rivals.mmd import mmd
from qs3.paper.rivals.pointdan import NodeAttention, PointDAN

from ...models.common import SMALL

NETWORKS = ["pointnet-sa", "pointnet", "dgcnn", "pointnet2"]


def make(name, seed=0, dropout=0.0, **settings):
    torch.manual_seed(seed)
    model = create_model(name, 3, **SMALL[name], dropout=dropout)
    if name != "pointnet-sa":
        settings = {"nodes": 10, "neighbours": 6, "node_width": 4} | settings
    return PointDAN(model, **settings)


def batches(b=4, b_t=5, n=40, n_t=30, seed=0):
    generator = torch.Generator().manual_seed(seed)
    points = 0.5 * torch.randn(b, n, 3, generator=generator)
    target = 0.5 * torch.randn(b_t, n_t, 3, generator=generator) * torch.tensor([1.0, 0.6, 1.4])
    return Batch(points, torch.arange(b) % 3), target


def run(method, progress=0.5, **sizes):
    source, target = batches(**sizes)
    return method(source, target, progress, torch.Generator())


@pytest.mark.parametrize("name", NETWORKS)
def test_terms_follow_the_formulae(name):
    method = make(name, source_weight=0.5, discrepancy_weight=2.0, node_weight=3.0)
    method.eval()
    source, target = batches()
    losses = {key: value.item() for key, value in run(method).items()}
    with torch.no_grad():
        here, there = method.model.encode(source.points), method.model.encode(target)
        one, two = method.model.head(here), method.second.head(here)
        expected = cross_entropy(one, source.labels) + cross_entropy(two, source.labels)
        assert losses["source"] == pytest.approx(0.5 * expected.item(), rel=1e-5)
        p1 = method.model.head(there).softmax(dim=1).numpy()
        p2 = method.second.head(there).softmax(dim=1).numpy()
        assert losses["discrepancy"] == pytest.approx(-2 * np.abs(p1 - p2).mean(), rel=1e-5)
        nodes = [method.nodes_of(source.points, here), method.nodes_of(target, there)]
        x = method.attention["source"](nodes[0])
        y = method.attention["target"](nodes[1])
        expected = 3 * mmd(x, y, (0.01, 0.1, 1.0, 10.0, 100.0)).item()
        assert losses["nodes"] == pytest.approx(expected, rel=1e-5)


def test_the_classifiers_part_and_the_network_brings_them_together():
    method = make("pointnet").train()
    progress = 0.4
    run(method, progress)["discrepancy"].backward()
    turned = {key: p.grad.clone() for key, p in method.named_parameters() if p.grad is not None}
    method = make("pointnet").train()
    _, target = batches()
    method.model.encode(batches()[0].points)  # as much has passed
    there = method.model.encode(target)
    p1, p2 = (head.head(there).softmax(dim=1) for head in (method.model, method.second))
    (-(p1 - p2).abs().mean()).backward()
    assert turned.keys() == {k for k, p in method.named_parameters() if p.grad is not None}
    assert {"model.early.0.linear.weight", "second.classify.layers.0.weight"} <= turned.keys()
    for key, parameter in method.named_parameters():
        if key in turned:
            is_head = "classify" in key
            factor = 1.0 if is_head else -math.sin(0.2 * math.pi)
            torch.testing.assert_close(turned[key], factor * parameter.grad, rtol=1e-4, atol=1e-7)


def test_attention_is_the_published_formula():
    torch.manual_seed(0)
    layer = NodeAttention(12, reduction=4).double()
    x = torch.randn(5, 4, 3).double()
    flat = x.reshape(5, 12).numpy()
    first, _, second, _ = layer.weigh
    hidden = np.maximum(flat @ first.weight.detach().numpy().T + first.bias.detach().numpy(), 0)
    assert hidden.shape == (5, 3)
    weight = hidden @ second.weight.detach().numpy().T + second.bias.detach().numpy()
    y = flat / (1 + np.exp(-weight)) + flat
    expected = (y - y.mean(axis=0)) / np.sqrt(y.var(axis=0) + 1e-5)
    np.testing.assert_allclose(layer(x).detach().numpy(), expected, atol=1e-10)


def test_each_domain_has_an_attention_of_its_own():
    method = make("pointnet").eval()
    before = {key: value.item() for key, value in run(method).items()}
    with torch.no_grad():
        method.attention["target"].norm.bias.add_(3.0)
    after = {key: value.item() for key, value in run(method).items()}
    assert after["nodes"] > before["nodes"] + 0.001
    assert after["source"] == before["source"]
    assert not torch.equal(
        method.attention["source"].weigh[0].weight, method.attention["target"].weigh[0].weight
    )


@pytest.mark.parametrize("name", NETWORKS)
def test_the_second_head_has_fresh_weights(name):
    method = make(name, dropout=0.3)
    first, second = method.model.classify, method.second.classify
    plain = create_model(name, 3, **SMALL[name]).classify
    shapes = [(key, value.shape) for key, value in second.state_dict().items()]
    assert shapes == [(key, value.shape) for key, value in plain.state_dict().items()]
    assert [p.p for p in second.modules() if isinstance(p, nn.Dropout)] == [
        p.p for p in first.modules() if isinstance(p, nn.Dropout)
    ]
    assert [name for name, _ in method.second.named_children()] == ["classify"]
    assert not torch.equal(first.layers[-1].weight, second.layers[-1].weight)
    pointers = {p.data_ptr() for p in method.model.parameters()}
    assert not pointers & {p.data_ptr() for p in method.second.parameters()}
    losses = run(method.train())
    assert all(value.isfinite() for value in losses.values())


@pytest.mark.parametrize("name", NETWORKS)
def test_classifiers_learn_twice_as_fast(name):
    method = make(name)
    others, classifiers = method.parameter_groups(1e-4)
    assert (others["lr"], classifiers["lr"]) == (1e-4, 2e-4)
    both = [id(p) for group in (others, classifiers) for p in group["params"]]
    assert len(both) == len(set(both))
    assert set(both) == {id(p) for p in method.parameters()}
    expected = [*method.model.classify.parameters(), *method.second.parameters()]
    assert {id(p) for p in classifiers["params"]} == {id(p) for p in expected}
