"""Weights of the authors' releases, by the names that their modules give them."""

import itertools

import pytest
import torch

from qs3.errors import InputError
from qs3.models.ops import knn
from qs3.models.releases import load_reference

from .common import textbook


def norm(width, *names):
    shapes = dict.fromkeys(("weight", "bias", "running_mean", "running_var"), (width,))
    shapes["num_batches_tracked"] = ()
    return {f"{name}.{part}": shape for name in names for part, shape in shapes.items()}


# Written down from the modules of pytorch/model.py (class DGCNN) in WangYueFt/dgcnn and of model.py
# (class DGCNN_cls) in antao97/dgcnn.pytorch: each bnX is registered alone and within convX.
DGCNN = {
    "conv1.0.weight": (64, 6, 1, 1),
    "conv2.0.weight": (64, 128, 1, 1),
    "conv3.0.weight": (128, 128, 1, 1),
    "conv4.0.weight": (256, 256, 1, 1),
    "conv5.0.weight": (1024, 512, 1),
    **norm(64, "bn1", "conv1.1"),
    **norm(64, "bn2", "conv2.1"),
    **norm(128, "bn3", "conv3.1"),
    **norm(256, "bn4", "conv4.1"),
    **norm(1024, "bn5", "conv5.1"),
    "linear1.weight": (512, 2048),
    **norm(512, "bn6"),
    "linear2.weight": (256, 512),
    "linear2.bias": (256,),
    **norm(256, "bn7"),
    "linear3.weight": (40, 256),
    "linear3.bias": (40,),
}


def shared(level, widths, convolutions="mlp_convs", norms="mlp_bns"):
    shapes = {}
    for depth, (c, d) in enumerate(itertools.pairwise(widths)):
        shapes[f"{level}.{convolutions}.{depth}.weight"] = (d, c, 1, 1)
        shapes[f"{level}.{convolutions}.{depth}.bias"] = (d,)
        shapes |= norm(d, f"{level}.{norms}.{depth}")
    return shapes


def block(level, scale, widths):
    return shared(level, widths, f"conv_blocks.{scale}", f"bn_blocks.{scale}")


# Written down from models/pointnet2_cls_ssg.py, pointnet2_cls_msg.py (normal_channel=False) and
# pointnet2_utils.py in yanx27/Pointnet_Pointnet2_pytorch.
HEAD = {
    "fc1.weight": (512, 1024),
    "fc1.bias": (512,),
    **norm(512, "bn1"),
    "fc2.weight": (256, 512),
    "fc2.bias": (256,),
    **norm(256, "bn2"),
    "fc3.weight": (40, 256),
    "fc3.bias": (40,),
}
SSG = {
    **shared("sa1", (3, 64, 64, 128)),
    **shared("sa2", (131, 128, 128, 256)),
    **shared("sa3", (259, 256, 512, 1024)),
    **HEAD,
}
MSG = {
    **block("sa1", 0, (3, 32, 32, 64)),
    **block("sa1", 1, (3, 64, 64, 128)),
    **block("sa1", 2, (3, 64, 96, 128)),
    **block("sa2", 0, (323, 64, 64, 128)),
    **block("sa2", 1, (323, 128, 128, 256)),
    **block("sa2", 2, (323, 128, 128, 256)),
    **shared("sa3", (643, 256, 512, 1024)),
    **HEAD,
}
RELEASES = {"dgcnn": DGCNN, "pointnet2": SSG, "pointnet2-msg": MSG}


def random_weights(shapes, seed=0):
    generator = torch.Generator().manual_seed(seed)
    tensors = {}
    for key, shape in shapes.items():
        if key.endswith("num_batches_tracked"):
            tensors[key] = torch.tensor(7)
        elif key.endswith("running_var"):
            tensors[key] = torch.rand(shape, generator=generator) + 0.5
        else:
            size = max(1, torch.Size(shape[1:]).numel())
            tensors[key] = torch.randn(shape, generator=generator) / size**0.5
    for key in tensors:  # one tensor under two names
        if key.startswith("bn") and f"conv{key[2]}.1.weight" in shapes:
            tensors[key] = tensors[f"conv{key[2]}.1{key[3:]}"]
    return tensors


def clouds(b=2, n=96):
    return torch.randn(b, n, 3, generator=torch.Generator().manual_seed(1))


# The release's name of each part of the textbook form, which itself is written apart from ours.
TO_TEXTBOOK = {
    **{f"conv{i + 1}.0": f"convolutions.{i}.convolution" for i in range(4)},
    **{f"bn{i + 1}": f"convolutions.{i}.norm" for i in range(4)},
    "conv5.0": "embed.0",
    "bn5": "embed.1",
    "linear1": "classify.0",
    "bn6": "classify.1",
    "linear2": "classify.4",
    "bn7": "classify.5",
    "linear3": "classify.8",
}


def test_dgcnn_is_the_textbook_function_of_the_same_weights():
    weights = random_weights(DGCNN)
    model = load_reference("dgcnn", weights)
    slow = textbook("dgcnn").DGCNN(40)
    renamed = {}
    for key, value in weights.items():
        layer, part = key.rsplit(".", 1)
        if layer in TO_TEXTBOOK:
            renamed[f"{TO_TEXTBOOK[layer]}.{part}"] = value
    slow.load_state_dict(renamed)  # strict
    slow.double().eval()
    graphs = []
    model.double()
    features = clouds().double()
    for convolution in model.convolutions:
        graphs.append(knn(features, 20))
        features = convolution(features, graphs[-1])
    expected = slow(clouds().double(), graphs)
    assert expected.std() > 0.01
    torch.testing.assert_close(model(clouds().double()), expected, rtol=0, atol=1e-9)


