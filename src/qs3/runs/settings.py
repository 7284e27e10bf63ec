"""Settings of a training and of the self-training after it.

`qs3.structure` refuses unknown ones; `qs3.runs.run` reads the file of a run.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Any, Literal

from qs3.adaptation.names import RoundRule, Rule, Selection, SingleClass, split_method
from qs3.checks import (
    HIDDEN,
    INLINE,
    Bounds,
    Count,
    Natural,
    NotNegative,
    Positive,
    Seed,
    Share,
    check,
)
from qs3.clouds.preparation import PAPER, ROBUST, Preparation
from qs3.errors import InputError

Precision = Literal["32-true", "bf16-mixed"]
"""Number formats."""
Accelerator = Literal["auto", "cpu", "cuda"]
"""Devices of a training."""
PresetName = Literal["default", "gentle", "spst", "paper", "released"]
"""Presets: our defaults, gentle rounds, SPST's, QS³'s text, QS³'s released code."""
Teacher = Literal["latest", "best", "average"]
"""Networks that can give the pseudo labels."""
MOST_POINTS = 16_384
"""Most points per cloud: the distances among those of one alone take 1 GiB."""


@dataclass(frozen=True)
class Augmentation:
    """Augmentation that imitates what a scan loses and gains; all off by default.

    Lengths are relative to the cloud's radius, half the diagonal of the box of its middle 98 %.
    """

    sight: Share = 0.0
    """Probability that a cloud keeps only what one camera would see of it."""
    plane: Share = 0.0
    """Probability that a random plane cuts a cloud."""
    plane_share: Share = 0.4
    """Largest share of the points that the plane removes."""
    patches: Share = 0.0
    """Probability that patches of a cloud are removed."""
    patch_count: Count = 4
    """Number of patches."""
    patch_radius: NotNegative = 0.25
    """Largest radius of a patch."""
    least: Annotated[float, Bounds(high=1, above=True)] = 0.25
    """Share of the points that plane and patches always leave; `sight` is skipped if it would leave
    fewer."""
    stretch: Share = 0.0
    """Probability that each axis of a cloud is scaled by its own factor."""
    stretch_factor: Annotated[float, Bounds(1)] = 1.2
    """Largest factor; the smallest is its inverse."""
    tilt: Share = 0.0
    """Probability that a cloud is tilted about a random horizontal axis."""
    tilt_degrees: NotNegative = 3.0
    """Largest angle of the tilt in degrees."""
    floor: Share = 0.0
    """Probability that points are replaced by a floor under the cloud."""
    floor_share: Share = 0.2
    """Largest share of the points that the floor replaces."""
    noise: Share = 0.0
    """Probability of Gaussian noise."""
    noise_sigma: NotNegative = 0.02
    """Largest standard deviation of the noise."""

    def __post_init__(self) -> None:
        check(self, "augmentation")


