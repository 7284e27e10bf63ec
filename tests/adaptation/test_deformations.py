"""Laws that every deformation keeps, and what each one does beyond them."""

import numpy as np
import pytest
import torch

from qs3.adaptation.deformations import (
    DEFORMATIONS,
    cell_centres,
    cells,
    deform_features,
    deform_radius,
    deform_split,
    deform_voxels,
    drop_points,
    pick_cells,
)

from .common import ball, seeded

SIGMA = 0.001**0.5


def by_own_features(points, generator):
    return deform_features(points, points.flip(2) * 2, generator)


ALL = {**DEFORMATIONS, "features": by_own_features}
every = pytest.mark.parametrize("deform", ALL.values(), ids=ALL)


def shell(b, n=1000):
    """Points of the unit sphere, of which many cells hold forty."""
    return torch.nn.functional.normalize(torch.randn(b, n, 3, generator=seeded()), dim=2)


CLOUDS = {
    "many": ball(),
    "few": ball(3, 5),
    "two": ball(2, 2),
    "one": ball(2, 1),
    "repeated": ball(2, 30).repeat(1, 3, 1),
    "equal": torch.full((2, 50, 3), 0.3),
    "outside": ball() * 40 + 7,
    "double": ball().double(),
}


@every
@pytest.mark.parametrize("name", CLOUDS)
def test_laws(deform, name):
    points = CLOUDS[name]
    before = points.clone()
    deformed, moved = deform(points, seeded())
    assert torch.equal(points, before)
    assert deformed.shape == points.shape and deformed.dtype == points.dtype
    assert torch.isfinite(deformed).all()
    # Only points that the mask names have moved, and it names one of each cloud at least.
    assert torch.equal(deformed[~moved], points[~moved])
    assert (deformed != points).any(dim=2)[moved].all()
    assert moved.any(dim=1).all()


@every
def test_the_generator_alone_decides(deform):
    points = shell(4)
    first, again, other = (deform(points, seeded(seed)) for seed in (1, 1, 2))
    state = torch.random.get_rng_state()
    assert torch.equal(first.points, again.points) and torch.equal(first.moved, again.moved)
    assert not torch.equal(first.moved, other.moved)
    torch.manual_seed(5)
    assert torch.equal(deform(points, seeded(1)).points, first.points)
    torch.random.set_rng_state(state)


@every
def test_clouds_do_not_share_their_draws(deform):
    points = shell(1).expand(6, -1, -1)
    moved = deform(points, seeded()).moved
    assert len({tuple(row.tolist()) for row in moved}) > 1


def test_cells_are_those_of_their_centres():
    assert cells(cell_centres()[None])[0].tolist() == list(range(27))
    # Every point is nearest to its own cell's centre, measured along each axis.
    points = torch.rand(1, 500, 3, generator=seeded()) * 2 - 1
    off = (points[0, :, None] - cell_centres()).abs().amax(dim=2)
    assert torch.equal(off.argmin(dim=1), cells(points)[0])
    assert float(off.amin(dim=1).max()) <= 1 / 3 + 1e-6


def test_cells_of_least_points_are_drawn_evenly():
    """Of cells with 50, 40 and 39 points, the first two are drawn alike and the last never."""
    parts = [cell_centres()[c].expand(m, 3) for c, m in ((3, 50), (20, 40), (9, 39))]
    points = torch.cat(parts)[None].expand(2000, -1, -1)
    chosen = pick_cells(points, 40, seeded())
    count = torch.bincount(chosen, minlength=27)
    assert count[3] + count[20] == 2000
    assert abs(int(count[3]) - 1000) < 4 * np.sqrt(500)


def test_the_fullest_cell_stands_in():
    parts = [cell_centres()[c].expand(m, 3) for c, m in ((3, 7), (20, 8), (9, 6))]
    chosen = pick_cells(torch.cat(parts)[None].expand(20, -1, -1), 40, seeded())
    assert chosen.tolist() == [20] * 20


def test_voxels_collapse_one_whole_cell_to_its_centre():
    points = ball(6, 2000)
    deformed, moved = deform_voxels(points, seeded())
    chosen = pick_cells(points, 40, seeded())
    assert torch.equal(moved, cells(points) == chosen[:, None])
    for cloud, out, mask in zip(points, deformed, moved, strict=True):
        (cell,) = set(cells(cloud[None])[0][mask].tolist())
        assert torch.equal(mask, cells(cloud[None])[0] == cell)
        assert int(mask.sum()) >= 40
        z = (out[mask] - cell_centres()[cell]) / SIGMA
        assert float(z.mean().abs()) < 5 / z.numel() ** 0.5
        assert float(z.std()) == pytest.approx(1, abs=5 / (2 * z.numel()) ** 0.5)


def test_radius_collapses_a_ball_to_its_seed():
    points = ball(5, 400)
    deformed, moved = deform_radius(points, seeded())
    for cloud, out, mask in zip(points, deformed, moved, strict=True):
        balls = torch.cdist(cloud, cloud) <= 0.5
        seeds = (balls == mask).all(dim=1).nonzero()[:, 0]
        assert len(seeds) >= 1
        assert int(mask.sum()) >= 20
        off = out[mask].mean(dim=0) - cloud[seeds]
        assert float(off.norm(dim=1).min()) < 5 * SIGMA / int(mask.sum()) ** 0.5


