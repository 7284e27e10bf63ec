"""Laws that every deformation keeps, and what each one does beyond them."""

import numpy as np
import pytest
import torch

from qs3.paper.rivals.deformations import cell_centres, cells, deform_voxels, pick_cells

from ...adaptation.common import ball, seeded

SIGMA = 0.001**0.5


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


@pytest.mark.parametrize("name", CLOUDS)
def test_laws(name):
    points = CLOUDS[name]
    before = points.clone()
    deformed, moved = deform_voxels(points, seeded())
    assert torch.equal(points, before)
    assert deformed.shape == points.shape and deformed.dtype == points.dtype
    assert torch.isfinite(deformed).all()
    # Only points that the mask names have moved, and it names one of each cloud at least.
    assert torch.equal(deformed[~moved], points[~moved])
    assert (deformed != points).any(dim=2)[moved].all()
    assert moved.any(dim=1).all()


def test_the_generator_alone_decides():
    points = shell(4)
    first, again, other = (deform_voxels(points, seeded(seed)) for seed in (1, 1, 2))
    state = torch.random.get_rng_state()
    assert torch.equal(first.points, again.points) and torch.equal(first.moved, again.moved)
    assert not torch.equal(first.moved, other.moved)
    torch.manual_seed(5)
    assert torch.equal(deform_voxels(points, seeded(1)).points, first.points)
    torch.random.set_rng_state(state)


def test_clouds_do_not_share_their_draws():
    points = shell(1).expand(6, -1, -1)
    moved = deform_voxels(points, seeded()).moved
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
