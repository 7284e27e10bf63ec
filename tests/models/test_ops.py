import numpy as np
import pytest
import torch
from scipy.spatial import cKDTree

from qs3.models.ops import (
    ball_query,
    farthest_point_sampling,
    gather_points,
    knn,
    neighbour_max,
    neighbour_sum,
    sampling,
    scatter_points,
    three_nn_interpolate,
)
from qs3.models.ops import neighbours as search


def sorted_distances(points, neighbours):
    picked = np.take_along_axis(points[:, None], neighbours[..., None], axis=2)
    return np.sort(np.linalg.norm(picked - points[:, :, None], axis=3), axis=2)


@pytest.mark.parametrize("offset", [0.0, 30.0])
@pytest.mark.parametrize(("n", "k"), [(25, 25), (300, 20), (512, 20), (1024, 20), (1100, 5)])
def test_knn_is_that_of_a_kd_tree(n, k, offset):
    rng = np.random.default_rng(n)
    points = rng.normal(size=(2, n, 3)) + offset
    result = knn(torch.from_numpy(points), k).numpy()
    for cloud in range(2):
        expected = cKDTree(points[cloud]).query(points[cloud], k)[1]
        assert np.array_equal(np.sort(result[cloud]), np.sort(expected))


@pytest.mark.parametrize("n", [256, 500])
def test_knn_in_single_precision_and_many_dimensions(n):
    points = np.random.default_rng(0).normal(size=(1, n, 64)).astype(np.float32)
    result = knn(torch.from_numpy(points), 10).numpy()
    double = points.astype(np.float64)
    whole = np.linalg.norm(double[:, :, None] - double[:, None], axis=3)
    expected = np.sort(whole, axis=2)[:, :, :10]
    np.testing.assert_allclose(sorted_distances(double, result), expected, atol=1e-3)


def test_knn_holds_each_neighbour_once_among_repeated_points():
    points = torch.randn(1, 64, 3, generator=torch.Generator().manual_seed(0)).repeat(1, 8, 1)
    result = knn(points, 20)
    ordered = result.sort(dim=2).values
    assert (ordered[..., 1:] > ordered[..., :-1]).all()
    # A point occurs eight times: the eight nearest of its 20 neighbours are itself.
    distances = sorted_distances(points.double().numpy(), result.numpy())
    np.testing.assert_allclose(distances[..., :8], 0.0, atol=1e-6)


@pytest.mark.parametrize(
    "find", [lambda p: knn(p, 8).sort(dim=2).values, lambda p: ball_query(p, p[:, :90], 0.4, 8)]
)
def test_blocks_do_not_matter(find, monkeypatch):
    points = torch.from_numpy(random_clouds(3, 256))
    whole = find(points)

    def small_blocks(b, m, n, budget):
        for cloud in range(b):
            for row in range(0, m, 40):
                yield slice(cloud, cloud + 1), slice(row, row + 40)

    monkeypatch.setattr(search, "blocks", small_blocks)
    assert torch.equal(find(points), whole)


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
        with torch.no_grad():
            assert torch.equal(function(values, neighbours), output)
        (output * weights).sum().backward()
        results.append((output.detach(), values.grad.clone()))
    torch.testing.assert_close(results[0][0], results[1][0], rtol=0, atol=1e-12)
    torch.testing.assert_close(results[0][1], results[1][1], rtol=0, atol=1e-12)


def test_gradient_at_ties_goes_to_the_first_neighbour_alone():
    values = torch.ones(1, 3, 1, requires_grad=True)
    neighbours = torch.tensor([[[2, 1, 0], [1, 2, 0], [2, 0, 1]]])
    neighbour_max(values, neighbours).sum().backward()
    assert values.grad.flatten().tolist() == [0.0, 1.0, 2.0]


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda p: knn(p, 0), "neighbours of 10 points"),
        (lambda p: ball_query(p, p, 1.0, 11), "neighbours of 10 points"),
        (lambda p: farthest_point_sampling(p, 11), "of 10 points"),
        (lambda p: neighbour_max(p, torch.zeros((1, 10, 256), dtype=torch.int64)), "255"),
    ],
)
def test_impossible_counts_are_refused(call, message):
    with pytest.raises(ValueError, match=message):
        call(torch.zeros(1, 10, 3))


def random_clouds(b, n, seed=0):
    return np.random.default_rng(seed).uniform(-1, 1, size=(b, n, 3))


def test_neighbours_of_other_centres_are_those_of_a_kd_tree():
    points, centres = random_clouds(2, 300), random_clouds(2, 40, seed=1)
    result = knn(torch.from_numpy(points), 7, torch.from_numpy(centres)).numpy()
    for cloud in range(2):
        expected = cKDTree(points[cloud]).query(centres[cloud], 7)[1]
        assert np.array_equal(np.sort(result[cloud]), np.sort(expected))


