from dataclasses import fields, replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from qs3.errors import InputError
from qs3.runs import Augmentation
from qs3.training.augmentation import (
    Box,
    augment_clouds,
    floor_beneath,
    in_sight,
    near_patch,
    replaced,
    robust_box,
    stretched,
    tilted,
)

CHANCES = ("sight", "plane", "patches", "stretch", "tilt", "floor", "noise")


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


@pytest.fixture
def clouds():
    """Six boxes of points, [6 400 3], of several sizes."""
    drawn = torch.rand(6, 400, 3, generator=generator(), dtype=torch.float64)
    sizes = torch.rand(6, 1, 3, generator=generator(1), dtype=torch.float64) + 0.3
    return drawn * sizes


def every(chance=1.0, **others):
    return Augmentation(**dict.fromkeys(CHANCES, chance), **others)


def test_a_camera_sees_the_near_side_alone():
    """Of two plates one behind the other it sees the first; from beside, the near edges of both."""
    plate = torch.rand(1, 1000, 3, generator=generator()) * torch.tensor([1.0, 0.02, 1.0])
    pair = torch.cat([plate, plate + torch.tensor([0.0, 0.6, 0.0])], dim=1)
    zero = torch.zeros(1, 1)
    for azimuth, front in ((0.0, slice(0, 1000)), (torch.pi, slice(1000, 2000))):
        seen = in_sight(pair, zero + azimuth, zero)
        assert seen[:, front].all()
        assert seen.float().mean() < 0.55  # all but a few at the edges
    beside = in_sight(pair, zero + torch.pi / 2, zero)
    assert beside[:, :1000].any() and beside[:, 1000:].any()
    assert in_sight(plate, zero, zero).all()
    # From above a table's top is seen, and what lies beneath it is not.
    table = torch.cat([plate, plate - torch.tensor([0.0, 0.6, 0.0])], dim=1)[..., [0, 2, 1]]
    assert in_sight(table, zero, zero + torch.pi / 2)[:, :1000].all()
    assert not in_sight(table, zero, zero + torch.pi / 2)[:, 1000:].float().mean() > 0.05


def test_off_changes_and_draws_nothing(clouds):
    source = generator()
    points, kept = augment_clouds(clouds, Augmentation(), source)
    assert points is clouds
    assert kept.all()
    assert torch.equal(source.get_state(), generator().get_state())


@pytest.mark.parametrize("name", CHANCES)
def test_each_has_its_chance_per_cloud(name):
    many = torch.rand(400, 120, 3, generator=generator())
    harsh = {"plane_share": 1.0, "floor_share": 1.0, "least": 0.02}
    some = Augmentation(**harsh, **{name: 0.3})
    points, kept = augment_clouds(many, some, generator(3))
    changed = ((points != many).any(dim=2) | ~kept).any(dim=1).float().mean()
    assert 0.2 < changed < 0.4
    assert points.shape == many.shape


@pytest.mark.parametrize("seed", range(3))
def test_nothing_depends_on_the_unit_or_the_place(clouds, seed):
    points, kept = augment_clouds(clouds, every(), generator(seed))
    shift = torch.tensor([3.0, -7.0, 2.0], dtype=torch.float64)
    moved, also = augment_clouds(1024 * clouds + shift, every(), generator(seed))
    assert torch.equal(kept, also)
    torch.testing.assert_close(moved, 1024 * points + shift, rtol=0, atol=1e-6)


def test_the_least_share_is_always_kept(clouds):
    for seed in range(20):
        harsh = every(plane_share=1.0, patch_radius=1.5, least=0.3)
        points, kept = augment_clouds(clouds, harsh, generator(seed))
        counts = kept.sum(dim=1)
        assert (counts >= 120).all()
        assert points.isfinite().all()
    assert (counts == 120).any()  # the bound is what stops such harsh cuts


def test_a_cloud_of_equal_points_stays_finite():
    points, kept = augment_clouds(torch.ones(2, 30, 3), every(), generator())
    assert points.isfinite().all()
    assert (kept.sum(dim=1) >= 8).all()
    alone, _ = augment_clouds(torch.rand(1, 3, 3), every(), generator())
    assert alone.isfinite().all()


def test_a_plane_cuts_up_to_its_share(clouds):
    shares = []
    for seed in range(30):
        _, kept = augment_clouds(clouds, Augmentation(plane=1.0, plane_share=0.4), generator(seed))
        shares += (1 - kept.double().mean(dim=1)).tolist()
        for cloud, stays in zip(clouds.numpy(), kept.numpy(), strict=True):
            assert stays.all() or separable(cloud, stays)
    assert max(shares) <= 0.4
    assert 0.15 < np.mean(shares) < 0.25  # uniform in 0 to 0.4


def separable(cloud, stays):
    """Whether a plane parts the points, by a linear program: w·x + c ≥ 1 here, ≤ −1 there."""
    from scipy.optimize import linprog

    sign = np.where(stays, 1.0, -1.0)[:, None]
    rows = -sign * np.c_[cloud, np.ones(len(cloud))]
    return linprog(np.zeros(4), rows, -np.ones(len(cloud)), bounds=(None, None)).status == 0


def test_patches_are_balls(clouds):
    centres = clouds[:, :4]
    apart = np.linalg.norm(clouds[:, :, None] - centres[:, None], axis=3).min(axis=2)
    np.testing.assert_allclose(-near_patch(clouds, centres), apart, atol=1e-12)
    one = Augmentation(patches=1.0, patch_count=1, patch_radius=0.5)
    _, kept = augment_clouds(clouds, one, generator(2))
    radius = robust_box(clouds).radius[:, 0, 0]
    for cloud, stays, size in zip(clouds, kept, radius, strict=True):
        lost = cloud[~stays]
        assert len(lost)
        reach = torch.cdist(lost, cloud)[:, ~stays].amax(dim=1).amin()  # from the centre
        assert reach < 0.5 * size