def test_radius_takes_a_seed_with_enough_neighbours():
    """Thirty points lie together and 270 alone: only the thirty can be seeds."""
    lonely = torch.arange(1, 271)[:, None] * torch.tensor([10.0, 0, 0])
    points = torch.cat([lonely, ball(1, 30)[0] * 0.2])[None].expand(20, -1, -1)
    moved = deform_radius(points, seeded()).moved
    assert torch.equal(moved, (torch.arange(300) >= 270).expand(20, -1))


def test_features_collapse_the_points_most_alike():
    points = ball(3, 200)
    features = torch.randn(3, 200, 8, generator=seeded(3))
    deformed, moved = deform_features(points, features, seeded(), share=0.1)
    assert moved.sum(dim=1).tolist() == [20, 20, 20]
    for cloud, out, mask, vector in zip(points, deformed, moved, features, strict=True):
        order = torch.cdist(vector, vector).argsort(dim=1)[:, :20].sort(dim=1).values
        seeds = (order == mask.nonzero()[:, 0]).all(dim=1).nonzero()[:, 0]
        assert len(seeds) >= 1
        assert float((out[mask].mean(dim=0) - cloud[seeds]).norm(dim=1).min()) < 5 * SIGMA / 20**0.5


def test_drop_points_keeps_points_as_probable_as_asked():
    points = ball(1, 4).expand(20000, -1, -1)
    keep = torch.tensor([1.0, 0.9, 0.5, 0.2])
    moved = drop_points(points, keep.expand(20000, -1), seeded()).moved
    # One point is always dropped; where there are two or more, nothing had to be added.
    free = moved.sum(dim=1) >= 2
    assert not moved[free, 0].any()
    pairs = {mask: float(keep_both(mask, keep)) for mask in ("0011", "0101", "0110", "0111")}
    total = sum(pairs.values())
    for mask, probability in pairs.items():
        wanted = torch.tensor([c == "1" for c in mask])
        share = float((moved[free] == wanted).all(dim=1).float().mean())
        assert share == pytest.approx(probability / total, abs=0.02)


def keep_both(mask, keep):
    return np.prod([1 - p if c == "1" else p for c, p in zip(mask, keep.tolist(), strict=True)])


def test_dropped_points_land_beside_survivors():
    points = ball(3, 200)
    deformed, moved = drop_points(points, torch.full((3, 200), 0.5), seeded())
    for cloud, out, mask in zip(points, deformed, moved, strict=True):
        near, at = torch.cdist(out[mask], cloud[~mask]).min(dim=1)
        assert float(near.max()) < 5 * SIGMA
        assert len(set(at.tolist())) > 30


def test_drop_points_never_drops_all_nor_none():
    points = ball(50, 6)
    assert (drop_points(points, torch.zeros(50, 6), seeded()).moved.sum(dim=1) == 5).all()
    assert (drop_points(points, torch.ones(50, 6), seeded()).moved.sum(dim=1) == 1).all()


def test_split_thins_one_side_of_a_plane():
    points = ball(8, 1000)
    moved = deform_split(points, seeded()).moved
    share = moved.float().mean(dim=1)
    assert float((share - 0.375).abs().max()) < 0.08
    for cloud, mask in zip(points - points.mean(dim=1, keepdim=True), moved, strict=True):
        direction = cloud[mask].mean(dim=0)
        sides = (cloud @ torch.nn.functional.normalize(direction, dim=0)) > 0
        assert float(mask[sides].float().mean()) > 0.6
        assert float(mask[~sides].float().mean()) < 0.15


def test_gradient_thins_along_the_longest_axis():
    points = ball(16, 2000) * torch.tensor([0.3, 1.0, 0.5])
    moved = DEFORMATIONS["gradient"](points, seeded()).moved.double().numpy()
    ends = set()
    for cloud, mask in zip(points.double().numpy(), moved, strict=True):
        slopes = np.linalg.lstsq(np.c_[cloud, np.ones(2000)], mask, rcond=None)[0][:3]
        length = np.ptp(cloud[:, 1])
        assert abs(abs(slopes[1]) * length - 0.95) < 0.25
        assert np.abs(slopes[[0, 2]] * np.ptp(cloud[:, [0, 2]], axis=0)).max() < 0.25
        ends.add(np.sign(slopes[1]))
    assert ends == {-1.0, 1.0}


def test_lambertian_keeps_what_faces_the_light():
    """On a sphere the survivors' share is the mean of max(cos, 0.05), and they face one way."""
    points = shell(6, 2000)
    moved = DEFORMATIONS["lambertian"](points, seeded()).moved
    cosine = np.linspace(-1, 1, 10001)
    expected = np.maximum(cosine, 0.05).mean()
    assert float((~moved).float().mean()) == pytest.approx(expected, abs=0.02)
    for cloud, mask in zip(points, moved, strict=True):
        light = torch.nn.functional.normalize(cloud[~mask].mean(dim=0), dim=0)
        facing = cloud @ light
        assert float((~mask)[facing > 0.9].float().mean()) > 0.85
        assert float((~mask)[facing < 0].float().mean()) < 0.1


def test_radius_falls_back_on_the_fullest_ball():
    lonely = torch.arange(1, 298)[:, None] * torch.tensor([10.0, 0, 0])
    points = torch.cat([lonely, torch.zeros(3, 3)])[None].expand(10, -1, -1)
    moved = deform_radius(points, seeded()).moved
    assert torch.equal(moved, (torch.arange(300) >= 297).expand(10, -1))


def test_features_share_of_one_moves_all_and_of_none_one():
    points = ball(2, 50)
    assert deform_features(points, points, seeded(), share=1.0).moved.all()
    assert deform_features(points, points, seeded(), share=0.0).moved.sum(dim=1).tolist() == [1, 1]