@dataclass(frozen=True)
class TrainSettings:
    """Settings of a training."""

    model: str = "dgcnn"
    """Network, such as dgcnn or pointnet; forest, for known parts in metres, which trains in
    seconds; or a class of your own as my_module:MyNetwork."""
    model_settings: Annotated[Mapping[str, Any], HIDDEN] = field(default_factory=dict)
    """Settings of the network."""
    num_points: Annotated[int, Bounds(1, MOST_POINTS)] = 1024
    """Points per cloud, by farthest point sampling."""
    preparation: Annotated[Preparation, INLINE] = PAPER
    """Preprocessing of clouds: the paper's by default; ``qs3 train`` uses `preparation_of`."""
    augmentation: Augmentation = field(default_factory=Augmentation)
    """Augmentation, applied to whole clouds before their points are chosen."""
    epochs: Count = 200
    """Passes over the source (or over the target, if that is larger)."""
    batch_size: Annotated[int, Bounds(2)] = 32
    """Clouds of each domain in an optimiser step."""
    learning_rate: Positive = 1e-3
    """Adam's learning rate at the start; a cosine takes it to 0."""
    weight_decay: NotNegative = 5e-5
    """L2 penalty in Adam's gradient."""
    label_smoothing: Annotated[float, Bounds(high=1, below=True)] = 0.0
    """Probability mass spread evenly over the classes."""
    method_settings: Annotated[Mapping[str, Any], HIDDEN] = field(default_factory=dict)
    """Settings of the method."""
    holdout: Annotated[float, Bounds(high=1, below=True)] = 0.1
    """Share of the source held out for calibration and for the rule source-val."""
    validate_every: Natural = 10
    """Epochs between checkpoints; the last epoch and each round write one too. 0 writes none."""
    rule: Rule = "last"
    """Rule that chooses the network: the last checkpoint, or the most accurate on held-out
    source."""
    rotate_z: bool = True
    """Turn each cloud about the vertical at random."""
    jitter_sigma: NotNegative = 0.01
    """Standard deviation of Gaussian noise on each coordinate, in unit-ball units."""
    jitter_clip: NotNegative = 0.02
    """Largest noise on each coordinate."""
    seed: Seed = 0
    """Root of all random steps."""
    precision: Precision = "32-true"
    """Number format. bf16-mixed applies to layers over points, SimpleView's image network and the
    heads; it is slow on a CPU without bf16 units."""
    accelerator: Accelerator = "auto"
    """Device; auto uses a CUDA GPU if there is one. Apple's GPUs lack float64 and are not
    supported."""
    threads: Annotated[int | None, Bounds(1)] = None
    """CPU threads; default: OMP_NUM_THREADS, or all cores. A run keeps its number; results are
    bit-identical for equal numbers."""

    def __post_init__(self) -> None:
        check(self, "training")
        if self.rule != "last" and not self.validate_every:
            raise InputError(
                f"training: validate_every 0 leaves no checkpoint for rule {self.rule}"
            )


@dataclass(frozen=True)
class SelfTrainingSettings:
    """Settings of self-training rounds (QS³, Algorithm 1)."""

    rule: Annotated[RoundRule, HIDDEN] = "qbst"
    """Selection rule: ``qbst`` keeps fewer clouds of dominant classes (QS³), ``spst`` all above the
    threshold (Zou et al., ICCV 2021)."""
    threshold: Share = 0.8
    """θ₀, the confidence that a pseudo label must exceed in round 1."""
    step: NotNegative = 0.005
    """ε, added to θ after each round."""
    threshold_share: Annotated[float | None, Bounds(high=1, above=True)] = None
    """Share of the clouds above θ in each round; replaces threshold and step."""
    rounds: Count = 10
    """Number of rounds."""
    epochs: Count = 10
    """Passes over the selected clouds in each round."""
    selection: Selection = "most-confident"
    """End of a class's ranking by confidence that is kept."""
    inclusive: bool = False
    """Accept a confidence equal to θ."""
    pool: Literal["all", "shrinking", "split"] = "all"
    """Clouds to select from: all; shrinking, those that the last round kept (lines 6 and 16 of
    Algorithm 1, read literally); split, the 80 % whose index modulo 10 is below 8."""
    init: Literal["warm-up", "scratch"] = "warm-up"
    """Weights that round 1 starts from."""
    teacher: Teacher = "latest"
    """Network that gives the pseudo labels: that of the last round; best, on a fifth of the
    pseudo-labelled clouds that is held out; or a moving average from the warm-up on."""
    teacher_decay: Annotated[float, Bounds(high=1, below=True)] = 0.9
    """Decay of the moving average per epoch."""
    learning_rate: Annotated[float | None, Bounds(above=True)] = None
    """Adam's learning rate at the start of a round; default: that of the training before."""
    source_loss: bool = True
    """Train on as many labelled source clouds in each step."""
    weight_step: NotNegative = 0.0
    """Decrease of the weight of both losses after each epoch, from 1 on."""
    schedule: Literal["per-round", "continuous"] = "per-round"
    """A new optimiser and cosine in each round; or one optimiser and one cosine whose half period
    is a round."""
    single_class: SingleClass = "keep"
    """If all confident clouds have one class: keep them, or drop them all."""

    def __post_init__(self) -> None:
        check(self, "self-training")
        if self.threshold + self.step * (self.rounds - 1) > 1:
            raise InputError(f"self-training: step {self.step} takes θ above 1 within the rounds")
        if self.weight_step * (self.rounds * self.epochs - 1) >= 1:
            raise InputError(
                f"self-training: weight_step {self.weight_step} takes the weight of the losses to "
                "0 within the rounds"
            )
        if self.teacher == "average" and self.init == "scratch":
            raise InputError("self-training: teacher average needs init warm-up")
        for (reader, word), names in _READ_BY.items():
            for name in names:
                value = getattr(self, name)
                if getattr(self, reader) != word and value != getattr(type(self), name):
                    raise InputError(
                        f"self-training: {name} {value} is read with {reader} {word} only; leave "
                        f"it out with {reader} {getattr(self, reader)}"
                    )