def test_the_box_is_not_moved_by_a_stray(clouds):
    strayed = clouds.clone()
    strayed[:, 7] = 1000.0
    box, moved = robust_box(clouds), robust_box(strayed)
    torch.testing.assert_close(moved.low, box.low, atol=0.02, rtol=0)
    torch.testing.assert_close(moved.high, box.high, atol=0.02, rtol=0)
    inside = ((clouds >= box.low) & (clouds <= box.high)).double().mean(dim=1)
    assert ((inside >= 0.97) & (inside < 1)).all()


def test_stretch_is_log_uniform_about_the_centre(clouds):
    many = clouds.repeat(200, 1, 1)
    points, kept = augment_clouds(many, Augmentation(stretch=1.0, stretch_factor=1.5), generator())
    assert kept.all()
    size, before = points.amax(1) - points.amin(1), many.amax(1) - many.amin(1)
    logs = (size / before).log() / np.log(1.5)
    assert logs.abs().max() <= 1 + 1e-9
    assert abs(float(logs.mean())) < 0.05
    assert abs(float(logs.std()) - 3**-0.5) < 0.02  # of a uniform in −1 to 1
    torch.testing.assert_close(robust_box(points).centre, robust_box(many).centre)
    assert torch.equal(stretched(clouds, clouds[:, :1], torch.ones_like(clouds[:, :1])), clouds)


def test_convention_tilt_is_right_handed_about_a_horizontal_axis(clouds):
    heading, angle = torch.rand(2, 6, 1, generator=generator(), dtype=torch.float64)
    centre = clouds[:, :1]
    points = tilted(clouds, centre, heading, angle)
    for row in range(6):
        h, a = float(heading[row]), float(angle[row])
        turn = Rotation.from_rotvec(a * np.array([np.cos(h), np.sin(h), 0.0]))
        expected = turn.apply((clouds - centre)[row].numpy()) + centre[row].numpy()
        np.testing.assert_allclose(points[row], expected, atol=1e-12)
    assert torch.equal(tilted(clouds, centre, heading, 0 * angle), clouds)


def test_tilt_ends_at_its_angle():
    upright = torch.zeros(500, 40, 3, dtype=torch.float64)
    upright[..., 2] = torch.linspace(-1, 1, 40)
    points, _ = augment_clouds(upright, Augmentation(tilt=1.0, tilt_degrees=10.0), generator())
    rod = points[:, -1] - points[:, 0]
    angle = torch.atan2(rod[:, :2].norm(dim=1), rod[:, 2]).rad2deg()
    assert 9.5 < angle.max() <= 10
    assert angle.min() < 0.5


def test_noise_has_a_scale_of_its_own_for_each_cloud():
    many = torch.rand(300, 500, 3, generator=generator(), dtype=torch.float64)
    points, _ = augment_clouds(many, Augmentation(noise=1.0, noise_sigma=0.04), generator(1))
    sigma = (points - many).std(dim=(1, 2)) / robust_box(many).radius[:, 0, 0]
    assert sigma.max() < 0.042
    assert abs(float(sigma.mean()) - 0.02) < 0.003
    assert abs(float(sigma.std()) - 0.04 / 12**0.5) < 0.002  # uniform in 0 to 0.04


def unit_box(count):
    corner = torch.zeros(count, 1, 3, dtype=torch.float64)
    return Box(corner, corner + 1)


def test_floor_lies_beneath_the_box():
    uniform = torch.rand(1, 4000, 3, generator=generator(), dtype=torch.float64)
    edges = torch.zeros(1, 2, 3, dtype=torch.float64)
    (floor,) = floor_beneath(unit_box(1), edges, uniform)
    radius, margin = 3**0.5 / 2, 0.4 * 3**0.5 / 2
    assert (floor[:, 2] <= 0).all()
    assert floor[:, 2].min() >= -0.02 * radius
    for across in (floor[:, 0], floor[:, 1]):
        assert abs(float(across.min()) + margin) < 0.01
        assert abs(float(across.max()) - 1 - margin) < 0.01
    edges[:, :, 0] = 0.5  # a quarter free on either side
    part = floor_beneath(unit_box(1), edges, uniform)[0, :, 0]
    low, high = -margin, 1 + margin
    assert abs(float(part.min()) - low - (high - low) / 4) < 0.01
    assert abs(float(part.max()) - high + (high - low) / 4) < 0.01


def test_a_share_of_the_kept_points_is_replaced(clouds):
    kept = torch.rand(6, 400, generator=generator()) < 0.5
    new = torch.full_like(clouds, 9.0) + torch.arange(400)[:, None]
    share = torch.full((6, 1), 0.3, dtype=torch.float64)
    uniform = torch.rand(6, 400, generator=generator(1), dtype=torch.float64)
    points = replaced(clouds, kept, new, share, uniform)
    changed = (points != clouds).any(dim=2)
    assert not (changed & ~kept).any()
    counts = (0.3 * kept.sum(dim=1)).long()
    assert changed.sum(dim=1).tolist() == counts.tolist()
    for cloud, differs, count in zip(points, changed, counts, strict=True):
        firsts = cloud[differs][:, 0].sort().values
        assert firsts.tolist() == [9.0 + place for place in range(count)]


@pytest.mark.parametrize("name", [field.name for field in fields(Augmentation)])
def test_settings_out_of_their_range_are_refused(name):
    for value in (-1,) if name == "patch_count" else (-0.5, float("nan")):
        with pytest.raises(InputError, match=f"augmentation: {name} "):
            replace(Augmentation(), **{name: value})
