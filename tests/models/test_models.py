"""One suite over all networks."""

import copy
import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import nn
from torch.optim.swa_utils import update_bn

from qs3.errors import InputError
from qs3.models import DGCNN, Features, create_model, list_models
from qs3.models.checks import (
    check_choice,
    check_flag,
    check_number,
    check_whole,
    check_wholes,
)

SMALL = {
    "dgcnn": {"neighbours": 6, "channels": (8, 8, 16), "embedding": 32, "hidden": (16, 8)},
    "pointnet": {"channels": (8, 8, 16), "hidden": (16, 8)},
    "pointnet of each point": {"channels": (8, 8, 16), "hidden": (16, 8), "per_point": True},
    "pointnet without T-Nets": {"channels": (8, 8, 16), "hidden": (16, 8), "transforms": False},
    "pointnet-sa": {
        "channels": (8, 8, 16, 16),
        "transform_hidden": (16, 8),
        "nodes": 12,
        "neighbours": 6,
        "radius": 0.9,
        "node_width": 8,
    },
    "pointnet2": {
        "centres": (12, 5),
        "scales": (((0.9, 6, (8, 8, 16)),), ((1.4, 4, (16, 16)),)),
        "embedding": (16, 24),
        "hidden": (16, 8),
        "per_point": True,
    },
    "pointnet2-msg": {
        "centres": (12, 5),
        "scales": (
            ((0.5, 4, (4, 8)), (0.9, 6, (8, 8, 8))),
            ((0.8, 3, (8, 16)), (1.4, 4, (8, 8, 8))),
        ),
        "embedding": (16, 24),
        "hidden": (16, 8),
    },
    "pointmlp-elite": {
        "embedding": 8,
        "expansions": (2, 1),
        "before": (1, 2),
        "after": (1, 1),
        "neighbours": (6, 4),
        "reducers": (2, 2),
        "bottleneck": 0.5,
        "hidden": (16, 8),
    },
    "rscnn": {
        "centres": (12, 5),
        "radii": (0.9, 1.4),
        "neighbours": (6, 4),
        "channels": (8, 16),
        "embedding": 16,
        "hidden": (16, 8),
    },
    "simpleview": {"width": 4, "resolution": 32},
    "simpleview in perspective": {"width": 4, "resolution": 32, "projection": "perspective"},
}
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
    assert features.per_point is None or features.per_point.shape[:2] == (4, n)
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
        found = model(points)
    rest = [0, 2, 3]
    torch.testing.assert_close(found[rest], wanted[rest])
    # Images leave such a point out, as they do points outside.
    assert found[1].isfinite().all() == name.startswith("simpleview")


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
def test_same_seed_same_weights_and_other_seed_others(name):
    first, again, other = (small(name, seed).state_dict() for seed in (0, 0, 1))
    assert all(torch.equal(first[key], again[key]) for key in first)
    assert any(not torch.equal(first[key], other[key]) for key in first)


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


@pytest.mark.parametrize("name", NAMES)
def test_state_dict_round_trip(name):
    model, other = small(name, 0).eval(), small(name, 1).eval()
    other.load_state_dict(model.state_dict())
    assert torch.equal(model(clouds()), other(clouds()))


def test_official_dgcnn_has_the_official_number_of_parameters():
    # Convolutions 2·3·64 + 2·64·64 + 2·64·128 + 2·128·256, embedding 512·1024, head
    # 2048·512 + 512·256 + 256 + 256·40 + 40, and two for each normalised channel.
    weights = 384 + 8192 + 16384 + 65536 + 524288 + 1048576 + 131072 + 256 + 10240 + 40
    normalised = 2 * (64 + 64 + 128 + 256 + 1024 + 512 + 256)
    total = sum(p.numel() for p in DGCNN(40).parameters())
    assert total == weights + normalised


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: create_model("dgcn", 5), "choose one of dgcnn, "),
        (lambda: create_model("dgcnn", 5, neighbors=3), "unknown setting 'neighbors'.*neighbours"),
        (lambda: create_model("dgcnn", 0), "num_classes"),
        (lambda: create_model("dgcnn", 5, neighbours=256), "1 to 255"),
        (
            lambda: create_model("pointnet", 5, dropout=2.0),
            "dropout must be a number, 0 to 1, not 2.0",
        ),
    ],
)
def test_faults_name_the_choices(call, message):
    with pytest.raises(InputError, match=message):
        call()


