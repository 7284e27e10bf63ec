"""The mean teacher, its loss, and the distortions."""

import math

import numpy as np
import pytest
import torch
from scipy.interpolate import RegularGridInterpolator
from scipy.ndimage import uniform_filter
from scipy.special import log_softmax, softmax
from torch.nn.modules.batchnorm import _BatchNorm

from qs3.adaptation import distortions
from qs3.adaptation.self_distillation import SelfDistillation, distillation_loss

from .common import ball, make_batch, make_model, seeded


def step(method, optimiser, seed, target=None):
    target = ball(3, 20, 9) if target is None else target
    losses = method(make_batch(n=30), target, 0.5, seeded(seed))
    optimiser.zero_grad()
    torch.stack(list(losses.values())).sum().backward()
    optimiser.step()
    method.after_step()


def state(method):
    """Student's network and normalisation, by the teacher's names.

    Without TransNorm's scales, which follow from the running statistics at every pass.
    """
    tensors = {f"teacher.{name}": t for name, t in method.model.state_dict().items()}
    tensors |= {f"teacher_norm.{name}": t for name, t in method.norm.state_dict().items()}
    return {name: t.detach().clone() for name, t in tensors.items() if not name.endswith(".scale")}


def teacher_state(method):
    tensors = {name: t for name, t in method.state_dict().items() if name.startswith("teacher")}
    return {name: t for name, t in tensors.items() if not name.endswith(".scale")}


def test_loss_is_the_cross_entropy_of_softmaxes():
    rng = np.random.default_rng(0)
    student, teacher = rng.normal(size=(5, 7)), rng.normal(size=(5, 7))
    expected = -(softmax(teacher / 0.1, axis=1) * log_softmax(student / 0.5, axis=1)).sum(1).mean()
    value = distillation_loss(*map(torch.from_numpy, (student, teacher)))
    assert float(value) == pytest.approx(expected, rel=1e-6)


def test_loss_is_least_where_the_student_agrees():
    teacher = torch.randn(5, 7, generator=seeded())
    agreeing = (5 * teacher).requires_grad_()  # τ_s / τ_t = 5
    (slope,) = torch.autograd.grad(distillation_loss(agreeing, teacher), agreeing)
    assert slope.abs().max() < 1e-6
    assert distillation_loss(agreeing, teacher) < distillation_loss(teacher, teacher)


@pytest.mark.parametrize("norm", ["shared", "separate", "transnorm"])
def test_teacher_begins_as_the_plain_mean_of_the_student(norm):
    """With t ↦ 1 − 1/(t + 1) it is the mean of all states so far, the first one included."""
    method = SelfDistillation(make_model(), normalisation=norm)
    optimiser = torch.optim.Adam(method.parameter_groups(0.05))
    seen = [state(method)]
    for number in range(4):
        step(method, optimiser, number)
        seen.append(state(method))
        for name, tensor in teacher_state(method).items():
            if tensor.is_floating_point():
                expected = torch.stack([s[name] for s in seen]).mean(dim=0)
                assert torch.allclose(tensor, expected, rtol=1e-5, atol=1e-6), name
            else:
                assert torch.equal(tensor, seen[-1][name]), name
    changed = [name for name in seen[0] if not torch.equal(seen[0][name], seen[-1][name])]
    assert any("running_mean" in name for name in changed)
    assert any("weight" in name for name in changed)


def test_teacher_is_the_moving_average_later():
    method = SelfDistillation(make_model(), decay=0.3)
    optimiser = torch.optim.Adam(method.parameter_groups(0.05))
    expected = state(method)
    for number in range(3):
        step(method, optimiser, number)
        for name, tensor in state(method).items():
            if tensor.is_floating_point():
                expected[name] = 0.3 * expected[name] + 0.7 * tensor
    for name, tensor in teacher_state(method).items():
        if tensor.is_floating_point():
            assert torch.allclose(tensor, expected[name], rtol=1e-5, atol=1e-6), name


def test_teacher_is_frozen_and_apart():
    method = SelfDistillation(make_model())
    step(method, torch.optim.Adam(method.parameter_groups(0.05)), 0)
    assert not any(p.requires_grad or p.grad is not None for p in method.teacher.parameters())
    (group,) = method.parameter_groups(0.1)
    students = {id(p) for p in method.model.parameters()}
    assert {id(p) for p in group["params"]} == students
    assert all(p.grad is not None for p in method.model.parameters())
    assert not students & {id(p) for p in method.teacher.parameters()}
    assert method.result() is method.model


