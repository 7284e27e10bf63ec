"""Weights of the authors' PyTorch releases, under their key names, into our networks."""

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from qs3.errors import InputError, no_such
from qs3.models.classifier import PointClassifier
from qs3.models.factory import create_model

_PREFIX = "module."
_NORM = {"weight": 1, "bias": 1, "running_mean": 1, "running_var": 1, "num_batches_tracked": 0}
"""Tensors of a batch normalisation and their numbers of dimensions."""


class _Tensor(NamedTuple):
    """A tensor of a release, and what it is called here."""

    ours: str
    theirs: tuple[str, ...]
    """Its name, or its names where the release registers it twice."""
    dimensions: int
    absorbed: bool = False
    """Whether it is a bias that ours leaves out, which goes into the running mean after it."""


class _Release(NamedTuple):
    """Tensors of a release, and which settings their shapes tell."""

    tensors: tuple[_Tensor, ...]
    settings: Callable[[Mapping[str, Tensor]], dict[str, Any]]
    defaults: Mapping[str, Any] = {}
    """Settings in which the release differs from ours and that the weights do not tell."""


def _linear(
    ours: str, theirs: str, dimensions: int = 2, bias: bool = True, norm: str = ""
) -> Iterator[_Tensor]:
    yield _Tensor(f"{ours}.weight", (f"{theirs}.weight",), dimensions)
    if norm:
        yield _Tensor(f"{norm}.running_mean", (f"{theirs}.bias",), 1, absorbed=True)
    elif bias:
        yield _Tensor(f"{ours}.bias", (f"{theirs}.bias",), 1)


def _norm(ours: str, *theirs: str) -> Iterator[_Tensor]:
    for part, dimensions in _NORM.items():
        yield _Tensor(f"{ours}.{part}", tuple(f"{name}.{part}" for name in theirs), dimensions)


def _widths(tensors: Mapping[str, Tensor], names: Sequence[str]) -> tuple[int, ...]:
    return tuple(len(tensors[f"{name}.weight"]) for name in names)


def _head(*names: str, norms: tuple[str, str], biases: bool) -> Iterator[_Tensor]:
    """Three linear layers, the first two normalised; with biases before that, or without."""
    for layer, (theirs, norm) in enumerate(zip(names, (*norms, ""), strict=True)):
        ours, after = f"classify.layers.{4 * layer}", f"classify.layers.{4 * layer + 1}"
        if norm:
            yield from _norm(after, norm)
        absorbs = after if layer == 0 and biases else ""
        yield from _linear(ours, theirs, bias=layer > 0, norm=absorbs)


def _dgcnn() -> Iterator[_Tensor]:
    for level in range(4):
        theirs = f"conv{level + 1}"
        yield from _linear(f"convolutions.{level}.linear", f"{theirs}.0", 4, bias=False)
        yield from _norm(f"convolutions.{level}.norm", f"{theirs}.1", f"bn{level + 1}")
    yield from _linear("embed.linear", "conv5.0", 3, bias=False)
    yield from _norm("embed.norm", "conv5.1", "bn5")
    yield from _head("linear1", "linear2", "linear3", norms=("bn6", "bn7"), biases=False)


def _dgcnn_settings(tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    return {
        "num_classes": len(tensors["linear3.weight"]),
        "channels": _widths(tensors, [f"conv{level}.0" for level in range(1, 5)]),
        "embedding": len(tensors["conv5.0.weight"]),
        "hidden": _widths(tensors, ["linear1", "linear2"]),
    }


def _pointnet2(multi: bool) -> Iterator[_Tensor]:
    kinds = ("conv_blocks", "bn_blocks") if multi else ("mlp_convs", "mlp_bns")
    places = [
        (f"levels.{level}.scales.{scale}.layers", f"sa{level + 1}", kinds, f"{scale}." * multi)
        for level, scale in itertools.product(range(2), range(3 if multi else 1))
    ]
    places.append(("embed", "sa3", ("mlp_convs", "mlp_bns"), ""))
    for (ours, theirs, (convolution, norm), block), depth in itertools.product(places, range(3)):
        layer, place = f"{ours}.{depth}", f"{block}{depth}"
        yield from _norm(f"{layer}.norm", f"{theirs}.{norm}.{place}")
        yield from _linear(
            f"{layer}.linear", f"{theirs}.{convolution}.{place}", 4, norm=f"{layer}.norm"
        )
    yield from _head("fc1", "fc2", "fc3", norms=("bn1", "bn2"), biases=True)


def _pointnet2_settings(tensors: Mapping[str, Tensor]) -> dict[str, Any]:
    return {"num_classes": len(tensors["fc3.weight"])}


_FIRST = {"ball_order": "first"}
_RELEASES = {
    "dgcnn": _Release(tuple(_dgcnn()), _dgcnn_settings),
    "pointnet2": _Release(tuple(_pointnet2(False)), _pointnet2_settings, _FIRST),
    "pointnet2-msg": _Release(tuple(_pointnet2(True)), _pointnet2_settings, _FIRST),
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
    should be read. ``settings`` are those of the network that the weights do not tell.

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
        raise no_such(f"no release known for {name!r}", name, _RELEASES)
    release = _RELEASES[name]
    weights = _under_first_names(name, _plain(name, state_dict), release.tensors)
    implied = release.settings(weights)
    for key in settings:
        if key in implied:
            raise InputError(f"weights for {name}: they tell {key} themselves; leave it out")
    with torch.random.fork_rng(devices=[]):  # the fresh weights are not a draw of the caller's
        model = create_model(name, **implied, **(dict(release.defaults) | settings))
    ours = model.state_dict()
    for tensor in release.tensors:
        key, target = tensor.theirs[0], ours[tensor.ours]
        # The last dimensions of a convolution are 1.
        expected = target.shape + (1,) * (tensor.dimensions - target.ndim)
        if weights[key].shape != expected:
            raise _odd_shape(name, key, weights[key], str(list(expected)))
        value = weights[key].to(target.dtype).reshape(target.shape)
        target.copy_(target - value if tensor.absorbed else value)
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
    name: str, weights: Mapping[str, Tensor], tensors: Sequence[_Tensor]
) -> dict[str, Tensor]:
    """Return each tensor under its first name; refuse what is too many, too few or odd."""
    names = {key for tensor in tensors for key in tensor.theirs}
    odd = {"missing": names - set(weights), "unknown": set(weights) - names}
    faults = [
        f"{len(keys)} {what}, such as {', '.join(sorted(keys)[:3])}"
        for what, keys in odd.items()
        if keys
    ]
    if faults:
        raise InputError(
            f"weights for {name}: {'; '.join(faults)}; hand over the release's state dict whole"
        )
    for tensor in tensors:
        first, *others = (weights[key] for key in tensor.theirs)
        if first.ndim != tensor.dimensions:
            raise _odd_shape(name, tensor.theirs[0], first, f"{tensor.dimensions} dimensions")
        if tensor.dimensions and not first.is_floating_point():
            raise InputError(
                f"weights for {name}: {tensor.theirs[0]} holds {first.dtype}, not floating-point "
                "numbers; hand over the release's own tensors"
            )
        if any(not torch.equal(first, other) for other in others):
            raise InputError(
                f"weights for {name}: {' and '.join(tensor.theirs)} are one tensor in the "
                "release, but differ here"
            )
    return {tensor.theirs[0]: weights[tensor.theirs[0]] for tensor in tensors}


def _odd_shape(name: str, key: str, value: Tensor, expected: str) -> InputError:
    return InputError(
        f"weights for {name}: {key} has shape {list(value.shape)}, not {expected}; "
        "these are weights of another network"
    )
