"""Weights of the authors' PyTorch releases, under their key names, into our networks."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from qs3.errors import InputError
from qs3.models.classifier import PointClassifier
from qs3.models.factory import create_model

_PREFIX = "module."


class _Layer(NamedTuple):
    """A layer of a release, and what it is called here."""

    ours: str
    theirs: tuple[str, ...]
    """Its name, or its names where the release registers it twice."""
    dimensions: dict[str, int]
    """Number of dimensions of each of its tensors, by name."""
    norm: str = ""
    """Our normalisation after it, whose running mean takes a bias that ours leaves out."""


class _Release(NamedTuple):
    """How a release names its layers, and which settings its shapes tell."""

    layers: tuple[_Layer, ...]
    settings: Callable[[Mapping[str, Tensor]], dict[str, Any]]
    defaults: Mapping[str, Any] = {}
    """Settings in which the release differs from ours and that the weights do not tell."""


def _linear(
    ours: str, theirs: str, dimensions: int = 2, bias: bool = True, norm: str = ""
) -> _Layer:
    parts = {"weight": dimensions} | ({"bias": 1} if bias else {})
    return _Layer(ours, (theirs,), parts, norm)


def _norm(ours: str, *theirs: str) -> _Layer:
    vectors = dict.fromkeys(("weight", "bias", "running_mean", "running_var"), 1)
    return _Layer(ours, theirs, vectors | {"num_batches_tracked": 0})


def _widths(tensors: Mapping[str, Tensor], names: Sequence[str]) -> tuple[int, ...]:
    return tuple(len(tensors[f"{name}.weight"]) for name in names)


def _dgcnn_layers() -> Iterator[_Layer]:
    for level in range(4):
        theirs = f"conv{level + 1}"
        yield _linear(f"convolutions.{level}.linear", f"{theirs}.0", 4, bias=False)
        yield _norm(f"convolutions.{level}.norm", f"{theirs}.1", f"bn{level + 1}")
    yield _linear("embed.linear", "conv5.0", 3, bias=False)
    yield _norm("embed.norm", "conv5.1", "bn5")
    yield _linear("classify.layers.0", "linear1", bias=False)
    yield _norm("classify.layers.1", "bn6")
    yield _linear("classify.layers.4", "linear2")
    yield _norm("classify.layers.5", "bn7")
    yield _linear("classify.layers.8", "linear3")


def _dgcnn_settings(tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    return {
        "num_classes": len(tensors["linear3.weight"]),
        "channels": _widths(tensors, [f"conv{level}.0" for level in range(1, 5)]),
        "embedding": len(tensors["conv5.0.weight"]),
        "hidden": _widths(tensors, ["linear1", "linear2"]),
    }


def _pointnet2_layers(multi: bool) -> Iterator[_Layer]:
    for level, scale in itertools.product(range(2), range(3 if multi else 1)):
        ours = f"levels.{level}.scales.{scale}.layers"
        kinds = ("conv_blocks", "bn_blocks") if multi else ("mlp_convs", "mlp_bns")
        block = f".{scale}" if multi else ""
        for depth in range(3):
            convolution, norm = (f"sa{level + 1}.{kind}{block}.{depth}" for kind in kinds)
            yield _norm(f"{ours}.{depth}.norm", norm)
            yield _linear(f"{ours}.{depth}.linear", convolution, 4, norm=f"{ours}.{depth}.norm")
    for depth in range(3):
        ours = f"embed.{depth}"
        yield _norm(f"{ours}.norm", f"sa3.mlp_bns.{depth}")
        yield _linear(f"{ours}.linear", f"sa3.mlp_convs.{depth}", 4, norm=f"{ours}.norm")
    yield _norm("classify.layers.1", "bn1")
    yield _linear("classify.layers.0", "fc1", norm="classify.layers.1")
    yield _norm("classify.layers.5", "bn2")
    yield _linear("classify.layers.4", "fc2")
    yield _linear("classify.layers.8", "fc3")


def _pointnet2_settings(tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    return {"num_classes": len(tensors["fc3.weight"])}


_RELEASES = {
    "dgcnn": _Release(tuple(_dgcnn_layers()), _dgcnn_settings),
    "pointnet2": _Release(
        tuple(_pointnet2_layers(False)), _pointnet2_settings, {"ball_order": "first"}
    ),
    "pointnet2-msg": _Release(
        tuple(_pointnet2_layers(True)), _pointnet2_settings, {"ball_order": "first"}
    ),
}


def load_reference(name: str, state_dict: Mapping[str, Any], **settings: Any) -> PointClassifier:
    """Make a network from the weights of its authors' PyTorch release.

    Key names and shapes must be the release's, all of them and no others, where a tensor has two
    names both of them; a ``module.`` in front of
    every name, which ``DataParallel`` leaves, is taken off. Known releases:

    - ``dgcnn``: ``DGCNN`` of https://github.com/WangYueFt/dgcnn (pytorch/model.py) and
      ``DGCNN_cls`` of https://github.com/antao97/dgcnn.pytorch (model.py); both name their layers
      alike and are the function of ours, whose default of 20 neighbours is that of their files for
      1,024 points. Those for 2,048 points need ``neighbours=40``.
    - ``pointnet2`` and ``pointnet2-msg``: ``pointnet2_cls_ssg`` and ``pointnet2_cls_msg`` of
      https://github.com/yanx27/Pointnet_Pointnet2_pytorch, trained without normals. A full ball
      keeps its first points, as there. Two differences stay: sampling starts at the point farthest
      from the mean, not at a random one, and logits are returned, not their log-softmax. The
      release's biases before a normalisation go into its running mean.

    NOTE: ``pointnet2_cls_msg`` drops 40 % of the first and 50 % of the second hidden layer; the
    network here drops ``dropout`` (40 %) of both, which matters where training goes on.

    A published file is a pickle, which this package never opens: reading one can run any code in
    it. Turn it into safetensors outside, once::

        python -c "import torch, safetensors.torch as s; \
d = torch.load('model.1024.t7', map_location='cpu', weights_only=True); \
s.save_file({k: v.clone() for k, v in d.get('model_state_dict', d).items()}, 'out.safetensors')"

    and hand over ``safetensors.torch.load_file("out.safetensors")``. Some checkpoints of PointNet++
    hold NumPy numbers, which ``weights_only=True`` refuses; without it, only a file that you trust
    should be read.

    Args:
        name: The release, from the list above.
        state_dict: Tensors by the release's names.
        settings: Settings of the network that the weights do not tell.

    Returns:
        The network on the CPU in single precision, in evaluation mode.

    Raises:
        InputError: where a name is missing or unknown, or a tensor of another shape or kind; the
            first ones are named.

    Example:
        >>> load_reference("dgcnn", {})  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        qs3.errors.InputError: weights for dgcnn: 70 missing, such as bn1.bias, bn1.num_batches_...
    """
    if name not in _RELEASES:
        raise InputError(f"no release known for {name!r}; choose one of {', '.join(_RELEASES)}")
    release = _RELEASES[name]
    tensors = _under_first_names(name, _plain(name, state_dict), release.layers)
    told = release.settings(tensors)
    for key in settings:
        if key in told:
            raise InputError(f"weights for {name}: they tell {key} themselves; leave it out")
    with torch.random.fork_rng(devices=[]):  # the fresh weights are not a draw of the caller's
        model = create_model(name, **told, **(dict(release.defaults) | settings))
    _fill(name, model, tensors, release.layers)
    return model.eval()


def _plain(name: str, state_dict: Mapping[str, Any]) -> dict[str, Tensor]:
    """Return the tensors by name, without DataParallel's prefix."""
    for key, value in state_dict.items():
        if not isinstance(key, str) or not isinstance(value, Tensor):
            raise InputError(
                f"weights for {name}: {key!r} is no tensor by name; hand over the state dict "
                "alone, without what else a checkpoint holds"
            )
    wrapped = all(key.startswith(_PREFIX) for key in state_dict)
    return {key.removeprefix(_PREFIX) if wrapped else key: v for key, v in state_dict.items()}


