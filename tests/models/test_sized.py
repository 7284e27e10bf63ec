import pytest
import torch

from qs3.adaptation import Batch, create_method
from qs3.adaptation.names import METHODS
from qs3.errors import InputError
from qs3.models import create_model
from qs3.models.wrappers import Aligned, Sized, aligned, ball_radius, log_extents, unit_of

SMALL = {"channels": (16, 16, 32), "hidden": (16,), "transforms": False}


@pytest.fixture
def clouds():
    points = torch.randn(6, 80, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor(
        [0.5, 0.2, 0.8]
    )
    return points - points.median(dim=1, keepdim=True).values


def make(seed=0, **settings):
    torch.manual_seed(seed)
    return create_model("pointnet", 4, **SMALL, **settings)


def turned(points, angle):
    c, s = torch.tensor(angle).cos(), torch.tensor(angle).sin()
    x, y, z = points.unbind(2)
    return torch.stack([c * x - s * y, s * x + c * y, z], dim=2)


def test_extents_are_logs_of_metres_and_do_not_turn(clouds):
    extents = log_extents(clouds)
    torch.testing.assert_close(log_extents(2 * clouds), extents + 1)
    torch.testing.assert_close(log_extents(turned(clouds, 0.7)), extents)
    # Height, width and full extent of a box 1 m wide and 0.5 m high, on its rim.
    box = torch.tensor([[[x, 0.0, z] for x in (-0.5, 0.5) for z in (-0.25, 0.25)]])
    expected = torch.tensor([[0.5, 1.0, (1 + 0.25) ** 0.5]]).log2()
    torch.testing.assert_close(log_extents(box), expected)
    assert log_extents(torch.zeros(1, 1, 3)).isfinite().all()


def test_a_stray_moves_the_size_to_the_next_point_at_most(clouds):
    strayed = torch.cat([clouds, torch.full((6, 1, 3), 1000.0)], dim=1)
    distance = clouds.norm(dim=2).sort(dim=1).values
    torch.testing.assert_close(ball_radius(clouds, 0.95), distance[:, 75])
    torch.testing.assert_close(ball_radius(strayed, 0.95), distance[:, 76])
    many = torch.rand(4, 2000, 3, generator=torch.Generator().manual_seed(0)) - 0.5
    strayed = torch.cat([many, torch.full((4, 1, 3), 1000.0)], dim=1)
    # So many points lie within 1/1000 of one another in height, width and distance.
    assert (log_extents(strayed) - log_extents(many)).abs().max() < 0.01


def test_two_sizes_of_a_shape_differ_and_the_network_inside_sees_none(clouds):
    inside = make().eval()
    network = Sized(inside, 0.95).eval()
    small, large = network.encode(clouds), network.encode(3 * clouds)
    assert (small.pooled - large.pooled).abs().max() > 1e-4
    assert not torch.equal(network(clouds), network(3 * clouds))
    network.size[2].weight.data.zero_()
    torch.testing.assert_close(network(clouds), network(3 * clouds), rtol=0, atol=1e-5)
    radius = ball_radius(clouds, 0.95)[:, None, None]
    assert torch.equal(network(clouds), inside(clouds / radius))


def test_sized_returns_the_features_of_the_network(clouds):
    inside = make().eval()
    network = Sized(inside, 1.0).eval()
    inner = inside.encode(clouds / ball_radius(clouds, 1.0)[:, None, None])
    outer = network.encode(clouds)
    assert torch.equal(inner.local, outer.local)
    assert unit_of(inside, clouds) == 1.0
    assert torch.equal(unit_of(network, clouds)[:, 0, 0], ball_radius(clouds, 1.0))
    assert network.encode(torch.zeros(2, 5, 3)).pooled.isfinite().all()


@pytest.mark.parametrize("method", METHODS)
def test_every_method_accepts_or_refuses_sizes(clouds, method):
    network = create_model("pointnet-sa", 4) if method == "pointdan" else make()
    network = Sized(network, 0.95)
    if method in ("defrec", "pcm", "defrec-pcm"):
        with pytest.raises(InputError, match="size_input"):
            create_method(method, network)
        return
    learner = create_method(method, network).train()
    batch = Batch(clouds[:4], torch.arange(4))
    terms = learner.losses(batch, clouds[2:], 0.5, torch.Generator().manual_seed(0))
    assert all(term.isfinite() for term in terms.values())


def test_gast_distorts_clouds_in_their_own_ball(clouds, monkeypatch):
    """Of a cloud three times as large, the network inside sees the same."""
    seen = []

    for scale in (1.0, 3.0):
        inside = make()
        encode = inside.encode
        passed = []
        monkeypatch.setattr(inside, "encode", lambda p, e=encode, s=passed: (s.append(p), e(p))[1])
        learner = create_method("gast", Sized(inside, 0.95)).eval()
        passed.clear()
        generator = torch.Generator().manual_seed(0)
        batch = Batch(scale * clouds, torch.arange(6) % 4)
        learner.losses(batch, scale * clouds, 0.5, generator)
        seen.append(passed)
    assert len(seen[0]) > 2
    for one, other in zip(*seen, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-4)


@pytest.mark.parametrize("angle", [0.3, 2.0, -2.8])
def test_alignment_leaves_two_headings(clouds, angle):
    """Of all turns of a cloud two remain, a half turn apart; nothing else moves."""
    plain, other = aligned(clouds), aligned(turned(clouds, angle))
    half = plain * torch.tensor([-1.0, -1.0, 1.0])
    for one, same, turn in zip(other, plain, half, strict=True):
        assert torch.allclose(one, same, atol=1e-5) or torch.allclose(one, turn, atol=1e-5)
    torch.testing.assert_close(aligned(turned(clouds, torch.pi)), half)
    centred = plain[:, :, :2] - plain[:, :, :2].mean(dim=1, keepdim=True)
    variance = centred.transpose(1, 2) @ centred
    assert (variance[:, 0, 0] > variance[:, 1, 1]).all()
    torch.testing.assert_close(variance[:, 0, 1], torch.zeros(6), atol=1e-4, rtol=0)
    distances = [
        torch.cdist(part, part, compute_mode="donot_use_mm_for_euclid_dist")
        for part in (plain, clouds)
    ]
    torch.testing.assert_close(*distances)
    assert aligned(torch.zeros(1, 3, 3)).isfinite().all()


def test_aligned_network_answers_to_two_headings(clouds):
    network = Aligned(make()).eval()
    torch.testing.assert_close(network(clouds), make().eval()(aligned(clouds)))
    sized = Sized(network, 0.95).eval()
    answers = [
        sized(turned(clouds, angle)) + sized(turned(clouds, angle + torch.pi))
        for angle in (0.0, 1.3)
    ]
    torch.testing.assert_close(*answers, atol=1e-4, rtol=1e-4)