@pytest.mark.parametrize(
    ("name", "settings", "message"),
    [
        ("pointnet2", {"centres": (0, 4)}, "centres must be 2 whole numbers, each at least 1"),
        ("pointnet2", {"centres": (12, 4, 2)}, "centres must be 2 whole numbers"),
        ("pointnet2", {"embedding": ()}, "embedding must be 1 or more whole numbers"),
        (
            "pointnet2",
            {"scales": (((-0.2, 4, (8, 8)),), ((0.4, 4, (8, 8)),))},
            "radius in scales must be a number, larger than 0, not -0.2",
        ),
        ("pointnet2", {"scales": ()}, "scales must be one or more of"),
        ("pointnet2-msg", {"grouping": "ssg"}, "unknown setting 'grouping'.* from centres, scal"),
        ("pointnet", {"channels": ()}, "channels must be 3 or more whole numbers"),
        ("pointnet", {"channels": (8, 0, 8)}, "channels must be 3 or more .* each at least 1"),
        ("pointnet", {"hidden": (8, 0)}, "hidden must be 0 or more whole numbers, each at least 1"),
        ("pointnet", {"dropout": -0.5}, "dropout must be a number, 0 to 1, not -0.5"),
        ("pointnet", {"dropout": float("nan")}, "dropout must be a number"),
        ("pointmlp-elite", {"reducers": (2, 2, 2, 0)}, "reducers must be .* each 1 to 255"),
        ("pointmlp-elite", {"after": (1, 1, 256, 1)}, "after must be .* each 0 to 255"),
        ("pointmlp-elite", {"bottleneck": 0.0}, "bottleneck must be a number, larger than 0"),
        ("rscnn", {"radii": (float("inf"), 1.0)}, "radii must be a number"),
        ("rscnn", {"neighbours": (0, 4)}, "neighbours must be .* each at least 1"),
        ("rscnn", {"channels": (8, 2)}, "channels must be .* each at least 4"),
        ("rscnn", {"order": "first"}, "unknown setting 'order'.* ball_order"),
        ("simpleview", {"width": 0}, "width must be a whole number, at least 1, not 0"),
    ],
)
def test_a_setting_out_of_range_is_named_with_its_range(name, settings, message):
    with pytest.raises(InputError, match=message):
        create_model(name, 5, **settings)


@pytest.mark.parametrize(
    ("check", "message"),
    [
        (lambda: check_whole("k", 2.5, 1, 255), "k must be a whole number, 1 to 255, not 2.5"),
        (lambda: check_whole("k", True), "k must be a whole number"),
        (lambda: check_wholes("widths", 8), "widths must be 1 or more whole numbers"),
        (lambda: check_wholes("widths", (8, "8")), "widths must be 1 or more whole numbers"),
        (lambda: check_number("dropout", "0.5", 0.0, 1.0), "dropout must be a number, 0 to 1"),
        (lambda: check_number("radius", None), "radius must be a number, larger than 0"),
        (lambda: check_flag("per_point", "yes"), "per_point must be true or false, not 'yes'"),
        (lambda: check_choice("projection", 3, "near", "far"), "projection must be near or far"),
    ],
)
def test_a_setting_of_another_kind_is_refused(check, message):
    with pytest.raises(InputError, match=message):
        check()


def test_lists_within_lists_make_the_same_network():
    scales = json.loads(json.dumps(SMALL["pointnet2"]["scales"]))
    model = create_model("pointnet2", 5, **SMALL["pointnet2"] | {"scales": scales})
    assert model.levels[1].balls == small("pointnet2").levels[1].balls


