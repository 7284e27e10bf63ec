"""Self-distillation with a mean teacher (Cardace et al., WACV 2023, arXiv 2210.08226)."""

import copy
import math
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Generator, Tensor, nn

from qs3.adaptation import distortions
from qs3.adaptation.method import Batch, Domain, Method, Target, Terms
from qs3.errors import InputError
from qs3.models.checks import check_positive, check_range
from qs3.models.sized import Sized, unit_of

_ELASTIC = ((0.2, 0.4), (0.8, 1.6))
"""Grain and strength of the strong view's two elastic distortions, as in the released code."""


def distillation_loss(
    student: Float[Tensor, "b c"],
    teacher: Float[Tensor, "b c"],
    student_temperature: float = 0.5,
    teacher_temperature: float = 0.1,
) -> Float[Tensor, ""]:
    """Return the cross entropy of the teacher's sharpened description to the student's.

    Mean over clouds of −Σ_c softmax(t/τ_t)_c ln softmax(s/τ_s)_c, the softmax over the channels of
    the feature; no gradient goes to the teacher. A τ_t below τ_s sharpens.

    Example:
        >>> float(distillation_loss(torch.zeros(1, 4), torch.zeros(1, 4)).exp())
        4.0
    """
    goal = (teacher.detach().float() / teacher_temperature).softmax(dim=1)
    return -(goal * (student.float() / student_temperature).log_softmax(dim=1)).sum(dim=1).mean()


def ramp(progress: float) -> float:
    """Return exp(−5 (1 − t)²), the growth of the weight (Laine and Aila, ICLR 2017).

    Example:
        >>> round(ramp(0.0), 4), ramp(1.0)
        (0.0067, 1.0)
    """
    return math.exp(-5.0 * (1.0 - progress) ** 2)


@torch.no_grad()
def follow(average: nn.Module, student: nn.Module, decay: float) -> None:
    """Move an average by 1 − decay towards a network; integers are copied.

    Example:
        >>> average, student = torch.nn.Linear(1, 1), torch.nn.Linear(1, 1)
        >>> follow(average, student, 0.0)
        >>> torch.equal(average.weight, student.weight)
        True
    """
    present = student.state_dict()
    for name, tensor in average.state_dict().items():
        if tensor.is_floating_point():
            tensor.lerp_(present[name], 1.0 - decay)
        else:
            tensor.copy_(present[name])


