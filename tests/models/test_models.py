"""One suite over all networks."""

import copy
import json

import pytest
import torch

from qs3.errors import InputError
from qs3.models import Features, create_model, list_models

from .common import SMALL

NAMES = sorted(SMALL)


def small(name, seed=0):
    torch.manual_seed(seed)
    return create_model(name.split()[0], 5, **SMALL[name])


def clouds(b=4, n=40, seed=0):
    return torch.randn(b, n, 3, generator=torch.Generator().manual_seed(seed))


def test_every_model_is_in_the_suite():
    assert set(list_models()) == {name.split()[0] for name in NAMES}


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("n", [1, 3, 40])
def test_shapes(name, n):
    model = small(name).eval()
    features = model.encode(clouds(n=n))
    assert isinstance(features, Features)
    assert features.pooled.ndim == 2
    assert features.local is None or features.local.shape[:2] == (4, n)
    logits = model(clouds(n=n))
    assert logits.shape == (4, 5)
    assert torch.equal(logits, model.head(features))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("train", [True, False])
def test_order_of_the_points_does_not_matter(name, train):
    model = small(name).double().train(train)
    for layer in model.modules():
        if isinstance(layer, torch.nn.Dropout):
            layer.eval()
    points = clouds().double()
    order = torch.randperm(40, generator=torch.Generator().manual_seed(1))
    torch.testing.assert_close(model(points[:, order]), model(points), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
def test_clouds_do_not_mix_in_evaluation(name):
    model = small(name).double().eval()
    points = clouds().double()
    torch.testing.assert_close(model(points)[2:3], model(points[2:3]), rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("learns", [True, False])
def test_a_cloud_that_is_not_finite_spoils_its_own_scores_alone(name, learns):
    model = small(name).eval()
    points = clouds()
    wanted = model(points)
    points[1, 7, 2] = torch.nan
    with torch.set_grad_enabled(learns):
        result = model(points)
    rest = [0, 2, 3]
    torch.testing.assert_close(result[rest], wanted[rest])
    # Images leave such a point out, as they do points outside.
    assert result[1].isfinite().all() == name.startswith("simpleview")


@pytest.mark.parametrize("name", NAMES)
def test_gradient_reaches_every_parameter(name):
    model = small(name).train()
    with torch.no_grad():
        for parameter in model.parameters():  # some layers start at zero: nothing passes them
            parameter += 0.1 * (not parameter.any())
    loss = torch.nn.functional.cross_entropy(model(clouds()), torch.tensor([0, 1, 2, 3]))
    loss.backward()
    for parameter_name, parameter in model.named_parameters():
        assert parameter.grad is not None, parameter_name
        assert parameter.grad.isfinite().all(), parameter_name
        assert parameter.grad.abs().sum() > 0, parameter_name


@pytest.mark.parametrize("name", NAMES)
def test_training_steps_are_bit_identical(name):
    def steps():
        model = small(name).train()
        optimiser = torch.optim.Adam(model.parameters())
        torch.manual_seed(5)
        for step in range(3):
            optimiser.zero_grad()
            logits = model(clouds(seed=step))
            torch.nn.functional.cross_entropy(logits, torch.tensor([0, 1, 2, 3])).backward()
            optimiser.step()
        return model.state_dict()

    first, again = steps(), steps()
    assert all(torch.equal(first[key], again[key]) for key in first)


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("dgcn", {}, "choose one of dgcnn, "),
        ("dgcnn", {"neighbors": 3}, "unknown setting 'neighbors' of dgcnn.*neighbours"),
        ("dgcnn", {"neighbours": 256}, "neighbours 256 must be at least 1 and at most 255"),
        ("dgcnn", {"neighbours": 2.5}, "field 'neighbours': 2.5 is not a whole number"),
        ("pointnet", {"channels": (8, 8)}, "channels must be three or more"),
        ("pointnet", {"dropout": float("nan")}, "dropout nan must be at least 0 and at most 1"),
        ("pointnet-sa", {"channels": (8, 8, 8)}, "a list of 3, not of 4"),
        ("pointnet2", {"centres": (12, 4, 2)}, "need one value for each level"),
        ("pointnet2", {"scales": ((0.2, 8, (8,)),) * 2}, "widths must be two or more"),
        ("rscnn", {"centres": (4, 8)}, "centres must not grow"),
        ("simpleview", {"resolution": 2000}, "resolution 2000 must be at least 8 and at most 1024"),
    ],
)
def test_unusable_settings_are_named(name, settings, message):
    with pytest.raises(InputError, match=message):
        create_model(name, **{"num_classes": 5} | settings)


def test_lists_within_lists_make_the_same_network():
    scales = json.loads(json.dumps(SMALL["pointnet2"]["scales"]))
    model = create_model("pointnet2", 5, **SMALL["pointnet2"] | {"scales": scales})
    assert str(model) == str(small("pointnet2"))
    assert model.levels[1].radius == 1.4


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("train", [True, False])
def test_repeated_points_give_finite_scores_and_gradients(name, train):
    model = small(name).train(train)
    points = clouds()[:, :1].expand(4, 40, 3).contiguous()
    logits = model(points)
    logits.square().sum().backward()
    assert logits.isfinite().all()
    assert all(p.grad.isfinite().all() for p in model.parameters() if p.grad is not None)


@pytest.mark.parametrize("name", NAMES)
def test_evaluation_changes_nothing_and_repeats_itself(name):
    model = small(name).eval()
    before = copy.deepcopy(model.state_dict())
    first = model(clouds())
    assert torch.equal(first, model(clouds()))
    assert all(torch.equal(before[key], value) for key, value in model.state_dict().items())
    assert torch.equal(first, copy.deepcopy(model)(clouds()))


@pytest.mark.parametrize("name", NAMES)
def test_double_in_double_out_and_close_to_single(name):
    model = small(name).eval()
    single = model(clouds())
    double = model.double()(clouds().double())
    assert (single.dtype, double.dtype) == (torch.float32, torch.float64)
    torch.testing.assert_close(single.double(), double, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_half_the_bits_give_nearly_the_same_scores(name):
    model = small(name).eval()
    exact = model(clouds())
    with torch.autocast("cpu", torch.bfloat16):
        rough = model(clouds())
    assert rough.isfinite().all()
    # 8 bits of mantissa: 0.4 % a product; errors of a dozen layers add up.
    assert (rough - exact).abs().max() < 0.05 * exact.abs().max()
    assert not torch.equal(rough.float(), exact)


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")
@pytest.mark.parametrize("name", NAMES)
def test_a_gpu_gives_the_same_scores_and_gradients(name):
    model = small(name).double().eval()
    twin = copy.deepcopy(model).cuda()
    on_cpu, on_gpu = model(clouds().double()), twin(clouds().double().cuda())
    torch.testing.assert_close(on_gpu.cpu(), on_cpu, rtol=0, atol=1e-9)
    on_cpu.square().sum().backward()
    on_gpu.square().sum().backward()
    for one, two in zip(twin.parameters(), model.parameters(), strict=True):
        torch.testing.assert_close(one.grad.cpu(), two.grad, rtol=1e-9, atol=1e-9)