def test_teacher_stands_still_in_a_pass():
    """Its statistics come from the average alone, also when the method is set to training."""
    method = SelfDistillation(make_model()).train()
    before = {name: t.clone() for name, t in teacher_state(method).items()}
    method(make_batch(n=30), ball(3, 20, 9), 0.5, seeded())
    after = teacher_state(method)
    assert all(torch.equal(after[name], before[name]) for name in before)
    assert any(layer.training for layer in method.model.modules() if isinstance(layer, _BatchNorm))


def test_teacher_normalises_the_target_with_its_own_target_statistics():
    method = SelfDistillation(make_model(), normalisation="separate")
    optimiser = torch.optim.Adam(method.parameter_groups(0.05))
    for number in range(3):
        step(method, optimiser, number, target=3 + ball(3, 20, number))
    method.teacher.eval()
    points = 3 + ball(2, 20, 7)
    as_source, as_target = (method._describe(points, domain) for domain in ("source", "target"))
    assert not torch.allclose(as_source, as_target)
    assert torch.equal(as_source, method.teacher.encode(points).pooled)
    # It is the teacher's layers that were swapped, and back again.
    assert torch.equal(as_target, method._describe(points, "target"))


def test_losses_are_the_parts():
    """Without draws (no jitter, distortion, scaling, cut) they are plain passes of the network."""
    still = {"sigma": 0.0, "distortion": 0.0, "scale": (1.0, 1.0), "source_keep": 1.0}
    method = SelfDistillation(make_model(), weight=2.0, **still).eval()
    source, target = make_batch(n=30), ball(3, 20, 9)
    with torch.no_grad():
        losses = method(source, target, 0.5, seeded())
        logits = method.model(source.points)
        described = torch.cat([method.model.encode(p).pooled for p in (source.points, target)])
    expected = 2.0 * math.exp(-1.25) * distillation_loss(described, described)
    assert list(losses) == ["source", "distillation"]
    assert float(losses["source"]) == pytest.approx(
        float(torch.nn.functional.cross_entropy(logits, source.labels)), rel=1e-6
    )
    assert float(losses["distillation"]) == pytest.approx(float(expected), rel=1e-6)
    assert int(method.right) == int((logits.argmax(dim=1) == source.labels).sum())


@pytest.mark.slow
def test_distillation_learns():
    """Trained on it alone, the student's strong views come nearer to the teacher's weak ones."""
    method = SelfDistillation(make_model(), normalisation="shared")
    optimiser = torch.optim.Adam(method.parameter_groups(0.01))
    target, values = ball(16, 40, 9), []
    for number in range(30):
        loss = method(make_batch(n=30), target, 1.0, seeded(number))["distillation"]
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        method.after_step()
        values.append(float(loss.detach()))
    assert np.mean(values[-5:]) < 0.9 * np.mean(values[:5])


@pytest.mark.parametrize("name", ["jitter", "rescale", "tilt", "occlude", "elastic"])
@pytest.mark.parametrize("shape", [(1, 1), (2, 7), (5, 64)])
def test_distortions_keep_the_number_of_points_and_draw_from_the_generator_only(name, shape):
    distort, points = getattr(distortions, name), ball(*shape)
    assert torch.isfinite(distort(1e6 + points, seeded())).all()
    kept, before = points.clone(), torch.random.get_rng_state()
    first = distort(points, seeded(1))
    torch.rand(3)
    assert first.shape == points.shape
    assert first.dtype == points.dtype
    assert torch.isfinite(first).all()
    assert torch.equal(first, distort(points, seeded(1)))
    assert torch.equal(points, kept)
    if shape == (5, 64):
        assert not torch.equal(first, distort(points, seeded(2)))
        assert not torch.equal(first[0] - points[0], first[1] - points[1])
    torch.random.set_rng_state(before)
    distort(points, seeded(1))
    assert torch.equal(torch.random.get_rng_state(), before)


def test_jitter_has_its_deviation_and_clip():
    noise = distortions.jitter(torch.zeros(4, 5000, 3), seeded(), 0.02, 0.05)
    assert float(noise.std()) == pytest.approx(0.02, rel=0.03)
    assert float(noise.abs().max()) == pytest.approx(0.05)