@dataclass(eq=False, repr=False, kw_only=True)
class SelfDistillation(Method):
    """The student learns to see in a distorted cloud what its teacher sees in the plain one.

    Strong views of both domains go to the student, weak ones to the teacher, whose weights and
    running statistics are a moving average of the student's. The loss is the source's cross entropy
    on strong views plus ``weight · ramp · distillation_loss`` on the pooled features of both
    domains, mean over all clouds. Weak view: jitter. Strong view: two elastic distortions, scaling,
    jitter, and a plane cut (`qs3.adaptation.distortions`). After step t the average moves by
    1 − min(decay, 1 − 1/(t + 1)) towards the student, so that it begins as the plain mean.

    `result` is the student, as the released code evaluates it: the teacher lags behind by a
    thousand steps, and rounds of self-training go on from the student. ``ema_decay`` of the
    training settings averages it where that is wanted.

    NOTE: the paper's text leaves settings open; they come from the authors' released settings, and
    differ from these as follows:

    - The graph refinement of pseudo labels belongs to the rounds of self-training
      (`qs3.adaptation.graph_labels`); this class is the first of the two stages.
    - Augmentation of the training loop comes before both views; the authors turn strong views of
      the source about z and leave all others.
    - The authors cut sources that are CAD models, not the target; so ``source_keep`` is 0.7 and
      ``target_keep`` 1. Their cut leaves fewer points, ours repeats kept ones.
    - The elastic distortions cover the unit ball, theirs the cloud's own box; both are left out
      together once in twenty clouds in theirs, never here.
    - The features are those of our networks: DGCNN's maximum and mean, where theirs is the maximum.
    - Optimiser and learning rate are those of the training settings (theirs: AdamW, one cycle).

    """

    uses_target = True

    weight: float = 1.0
    """Of the distillation, at the end of its growth."""
    student_temperature: float = 0.5
    """τ_s of `distillation_loss`."""
    teacher_temperature: float = 0.1
    """τ_t."""
    decay: float = 0.999
    """Largest decay of the teacher's average."""
    source_keep: float = 0.7
    """Share of a source cloud's points that the cut of the strong view leaves."""
    target_keep: float = 1.0
    """The same on the target."""
    distortion: float = 1.0
    """Factor on the elastic distortions; 0 leaves them out."""
    scale: tuple[float, float] = (0.7, 1.5)
    """Bounds of the strong view's scaling; a network that is told the size gets none."""
    tilt: float = 0.0
    """Standard deviation of small turns in the strong view, in radians; 0 leaves them out, as the
    released code does."""
    sigma: float = 0.01
    """Standard deviation of the jitter of both views, cut at five times it."""

    def __post_init__(self) -> None:
        super().__post_init__()
        for name in ("weight", "distortion", "tilt", "sigma"):
            check_range(name, getattr(self, name), 0, 1e6)
        for name in ("student_temperature", "teacher_temperature", "scale"):
            check_positive(name, getattr(self, name))
        for name in ("source_keep", "target_keep"):
            check_positive(name, getattr(self, name))
            check_range(name, getattr(self, name), 0, 1)
        if not 0.0 <= self.decay < 1.0:
            raise InputError(f"decay must be 0 to below 1, not {self.decay}")
        if self.scale[0] > self.scale[1]:
            raise InputError(f"scale must be two bounds in order, not {self.scale}")
        # Copied together, so that the teacher's normalisation looks after the teacher's layers.
        self.teacher, self.teacher_norm = copy.deepcopy((self.model, self.norm))
        self.teacher.requires_grad_(False)
        self.register_buffer("steps", torch.zeros((), dtype=torch.int64))

    def losses(self, source: Batch, target: Target, progress: float, generator: Generator) -> Terms:
        """Return the cross entropy of the source's strong views, and the distillation."""
        assert target is not None  # noqa: S101
        self.teacher.eval()
        goals, pooled, logits = [], [], None
        domains: tuple[tuple[Domain, Tensor], ...] = (("source", source.points), ("target", target))
        for domain, points in domains:
            unit = unit_of(self.model, points)
            points = points / unit
            goals.append(self._describe(self._jitter(points, generator) * unit, domain))
            features = self.features(self._strong(points, domain, generator) * unit, domain)
            pooled.append(features.pooled)
            if domain == "source":
                logits = self.head(features, domain)
        assert logits is not None  # noqa: S101
        temperatures = self.student_temperature, self.teacher_temperature
        distance = distillation_loss(torch.cat(pooled), torch.cat(goals), *temperatures)
        return {
            "source": self.classification(logits, source),
            "distillation": self.weight * ramp(progress) * distance,
        }

    @torch.no_grad()
    def after_step(self) -> None:
        """Move the teacher towards the student; counts of batches are copied."""
        self.steps += 1
        decay = min(self.decay, 1.0 - 1.0 / (int(self.steps) + 1))
        pairs = ((self.teacher, self.model), (self.teacher_norm, self.norm))
        for average, student in pairs:
            follow(average, student, decay)

    @torch.no_grad()
    def _describe(self, points: Tensor, domain: Domain) -> Tensor:
        """Return what the teacher knows of clouds."""
        with self.teacher_norm.of(domain):
            return self.teacher.encode(points).pooled

    def _jitter(self, points: Tensor, generator: Generator) -> Tensor:
        return distortions.jitter(points, generator, self.sigma, 5 * self.sigma)

    def _strong(self, points: Tensor, domain: Domain, generator: Generator) -> Tensor:
        if self.tilt > 0:
            points = distortions.tilt(points, generator, self.tilt, 3 * self.tilt)
        if self.distortion > 0:
            for grain, strength in _ELASTIC:
                points = distortions.elastic(points, generator, grain, self.distortion * strength)
        if not isinstance(self.model, Sized):  # size would be told wrongly
            points = distortions.rescale(points, generator, *self.scale)
        points = self._jitter(points, generator)
        keep = self.source_keep if domain == "source" else self.target_keep
        return points if keep == 1 else distortions.occlude(points, generator, keep)
