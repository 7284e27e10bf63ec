"""PointNet with self-adaptive nodes: the laws of the nodes."""

import itertools

import numpy as np
import pytest
import torch

from qs3.models import create_model
from qs3.models.ops import farthest_point_sampling, gather_points
from qs3.paper.networks.pointnet_sa import PointNetSA, SANode

from ...models.common import close, clouds, make, textbook


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
        group = chosen[cloud, node]
        # 50 entries a ball: points outside count as the node itself, which does not pull.
        total = np.zeros(3)
        for other in range(50):
            if np.linalg.norm(x[other] - x[group]) <= 0.7:
                total += np.tanh(weight @ (f[other] - f[group])) * (x[other] - x[group])
        np.testing.assert_allclose(moved[cloud, node], x[group] + total / 50, atol=1e-12)


def farthest_first(points):
    """Clouds with the point farthest from the mean, ours first node, in the first place."""
    far = (points - points.mean(dim=1, keepdim=True)).norm(dim=2).argmax(dim=1)
    return torch.stack([cloud.roll(-int(i), 0) for cloud, i in zip(points, far, strict=True)])


@pytest.mark.parametrize("train", [True, False])
def test_is_the_release_if_the_first_node_is_ours_and_balls_are_exactly_full(train):
    """Its own sampling and balls, which are handed over nowhere here."""
    points = farthest_first(clouds(b=4, n=20))
    model = make("pointnet-sa", nodes=6, neighbours=20, radius=9.0).train(train)
    slow = textbook("pointnet-sa").from_ours(model)
    close(model(points), slow(points), 1e-9)


def test_a_ball_that_is_not_full_pulls_less_than_the_releases():
    """There its first point fills it and pulls each time; here the node does, which does not."""
    points = farthest_first(clouds(b=4, n=40))
    model = make("pointnet-sa", nodes=8, neighbours=40, radius=0.6)
    node, release = model.sa_node, textbook("pointnet-sa").from_ours(model).sa_node
    local = torch.randn(4, 40, 12).double()
    chosen, balls = release.grouped(points)
    assert torch.equal(chosen, farthest_point_sampling(points, 8))
    seen = node.offset(local)
    start = gather_points(points, chosen)[:, :, None]
    pull = torch.tanh(gather_points(seen, balls) - gather_points(seen, chosen)[:, :, None])
    pull = pull * (gather_points(points, balls) - start)
    moved = start[:, :, 0] + pull.mean(dim=2)
    torch.testing.assert_close(release(points, local)[0], moved, rtol=0, atol=1e-12)
    twice = torch.zeros(balls.shape, dtype=torch.bool)
    twice[:, :, 1:] = balls[:, :, 1:] == balls[:, :, :1]
    assert twice.any()
    moved = start[:, :, 0] + pull.masked_fill(twice[..., None], 0.0).mean(dim=2)
    torch.testing.assert_close(node.place(points, local, chosen), moved, rtol=0, atol=1e-12)


def test_nodes_stay_within_reach_and_move_with_the_cloud():
    torch.manual_seed(0)
    module = SANode(3, width=4, nodes=9, neighbours=12, radius=0.4).double().eval()
    with torch.no_grad():
        module.offset.weight.mul_(20)
    points, local = clouds(b=6), torch.randn(6, 60, 3).double()
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
    points, local = clouds(b=6), torch.randn(6, 60, 3).double()
    moved, features = module(points, local)
    values = module.residual(local)
    for cloud, node in itertools.product(range(6), range(9)):
        near = (points[cloud] - moved[cloud, node]).norm(dim=1).argsort()[:5]
        expected = values[cloud, near].amax(dim=0)
        torch.testing.assert_close(features[cloud, node], expected, rtol=0, atol=1e-12)


def test_steering_changes_the_gradient_alone():
    points, local = clouds(b=6), torch.randn(6, 60, 3).double()
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
    model = make("pointnet-sa", nodes=64, neighbours=64).eval()
    nodes = model.encode(clouds(b=6, n=n)).nodes
    assert nodes.shape == (6, 64, 6)
    known = min(n, 64)
    assert torch.equal(nodes, nodes[:, torch.arange(64) % known])
