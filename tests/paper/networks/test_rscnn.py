"""RS-CNN: its convolution edge by edge, its groups by brute force."""

import numpy as np
import pytest
import torch

from qs3.paper.networks.rscnn import RSCNN

from ...models.common import SMALL, normed, randomise


def make(**settings):
    """A small network whose normalisations have scales of both signs and some history."""
    torch.manual_seed(0)
    model = RSCNN(5, **SMALL["rscnn"] | {"hidden": (12, 8), "dropout": 0.0} | settings).double()
    randomise(model, 0.3, 1.5)
    return model


def clouds(b=4, n=40):
    points = torch.randn(b, n, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    return points * 0.6


def edge_by_edge(layer, points, features, samples, neighbours):
    """Liu et al., §3.1 and Fig. 3, in NumPy: h_ij, its map, the weighted features, the maximum."""
    relations, values = [], []
    b, m, k = neighbours.shape
    for cloud in range(b):
        for centre in range(m):
            for j in neighbours[cloud, centre].tolist():
                x_i, x_j = (points[cloud, i].numpy() for i in (samples[cloud, centre], j))
                away = x_j - x_i
                relations.append(np.concatenate([[np.linalg.norm(away)], x_i, x_j, away]))
                kept = [] if features is None else [features[cloud, j].detach().numpy()]
                values.append(np.concatenate([away, *kept]))

    def linear(part, rows):
        bias = 0.0 if part.bias is None else part.bias.detach().numpy()
        return rows @ part.weight.detach().numpy().T + bias

    def relu(rows):
        return np.maximum(rows, 0)

    weights = linear(layer.weigh, relu(normed(layer.relate_norm, linear(layer.relate, relations))))
    values = np.array(values)
    if features is None:
        values = relu(normed(layer.xyz_norm, linear(layer.raise_xyz, values)))
    best = relu(normed(layer.norm, weights * values)).reshape(b * m, k, -1).max(axis=1)
    raised = relu(normed(layer.raise_norm, linear(layer.raise_channels, best)))
    return raised.reshape(b, m, -1)


@pytest.mark.parametrize("train", [True, False])
def test_convolutions_are_the_papers_edge_by_edge(train):
    model = make().train(train)
    points, features = clouds(), None
    for layer, (samples, neighbours) in zip(model.convolutions, model.group(points), strict=True):
        arguments = (points, features, samples, neighbours)
        expected = edge_by_edge(layer, *arguments)
        features = layer(*arguments)
        np.testing.assert_allclose(features.detach().numpy(), expected, atol=1e-9)
        points = points.gather(1, samples[:, :, None].expand(-1, -1, 3))


def test_a_group_is_the_centre_and_the_nearest_others_in_its_ball():
    model = make(radii=(0.7, 1.0), neighbours=(12, 6))
    points = clouds(n=64)
    for (samples, around), radius, k in zip(
        model.group(points), model.radii, model.neighbours, strict=True
    ):
        for cloud, centres, balls in zip(points, samples, around, strict=True):
            for centre, ball in zip(centres.tolist(), balls.tolist(), strict=True):
                distance = (cloud - cloud[centre]).norm(dim=1)
                others = [i for i in range(len(cloud)) if i != centre and distance[i] <= radius]
                others.sort(key=lambda i: float(distance[i]))
                assert set(ball) == {centre, *others[:k]}
        points = points.gather(1, samples[:, :, None].expand(-1, -1, 3))


def test_number_of_parameters_is_the_releases_less_what_has_no_effect():
    biases = 64 + 16 + 128 + 128 + 512 + 1024  # before a normalisation
    release = 1_289_473
    assert sum(p.numel() for p in RSCNN(40).parameters()) == release + 256 - biases