def test_rescale_is_one_factor_a_cloud_in_its_bounds():
    points = ball(200, 2)
    factor = distortions.rescale(points, seeded()) / points
    assert torch.allclose(factor, factor[:, :1, :1].expand_as(factor), rtol=1e-4)
    assert 0.7 <= float(factor.min()) < 0.72
    assert 1.48 < float(factor.max()) <= 1.5 + 1e-4


def test_tilt_is_a_small_rotation():
    points = torch.eye(3).expand(50, 3, 3).double()
    turned = distortions.tilt(points, seeded(), 0.06, 0.18)
    assert torch.allclose(turned @ turned.transpose(1, 2), points, atol=1e-6)
    assert torch.allclose(torch.linalg.det(turned), torch.ones(50).double())
    trace = turned.diagonal(dim1=1, dim2=2).sum(dim=1)
    angle = torch.arccos(((trace - 1) / 2).clamp(-1, 1))
    assert 0.01 < float(angle.mean()) < 0.18
    assert float(angle.max()) <= 3 * 0.18
    # Rows are images of the axes: with angles about x, y, z in this order, Rz Ry Rx.
    a, b, c = (0.06 * torch.randn(50, 3, generator=seeded())).clamp(-0.18, 0.18)[0]
    x = torch.tensor([[1, 0, 0], [0, a.cos(), -a.sin()], [0, a.sin(), a.cos()]])
    y = torch.tensor([[b.cos(), 0, b.sin()], [0, 1, 0], [-b.sin(), 0, b.cos()]])
    z = torch.tensor([[c.cos(), -c.sin(), 0], [c.sin(), c.cos(), 0], [0, 0, 1]])
    assert torch.allclose(turned[0].float().T, z @ y @ x, atol=1e-6)


@pytest.mark.parametrize("keep", [0.1, 0.5, 0.7, 1.0])
def test_occlude_keeps_one_side_of_a_plane(keep):
    points = ball(6, 41)
    seen = distortions.occlude(points, seeded(), keep)
    stayed = (seen == points).all(dim=2)
    for cloud, after, same in zip(points, seen, stayed, strict=True):
        left = torch.unique(after, dim=0)
        assert len(left) == math.ceil(keep * 41)
        assert int(same.sum()) == len(left)
        inside = (cloud[:, None] == left).all(dim=2).any(dim=1)
        assert torch.equal(inside, same)  # kept points keep their place
    direction = torch.randn(6, 3, 1, generator=seeded())
    depth = (points @ direction)[:, :, 0]
    for along, same in zip(depth, stayed, strict=True):
        if not same.all():
            assert along[same].min() > along[~same].max()


def test_elastic_moves_neighbours_alike():
    """Smooth: twice as near, about half the difference; and of the size that its text says."""
    points = 0.7 * ball(40, 200)
    near = points + 0.02 * torch.nn.functional.normalize(torch.randn(points.shape), dim=2)
    moved, beside = (distortions.elastic(p, seeded(), 0.8, 1.6) - p for p in (points, near))
    deviation = float(moved.square().mean().sqrt())
    # An average over the cell's eight nodes lies below the nodes' own deviation, 0.11 · 1.6.
    assert 0.08 < deviation < 0.19
    assert float((moved - beside).square().mean().sqrt()) < 0.1 * deviation
    assert torch.equal(distortions.elastic(points, seeded(), 0.2, 0.0), points)


def test_elastic_is_trilinear_between_its_nodes():
    generator = seeded(3)
    noise = torch.randn(1, 3, 7, 7, 7, generator=seeded(3)).numpy()
    for _ in range(2):
        noise = uniform_filter(noise, (1, 1, 3, 3, 3), mode="constant")
    axis = 0.5 * np.arange(-3, 4)
    points = ball(1, 20)
    moved = (distortions.elastic(points, generator, 0.5, 2.0) - points)[0].numpy()
    for coordinate in range(3):
        # The field is stored [z y x].
        field = RegularGridInterpolator((axis, axis, axis), noise[0, coordinate])
        expected = 2.0 * field(points[0].numpy()[:, ::-1])
        assert moved[:, coordinate] == pytest.approx(expected, abs=1e-5)
