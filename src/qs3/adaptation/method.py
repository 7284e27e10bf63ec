"""Methods of adaptation: their base class, training on the source alone, and on pseudo labels."""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import ClassVar, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Generator, Tensor, nn

from qs3.checks import check
from qs3.errors import InputError
from qs3.models import Features, PointClassifier, feature_widths
from qs3.models.wrappers import Sized

Target = Float[Tensor, "b_t n_t 3"] | None
"""Clouds of the target; None if a method does without."""

Terms = dict[str, Tensor]


class Batch(NamedTuple):
    """Labelled clouds on the training device."""

    points: Float[Tensor, "b n 3"]
    labels: Int[Tensor, "b"]
    parts: tuple[int, ...] = ()
    """Numbers of clouds from each of several sets, in order; empty if there is one set."""


def cross_entropy(
    logits: Float[Tensor, "b k"], labels: Int[Tensor, "b"], label_smoothing: float = 0.0
) -> Float[Tensor, ""]:
    """Mean cross entropy, in single precision at least.

    ``label_smoothing`` is ε of Szegedy et al. (CVPR 2016, §7): the target is 1 − ε at the label
    plus ε/k everywhere.

    Example:
        >>> float(cross_entropy(torch.zeros(1, 4), torch.tensor([2])).exp())
        4.0
    """
    logits = logits.float() if logits.dtype in (torch.float16, torch.bfloat16) else logits
    return torch.nn.functional.cross_entropy(logits, labels, label_smoothing=label_smoothing)


@dataclass(eq=False, repr=False, kw_only=True)
class Method(nn.Module, ABC):
    """A training method on a labelled source and, maybe, an unlabelled target.

    A method owns the network and its further modules (heads, discriminators). It never sees a label
    of the target. Its settings are the fields of a dataclass; `__post_init__` checks them and makes
    the further modules.
    """

    uses_target: ClassVar[bool] = False
    """True if `losses` needs a batch of the target."""
    needs_local: ClassVar[bool] = False
    """True if the method needs ``Features.local`` of the network."""
    in_unit_ball: ClassVar[bool] = False
    """True if it takes clouds of radius 1 alone, not those of a `Sized` network."""

    model: PointClassifier = field(kw_only=False)
    label_smoothing: float = 0.0
    """ε of `cross_entropy` on the source."""

    def __new__(cls, *args: object, **settings: object):
        """Initialise the module before its fields are set, as PyTorch requires."""
        method = super().__new__(cls)
        nn.Module.__init__(method)
        return method

    def __post_init__(self) -> None:
        check(self, type(self).__name__)
        if self.needs_local and feature_widths(self.model).local is None:
            raise InputError(
                f"{type(self).__name__} needs features of single points, which "
                f"{type(self.model).__name__} does not give; choose dgcnn, pointnet, or "
                "pointnet2 (in Python with local=True)"
            )
        if self.in_unit_ball and isinstance(self.model, Sized):
            raise InputError(
                f"{type(self).__name__} changes clouds in the unit ball, where they have no size; "
                "leave size_input out, or choose another method"
            )
        self.right: Tensor | None = None

    @abstractmethod
    def losses(self, source: Batch, target: Target, progress: float, generator: Generator) -> Terms:
        """Return named scalar losses; their sum is minimised, each is logged.

        Args:
            source: Labelled clouds.
            target: Clouds of the target; None if `uses_target` is false.
            progress: Share of the training that is done, 0 to 1.
            generator: Source of every random draw of the method (on the CPU).
        """

    def forward(
        self, source: Batch, target: Target, progress: float, generator: Generator
    ) -> Terms:
        """Return `losses` of a step."""
        self.right = None
        return self.losses(source, target, progress, generator)

    def both(self, source: Batch, target: Target) -> tuple[Features, Features]:
        """Describe a batch of each domain, the source first.

        The domains pass through the network apart, so that each has its own batch statistics.
        """
        assert target is not None  # noqa: S101
        return self.model.encode(source.points), self.model.encode(target)

    def classification(self, logits: Float[Tensor, "b k"], batch: Batch) -> Float[Tensor, ""]:
        """Return the cross entropy on labelled clouds, and note how many the network had right."""
        self.right = (logits.detach().argmax(dim=1) == batch.labels).sum()
        return cross_entropy(logits, batch.labels, self.label_smoothing)

    def parameter_groups(self, learning_rate: float) -> Iterable[dict]:
        """Return the optimiser's parameter groups: by default one with every parameter."""
        return [{"params": [p for p in self.parameters() if p.requires_grad], "lr": learning_rate}]

    def after_step(self) -> None:
        """Run after each optimiser step; by default nothing."""


class SourceOnly(Method):
    """Cross entropy on the source.

    With the target's labelled training part as its source it is the paper's *Supervised*.
    """

    def losses(self, source: Batch, target: Target, progress: float, generator: Generator) -> Terms:
        """Return the cross entropy of the source batch."""
        return {"source": self.classification(self.model(source.points), source)}


@dataclass(eq=False, repr=False, kw_only=True)
class PseudoLabelled(Method):
    """Cross entropy on pseudo-labelled clouds of the target, plus that on the source.

    The first part of each batch is of the target, the second, if any, of the source. Each passes
    through the network separately, the source first.
    """

    weight_step: float = 0.0
    """Taken off the factors of both losses after each epoch; they begin at 1 (SPST: 0.005)."""
    epochs: range = range(1)
    """Numbers of the epochs of this training, for ``weight_step``."""

    def losses(self, source: Batch, target: Target, progress: float, generator: Generator) -> Terms:
        """Return the weighted cross entropies, ``pseudo`` and ``source``."""
        count = source.parts[0] if source.parts else len(source.labels)
        done = min(int(progress * len(self.epochs) + 1e-9), len(self.epochs) - 1)
        weight = 1.0 - self.weight_step * self.epochs[done]
        terms: dict[str, Tensor] = {}
        right = torch.zeros((), dtype=torch.int64, device=source.labels.device)
        passes: tuple[tuple[str, slice], ...] = (
            ("source", slice(count, None)),
            ("pseudo", slice(0, count)),
        )
        for name, rows in passes:
            labels = source.labels[rows]
            if not len(labels):
                continue
            logits = self.model(source.points[rows])
            right += (logits.detach().argmax(dim=1) == labels).sum()
            terms[name] = weight * cross_entropy(logits, labels, self.label_smoothing)
        self.right = right
        return terms