@pytest.mark.parametrize("name", ["pointnet2", "pointnet2-msg"])
def test_pointnet2_is_the_release_s_function_of_the_same_weights(name):
    """The release's modules in plain terms: with biases, columns in its own order."""
    weights = {k: v.double() for k, v in random_weights(RELEASES[name]).items()}
    model = load_reference(name, weights).double()

    def layer(values, linear, norm):
        # Channels last.
        weight = weights[f"{linear}.weight"].flatten(1)
        values = values @ weight.t() + weights[f"{linear}.bias"]
        mean, variance = (weights[f"{norm}.running_{what}"] for what in ("mean", "var"))
        scaled = (values - mean) / (variance + 1e-5).sqrt() * weights[f"{norm}.weight"]
        return (scaled + weights[f"{norm}.bias"]).relu()

    points, features = clouds().double(), None
    for level in range(2):
        centres, balls = model.levels[level].group(points)
        described = []
        for scale, index in enumerate(balls):
            cloud = torch.arange(2)[:, None, None]
            values = points[cloud, index] - centres[:, :, None]
            if features is not None:
                parts = [values, features[cloud, index]]
                values = torch.cat(parts[::-1] if name.endswith("msg") else parts, dim=3)
            for depth in range(3):
                place = f"{scale}.{depth}" if name.endswith("msg") else depth
                kinds = ("conv_blocks", "bn_blocks", "mlp_convs", "mlp_bns")
                kinds = kinds[:2] if name.endswith("msg") else kinds[2:]
                values = layer(values, *(f"sa{level + 1}.{kind}.{place}" for kind in kinds))
            described.append(values.amax(dim=2))
        points, features = centres, torch.cat(described, dim=2)
    values = torch.cat([points, features], dim=2)
    for depth in range(3):
        values = layer(values, f"sa3.mlp_convs.{depth}", f"sa3.mlp_bns.{depth}")
    pooled = layer(layer(values.amax(dim=1), "fc1", "bn1"), "fc2", "bn2")
    expected = pooled @ weights["fc3.weight"].t() + weights["fc3.bias"]
    assert expected.std() > 0.01
    torch.testing.assert_close(model(clouds().double()), expected, rtol=0, atol=1e-5)
    assert all(level.ball_order == "first" for level in model.levels)


@pytest.mark.parametrize("name", RELEASES)
def test_every_tensor_of_ours_is_filled(name):
    first = load_reference(name, random_weights(RELEASES[name], 0)).state_dict()
    second = load_reference(name, random_weights(RELEASES[name], 1)).state_dict()
    for key, value in first.items():
        if key.endswith("num_batches_tracked"):
            assert value == 7
        else:
            assert not torch.equal(value, second[key]), key
    torch.manual_seed(3)
    before = torch.random.get_rng_state()
    again = load_reference(name, random_weights(RELEASES[name], 0)).state_dict()
    assert all(torch.equal(first[key], value) for key, value in again.items())
    assert torch.equal(torch.random.get_rng_state(), before)  # the caller's draws stay


def test_prefix_of_data_parallel_makes_no_difference():
    weights = random_weights(DGCNN)
    plain = load_reference("dgcnn", weights)
    wrapped = load_reference("dgcnn", {f"module.{key}": value for key, value in weights.items()})
    assert torch.equal(plain(clouds()), wrapped(clouds()))


def test_widths_and_classes_come_from_the_weights():
    shapes = dict(DGCNN)
    shapes["linear3.weight"], shapes["linear3.bias"] = (10, 256), (10,)
    model = load_reference("dgcnn", random_weights(shapes), neighbours=40, dropout=0.2)
    assert model(clouds()).shape == (2, 10)
    assert model.neighbours == 40
    assert not model.training


def without(weights, *keys):
    return {key: value for key, value in weights.items() if key not in keys}


@pytest.mark.parametrize("name", RELEASES)
def test_no_tensor_may_be_left_out_or_added(name):
    weights = random_weights(RELEASES[name])
    for key in list(weights)[::5]:
        with pytest.raises(InputError, match=f"1 missing, such as {key}"):
            load_reference(name, without(weights, key))
    with pytest.raises(InputError, match=r"1 unknown, such as conv9\.0\.weight"):
        load_reference(name, weights | {"conv9.0.weight": torch.zeros(1)})


@pytest.mark.parametrize("name", ["dgcnn", "pointnet2"])
def test_odd_shapes_and_whole_numbers_are_refused(name):
    weights = random_weights(RELEASES[name])
    # Every 11th is of each kind once: a layer and its normalisation have 6 or 7 tensors.
    for value in list(weights.values())[::11]:
        odd = [torch.zeros(3, *value.shape), torch.cat([value.flatten(), torch.ones(1)])]
        odd += [value[..., :0], value.long()] if value.ndim else []
        for other in odd:
            changed = {k: other if v is value else v for k, v in weights.items()}
            with pytest.raises(InputError, match=r"shape|holds torch\.int64"):
                load_reference(name, changed)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: load_reference("dgcn", {}), "choose one of dgcnn"),
        (lambda: load_reference("dgcnn", {}), "70 missing, such as bn1.bias, bn1"),
        (lambda: load_reference("dgcnn", {"model_state_dict": {}}), "'model_state_dict' is no ten"),
        (lambda: load_reference("dgcnn", random_weights(DGCNN), num_classes=3), "tell num_classes"),
        (lambda: load_reference("dgcnn", random_weights(DGCNN), neighbors=3), "'neighbors'"),
        (
            lambda: load_reference(
                "dgcnn", random_weights(DGCNN) | {"bn1.weight": torch.zeros(64)}
            ),
            "conv1.1.weight and bn1.weight are one tensor",
        ),
    ],
)
def test_faults_are_named(call, message):
    with pytest.raises(InputError, match=message):
        call()
