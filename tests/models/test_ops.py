import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from qs3.models.ops import flat_indices, knn, neighbour_max, neighbour_sum
from qs3.models.ops import neighbours as search


def sorted_distances(points, neighbours):
    picked = np.take_along_axis(points[:, None], neighbours[..., None], axis=2)
    return np.sort(np.linalg.norm(picked - points[:, :, None], axis=3), axis=2)


@pytest.mark.parametrize("offset", [0.0, 30.0])
@pytest.mark.parametrize(("n", "k"), [(25, 25), (300, 20), (512, 20), (1024, 20), (1100, 5)])
def test_knn_is_that_of_a_kd_tree(n, k, offset):
    rng = np.random.default_rng(n)
    points = rng.normal(size=(2, n, 3)) + offset
    found = knn(torch.from_numpy(points), k).numpy()
    for cloud in range(2):
        expected = cKDTree(points[cloud]).query(points[cloud], k)[1]
        assert np.array_equal(np.sort(found[cloud]), np.sort(expected))


@pytest.mark.parametrize("n", [256, 500])
def test_knn_in_single_precision_and_many_dimensions(n):
    points = np.random.default_rng(0).normal(size=(3, n, 64)).astype(np.float32)
    found = knn(torch.from_numpy(points), 10).numpy()
    double = points.astype(np.float64)
    whole = np.linalg.norm(double[:, :, None] - double[:, None], axis=3)
    expected = np.sort(whole, axis=2)[:, :, :10]
    np.testing.assert_allclose(sorted_distances(double, found), expected, atol=1e-3)


def test_knn_holds_each_neighbour_once_among_repeated_points():
    points = torch.randn(1, 64, 3, generator=torch.Generator().manual_seed(0)).repeat(1, 8, 1)
    found = knn(points, 20)
    ordered = found.sort(dim=2).values
    assert (ordered[..., 1:] > ordered[..., :-1]).all()
    # A point occurs eight times: the eight nearest of its 20 neighbours are itself.
    distances = sorted_distances(points.double().numpy(), found.numpy())
    np.testing.assert_allclose(distances[..., :8], 0.0, atol=1e-6)


def test_knn_blocks_do_not_matter(monkeypatch):
    points = torch.randn(3, 512, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    whole = knn(points, 8).sort(dim=2).values

    def small_blocks(b, m, n, cuda):
        for cloud in range(b):
            for row in range(0, m, 100):
                yield slice(cloud, cloud + 1), slice(row, row + 100)

    monkeypatch.setattr(search, "_blocks", small_blocks)
    assert torch.equal(knn(points, 8).sort(dim=2).values, whole)


@pytest.mark.parametrize(
    ("b", "m", "n"), [(1, 1, 1), (5, 1024, 1024), (70, 128, 128), (3, 70, 5000)]
)
def test_blocks_cover_every_row_once_in_bounded_memory(b, m, n):
    seen = np.zeros((b, m), dtype=int)
    for cloud, row in search._blocks(b, m, n, cuda=False):
        size = seen[cloud, row].size * n
        assert size <= max(2**20, n)
        seen[cloud, row] += 1
    assert (seen == 1).all()


@pytest.mark.parametrize("k", [0, 11])
def test_knn_refuses_impossible_counts(k):
    with pytest.raises(ValueError, match="neighbours of 10 points"):
        knn(torch.zeros(1, 10, 3), k)


def gathered(values, neighbours):
    return values[torch.arange(len(values))[:, None, None], neighbours]


@pytest.mark.parametrize(
    "ours_and_reference",
    [
        (neighbour_max, lambda v, i: gathered(v, i).amax(dim=2)),
        (neighbour_sum, lambda v, i: gathered(v, i).sum(dim=2)),
    ],
    ids=["max", "sum"],
)
def test_reductions_and_gradients(ours_and_reference):
    ours, reference = ours_and_reference
    generator = torch.Generator().manual_seed(3)
    values = torch.randn(2, 30, 5, generator=generator, dtype=torch.float64, requires_grad=True)
    neighbours = torch.randint(0, 30, (2, 30, 6), generator=generator)
    weights = torch.randn(2, 30, 5, generator=generator, dtype=torch.float64)
    results = []
    for function in (ours, reference):
        values.grad = None
        output = function(values, neighbours)
        (output * weights).sum().backward()
        results.append((output.detach(), values.grad.clone()))
    torch.testing.assert_close(results[0][0], results[1][0], rtol=0, atol=1e-12)
    torch.testing.assert_close(results[0][1], results[1][1], rtol=0, atol=1e-12)


def test_maximum_without_gradient_is_the_same():
    values = torch.randn(2, 30, 5, generator=torch.Generator().manual_seed(0), requires_grad=True)
    neighbours = knn(values, 4)
    with torch.no_grad():
        plain = neighbour_max(values, neighbours)
    assert torch.equal(plain, neighbour_max(values, neighbours))


def test_gradient_at_ties_goes_to_the_first_neighbour_alone():
    values = torch.ones(1, 3, 1, requires_grad=True)
    neighbours = torch.tensor([[[2, 1, 0], [1, 2, 0], [2, 0, 1]]])
    neighbour_max(values, neighbours).sum().backward()
    assert values.grad.flatten().tolist() == [0.0, 1.0, 2.0]


def test_more_than_255_neighbours_are_refused():
    with pytest.raises(ValueError, match="255"):
        neighbour_max(torch.zeros(1, 300, 1), torch.zeros((1, 300, 256), dtype=torch.int64))


def test_flat_indices_stay_in_their_cloud():
    flat = flat_indices(torch.tensor([[[1, 0], [1, 1]], [[0, 1], [0, 0]]]))
    assert flat.tolist() == [[1, 0], [1, 1], [2, 3], [2, 2]]
