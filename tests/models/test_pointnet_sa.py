"""PointNet with self-adaptive nodes against its textbook form, and the laws of the nodes."""

import itertools

import numpy as np
import pytest
import torch
from torch import nn

from qs3.models import PointNetSA, create_model
from qs3.models.ops import farthest_point_sampling, gather_points
from qs3.models.pointnet_sa import SANode, fill_nodes

from .common import randomise
from .common import textbook as load_textbook

textbook = load_textbook("pointnet_sa")


def make(dtype=torch.float64, **settings):
    torch.manual_seed(0)
    settings = {"nodes": 10, "neighbours": 7, "radius": 0.5, "node_width": 6} | settings
    model = PointNetSA(5, (8, 12, 16, 24), (16, 8), hidden=(8,), **settings).to(dtype)
    randomise(model)
    for transform in (model.input_transform, model.feature_transform):
        nn.init.normal_(transform.regress.layers[-1].weight, std=0.1)
    return model


def clouds(kind="plain", b=6, n=60, dtype=torch.float64):
    points = torch.randn(b, n, 3, generator=torch.Generator().manual_seed(1), dtype=dtype) * 0.4
    if kind == "far":
        return points + 30
    return points[:, :4].contiguous() if kind == "few" else points


@pytest.mark.parametrize("kind", ["plain", "far", "few"])
@pytest.mark.parametrize("train", [True, False])
def test_scores_gradients_and_statistics_are_those_of_the_textbook(kind, train):
    ours = make().train(train)
    theirs = textbook.from_ours(ours)
    points = clouds(kind)
    scores, goal = ours(points), theirs(points)
    torch.testing.assert_close(scores, goal, rtol=1e-9, atol=1e-9)
    weights = torch.randn(scores.shape, generator=torch.Generator().manual_seed(2)).double()
    (scores * weights).sum().backward()
    (goal * weights).sum().backward()
    pairs = textbook.pairs(ours, theirs)
    assert {id(p) for fast, _ in pairs for p in fast.parameters()} == {
        id(p) for p in ours.parameters()
    }
    for fast, slow in pairs:
        for name, parameter in fast.named_parameters():
            expected = slow.get_parameter(name).grad.view_as(parameter)
            scale = float(expected.abs().max()) + 1.0
            torch.testing.assert_close(parameter.grad, expected, rtol=0, atol=1e-8 * scale)
        for name, buffer in fast.named_buffers():
            torch.testing.assert_close(buffer, slow.get_buffer(name), rtol=1e-9, atol=1e-9)


def test_the_published_sizes():
    model = create_model("pointnet-sa", 10)
    assert isinstance(model, PointNetSA)
    features = model.eval().encode(torch.randn(2, 100, 3))
    assert features.nodes.shape == (2, 64, 64)
    assert features.local.shape == (2, 100, 128)
    assert features.pooled.shape == (2, 1024)
    head = [p.shape for p in model.classify.parameters()]
    assert head == [(10, 1024), (10,)]


def test_offsets_follow_the_formula():
    torch.manual_seed(0)
    module = SANode(5, width=4, nodes=6, neighbours=50, radius=0.7).double()
    points, local = clouds(b=2, n=50), torch.randn(2, 50, 5).double()
    weight = module.offset.weight.detach().numpy()
    chosen = farthest_point_sampling(points, 6).numpy()
    moved = module.place(points, local, torch.from_numpy(chosen)).detach().numpy()
    for cloud, node in itertools.product(range(2), range(6)):
        x, f = points[cloud].numpy(), local[cloud].numpy()
        own = chosen[cloud, node]
        # 50 entries a ball: points outside count as the node itself, which does not pull.
        total = np.zeros(3)
        for other in range(50):
            if np.linalg.norm(x[other] - x[own]) <= 0.7:
                total += np.tanh(weight @ (f[other] - f[own])) * (x[other] - x[own])
        np.testing.assert_allclose(moved[cloud, node], x[own] + total / 50, atol=1e-12)


def test_nodes_stay_within_reach_and_move_with_the_cloud():
    torch.manual_seed(0)
    module = SANode(3, width=4, nodes=9, neighbours=12, radius=0.4).double().eval()
    with torch.no_grad():
        module.offset.weight.mul_(20)
    points, local = clouds(), torch.randn(6, 60, 3).double()
    moved, features = module(points, local)
    start = gather_points(points, farthest_point_sampling(points, 9))
    away = (moved - start).abs()
    assert 0 < away.max() <= 0.4
    shifted = module(points + 5, local)
    torch.testing.assert_close(shifted.positions, moved + 5, rtol=0, atol=1e-9)
    torch.testing.assert_close(shifted.features, features, rtol=0, atol=1e-9)


def test_a_node_takes_the_maximum_around_its_new_place():
    torch.manual_seed(0)
    module = SANode(3, width=4, nodes=9, neighbours=5, radius=0.4).double().eval()
    points, local = clouds(), torch.randn(6, 60, 3).double()
    moved, features = module(points, local)
    values = module.residual(local)
    for cloud, node in itertools.product(range(6), range(9)):
        near = (points[cloud] - moved[cloud, node]).norm(dim=1).argsort()[:5]
        expected = values[cloud, near].amax(dim=0)
        torch.testing.assert_close(features[cloud, node], expected, rtol=0, atol=1e-12)


def test_steering_changes_the_gradient_alone():
    points, local = clouds(), torch.randn(6, 60, 3).double()
    results = []
    for steered in (False, True):
        torch.manual_seed(0)
        module = SANode(3, width=4, nodes=9, neighbours=5, steered=steered).double()
        value = module(points, local).features
        value.square().sum().backward()
        results.append((value.detach(), module.offset.weight.grad, module.residual))
    (plain, none, before), (same, slope, after) = results
    torch.testing.assert_close(plain, same, rtol=0, atol=1e-12)
    assert none is None
    assert slope.abs().sum() > 0
    for one, two in zip(before.parameters(), after.parameters(), strict=True):
        torch.testing.assert_close(one.grad, two.grad, rtol=0, atol=1e-12)


@pytest.mark.parametrize("n", [1, 2, 5, 64, 65])
def test_small_clouds_have_as_many_nodes_in_features(n):
    model = make(nodes=64, neighbours=64).eval()
    nodes = model.encode(clouds(n=n)).nodes
    assert nodes.shape == (6, 64, 6)
    known = min(n, 64)
    assert torch.equal(nodes, nodes[:, torch.arange(64) % known])


@pytest.mark.parametrize("train", [True, False])
def test_equal_points_give_finite_nodes_and_gradients(train):
    model = make(torch.float32).train(train)
    features = model.encode(torch.zeros(3, 20, 3))
    (features.nodes.sum() + model.head(features).sum()).backward()
    assert features.nodes.isfinite().all()
    assert all(p.grad.isfinite().all() for p in model.parameters())


def test_filling_repeats_in_order():
    nodes = torch.arange(6.0).view(1, 3, 2)
    assert fill_nodes(nodes, 3) is nodes
    assert fill_nodes(nodes, 7)[0, :, 0].tolist() == [0, 2, 4, 0, 2, 4, 0]