def _under_first_names(
    name: str, tensors: Mapping[str, Tensor], layers: Sequence[_Layer]
) -> dict[str, Tensor]:
    """Return each layer's tensors under its first name; refuse what is too many or too few."""
    found: dict[str, Tensor] = {}
    missing: list[str] = []
    unknown = set(tensors)
    for layer in layers:
        for part, dimensions in layer.dimensions.items():
            names = [f"{prefix}.{part}" for prefix in layer.theirs]
            given = [key for key in names if key in tensors]
            unknown.difference_update(given)
            missing += [key for key in names if key not in tensors]
            if len(given) < len(names):
                continue
            first, *others = (tensors[key] for key in names)
            if first.ndim != dimensions:
                raise _odd_shape(name, names[0], first, f"{dimensions} dimensions")
            if part != "num_batches_tracked" and not first.is_floating_point():
                raise InputError(
                    f"weights for {name}: {names[0]} holds {first.dtype}, not floating-point "
                    "numbers; hand over the release's own tensors"
                )
            if any(not torch.equal(first, other) for other in others):
                raise InputError(
                    f"weights for {name}: {' and '.join(names)} are one tensor in the release, "
                    "but differ here"
                )
            found[names[0]] = first
    faults = [
        f"{len(keys)} {what}, such as {', '.join(sorted(keys)[:3])}"
        for what, keys in (("missing", missing), ("unknown", unknown))
        if keys
    ]
    if faults:
        raise InputError(
            f"weights for {name}: {'; '.join(faults)}; hand over the release's state dict whole"
        )
    return found


def _odd_shape(name: str, key: str, value: Tensor, expected: str) -> InputError:
    return InputError(
        f"weights for {name}: {key} has shape {list(value.shape)}, not {expected}; "
        "these are weights of another network"
    )


@torch.no_grad()
def _fill(
    name: str, model: nn.Module, tensors: Mapping[str, Tensor], layers: Sequence[_Layer]
) -> None:
    """Copy the tensors into the network; the last dimensions of a convolution are 1."""
    ours = model.state_dict()
    for layer in layers:
        for part, dimensions in layer.dimensions.items():
            key = f"{layer.theirs[0]}.{part}"
            absorbed = f"{layer.ours}.{part}" not in ours
            target = ours[f"{layer.norm}.running_mean" if absorbed else f"{layer.ours}.{part}"]
            expected = target.shape + (1,) * (dimensions - target.ndim)
            if tensors[key].shape != expected:
                raise _odd_shape(name, key, tensors[key], str(list(expected)))
            value = tensors[key].to(target.dtype).reshape(target.shape)
            target.copy_(target - value if absorbed else value)