def test_json_lists_make_the_same_network():
    model = create_model("pointnet", 5, channels=[8, 8, 16], hidden=[8])
    assert model(clouds()).shape == (4, 5)


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
def test_training_moves_every_running_statistic(name):
    model = small(name).train()
    before = copy.deepcopy(model.state_dict())
    model(clouds())
    for key, value in model.state_dict().items():
        if "running" in key:
            assert not torch.equal(before[key], value), key


def without_dropout(name):
    model = small(name).double()
    for layer in model.modules():
        if isinstance(layer, nn.Dropout):
            layer.p = 0.0
    return model


def norms(model):
    return [m for m in model.modules() if isinstance(m, nn.BatchNorm1d | nn.BatchNorm2d)]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("gradients", [True, False])
def test_each_normalisation_goes_by_its_own_mode(name, gradients):
    points = clouds().double()
    trained, adapted, frozen, still = (without_dropout(name) for _ in range(4))
    trained.train()
    for model, others in ((adapted, False), (frozen, True)):
        model.train(others)
        for norm in norms(model):
            norm.train(not others)
    still.eval()
    with torch.set_grad_enabled(gradients):
        torch.testing.assert_close(adapted(points), trained(points), rtol=0, atol=1e-9)
        torch.testing.assert_close(frozen(points), still(points), rtol=0, atol=1e-9)
    for one, two in ((adapted, trained), (frozen, still)):
        for key, value in one.state_dict().items():
            torch.testing.assert_close(value, two.state_dict()[key], rtol=0, atol=1e-9)
    for norm, twin in zip(norms(adapted), norms(still), strict=True):
        assert not torch.equal(norm.running_mean, twin.running_mean)


@pytest.mark.parametrize("name", NAMES)
def test_without_momentum_statistics_are_the_mean_over_the_batches(name):
    batches = [clouds(seed=seed).double() for seed in range(3)]
    model = without_dropout(name)
    update_bn(batches, model)
    alone = []
    for batch in batches:
        once = without_dropout(name)
        for norm in norms(once):
            norm.momentum = 1.0
        once.train()(batch)
        alone.append(once.state_dict())
    for key, value in model.state_dict().items():
        if "running" in key:
            mean = torch.stack([state[key] for state in alone]).mean(dim=0)
            torch.testing.assert_close(value, mean, rtol=0, atol=1e-9)


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


@pytest.mark.parametrize(
    ("backend", "names"),
    [
        pytest.param("aot_eager", ["dgcnn"], marks=pytest.mark.slow),
        pytest.param("aot_eager", NAMES, marks=pytest.mark.slow),
        pytest.param("inductor", NAMES, marks=pytest.mark.slow),
    ],
    ids=["one traced", "all traced", "all compiled"],
)
def test_compiled_networks_give_the_same_scores_and_gradients(backend, names):
    worker = Path(__file__).with_name("compile_worker.py")
    given = json.dumps({name: [name.split()[0], SMALL[name]] for name in names})
    done = subprocess.run(
        [sys.executable, str(worker), backend], input=given, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr[-2000:]
    worst = json.loads(done.stdout)
    assert len(worst) == 2 * len(names)
    assert all(value < 1e-3 for value in worst.values()), worst


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="torch sees no CUDA device")
@pytest.mark.parametrize("name", NAMES)
def test_a_gpu_gives_the_same_scores_and_gradients(name):
    model = small(name).double().eval()
    twin = copy.deepcopy(model).cuda()
    here, there = model(clouds().double()), twin(clouds().double().cuda())
    torch.testing.assert_close(there.cpu(), here, rtol=0, atol=1e-9)
    here.square().sum().backward()
    there.square().sum().backward()
    for one, two in zip(twin.parameters(), model.parameters(), strict=True):
        torch.testing.assert_close(one.grad.cpu(), two.grad, rtol=1e-9, atol=1e-9)