@pytest.mark.parametrize("offset", [0.0, 30.0])
@pytest.mark.parametrize(("n", "k"), [(300, 5), (512, 32), (20, 20)])
def test_balls_are_those_of_a_kd_tree(n, k, offset):
    points, centres = random_clouds(2, n) + offset, random_clouds(2, 30, seed=1) + offset
    result = ball_query(torch.from_numpy(points), torch.from_numpy(centres), 0.5, k).numpy()
    for cloud in range(2):
        tree = cKDTree(points[cloud])
        nearest = tree.query(centres[cloud], 1)[1]
        inside = tree.query_ball_point(centres[cloud], 0.5)
        for row, members in enumerate(inside):
            distance = np.linalg.norm(points[cloud][members] - centres[cloud][row], axis=1)
            members = [members[i] for i in np.argsort(distance)[:k]] or [nearest[row]]
            got = result[cloud, row]
            assert set(got) == set(members)
            assert got[0] == members[0]
            assert (got == got[0]).sum() == k - len(members) + 1


@pytest.mark.parametrize("start", [None, 4])
def test_samples_are_those_of_brute_force(start):
    points = random_clouds(3, 80)
    first = None if start is None else torch.full((3,), start)
    result = farthest_point_sampling(torch.from_numpy(points), 80, first).numpy()
    for cloud, places in enumerate(points):
        from_mean = np.linalg.norm(places - places.mean(0), axis=1)
        chosen = [int(from_mean.argmax()) if start is None else start]
        while len(chosen) < 80:
            distance = np.linalg.norm(places[:, None] - places[chosen], axis=2).min(axis=1)
            chosen.append(int(distance.argmax()))
        assert list(result[cloud]) == chosen


def test_every_point_of_a_cloud_is_sampled_once_even_repeated_ones():
    points = torch.from_numpy(random_clouds(2, 10)).repeat(1, 5, 1)
    sample = farthest_point_sampling(points, 50)
    assert torch.equal(sample.sort(dim=1).values, torch.arange(50).expand(2, 50))
    assert (sample[:, :10] % 10).sort(dim=1).values.tolist() == [list(range(10))] * 2


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_both_ways_to_sample_repeated_points_give_the_same(dtype):
    """A grid, as of pixels: many distances are equal, and its points are stored twice or more."""
    points = torch.from_numpy(random_clouds(3, 300)).to(dtype)
    points = (points * 4).round() / 7
    planes = points.permute(2, 0, 1).contiguous()
    start = torch.tensor([5, 0, 299])
    by_torch = sampling._sample_in_torch(planes, 300, start)
    assert torch.equal(farthest_point_sampling(points, 300, start), by_torch)


@pytest.mark.parametrize("shape", [(2, 7), (2, 2, 2, 2)])
def test_gathering_and_its_gradients(shape):
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(2, 6, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    index = torch.randint(0, 6, shape, generator=generator)
    cloud = torch.arange(2).view(2, *[1] * (len(shape) - 1))
    assert torch.equal(gather_points(values, index), values[cloud, index])
    assert torch.autograd.gradcheck(lambda v: gather_points(v, index), (values,), fast_mode=True)


def test_scattering_is_the_transpose_of_gathering():
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(2, 6, 3, generator=generator, dtype=torch.float64)
    index = torch.randint(0, 6, (2, 5, 4), generator=generator)
    other = torch.randn(2, 5, 4, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    forth = (gather_points(values, index) * other).sum()
    back = (values * scatter_points(other, index, 6)).sum()
    torch.testing.assert_close(forth, back)
    assert torch.autograd.gradcheck(lambda v: scatter_points(v, index, 6), (other,))


@pytest.mark.parametrize("m", [1, 2, 50])
def test_interpolation_is_that_of_a_kd_tree(m):
    points, known = random_clouds(1, 30), random_clouds(1, m, seed=1)
    features = np.random.default_rng(2).normal(size=(1, m, 4))
    result = three_nn_interpolate(*map(torch.from_numpy, (points, known, features))).numpy()
    distance, nearest = cKDTree(known[0]).query(points[0], range(1, min(3, m) + 1))
    weights = 1 / np.maximum(distance**2, 1e-8)
    weights /= weights.sum(axis=1, keepdims=True)
    expected = (features[0][nearest] * weights[..., None]).sum(axis=1)
    np.testing.assert_allclose(result[0], expected, rtol=1e-9, atol=1e-12)


def test_interpolation_at_known_points_and_its_gradients():
    known, points = torch.from_numpy(random_clouds(2, 9)), torch.from_numpy(random_clouds(2, 5, 1))
    features = torch.randn(
        2, 9, 2, generator=torch.Generator().manual_seed(0), dtype=torch.float64, requires_grad=True
    )
    torch.testing.assert_close(
        three_nn_interpolate(known, known, features), features, rtol=0, atol=1e-5
    )
    inputs = (points.requires_grad_(), known.requires_grad_(), features)
    assert torch.autograd.gradcheck(three_nn_interpolate, inputs, fast_mode=True)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")
def test_a_gpu_gives_what_the_cpu_gives_and_the_same_bits_twice():
    points = torch.from_numpy(random_clouds(2, 256)).float()
    on_gpu = points.cuda()
    assert torch.equal(
        farthest_point_sampling(on_gpu, 64).cpu(), farthest_point_sampling(points, 64)
    )
    balls = ball_query(points, points, 0.3, 16).sort(dim=2).values
    assert torch.equal(ball_query(on_gpu, on_gpu, 0.3, 16).sort(dim=2).values.cpu(), balls)
    gradients = []
    for _ in range(2):
        leaf = on_gpu.clone().requires_grad_()
        gather_points(leaf, balls.cuda()).sin().sum().backward()
        gradients.append(leaf.grad)
    assert torch.equal(*gradients)