_READ_BY: Mapping[tuple[str, str | None], tuple[str, ...]] = {
    ("rule", "qbst"): ("selection", "single_class"),
    ("threshold_share", None): ("threshold", "step"),
    ("teacher", "average"): ("teacher_decay",),
}
"""Settings that apply only for one value of another setting."""

GENTLE: Mapping[str, Any] = {
    "threshold_share": 0.5,
    "teacher": "average",
    "learning_rate": 1e-4,
    "rounds": 5,
    "epochs": 4,
}
"""Rounds of QBST that did best on NYU's real objects (docs/real.md)."""
PRESETS: Mapping[str, SelfTrainingSettings] = {
    "default": SelfTrainingSettings(),
    "gentle": SelfTrainingSettings(**GENTLE),
    # SPST: every confident cloud, both losses weighted alike and falling.
    "spst": SelfTrainingSettings(rule="spst", weight_step=0.005),
    # Algorithm 1 has Φ_init as a separate input next to the warm-up Φ_0: fresh weights.
    "paper": SelfTrainingSettings(
        pool="shrinking", init="scratch", source_loss=False, single_class="drop"
    ),
    "released": SelfTrainingSettings(
        selection="least-confident",
        inclusive=True,
        pool="split",
        init="scratch",
        teacher="best",
        source_loss=False,
        schedule="continuous",
        single_class="drop",
    ),
}
"""The settings of each preset."""


PUBLISHED = ("paper", "released")
"""Presets of QS³, with its preparation and without augmentation."""


def usual_preset(rule: str | None) -> PresetName:
    """Return the preset of rounds by a rule if none is named."""
    if rule == "qbst":
        return "gentle"
    return "spst" if rule == "spst" else "default"


def plan_rounds(
    method: str, rounds: SelfTrainingSettings | None
) -> tuple[str, SelfTrainingSettings | None]:
    """Return a method's training before the rounds, and the rounds: those given, or its own.

    Example:
        >>> plan_rounds("pcm", None), plan_rounds("qbst", None)[1] == PRESETS["gentle"]
        (('pcm', None), True)
    """
    base, rule = split_method(method)
    if rule is None:
        return base, rounds
    rounds = rounds or PRESETS[usual_preset(rule)]
    if rounds.rule != rule:
        raise InputError(
            f"method {method} selects by {rule}, its self-training settings say {rounds.rule}; "
            f"choose method {base} or rule {rule}"
        )
    return base, rounds


def preparation_of(preset: str | None) -> Preparation:
    """Return the preparation that goes with a preset of self-training, or with none."""
    return PAPER if preset in PUBLISHED else ROBUST


LIGHT = Augmentation(
    plane=0.25, plane_share=0.25, patches=0.25, stretch=1.0, tilt=1.0, floor=0.15, noise=0.5
)
"""Light cuts, tilt, stretch and a little floor."""
