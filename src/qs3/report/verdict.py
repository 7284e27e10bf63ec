"""The verdict: did adaptation help, hurt, or make no clear difference? From the numbers alone."""

from dataclasses import dataclass
from typing import Literal

from qs3.evaluation.compare import mcnemar
from qs3.report.contents import Scored

Finding = Literal["helped", "no clear difference", "hurt"]


@dataclass(frozen=True)
class Verdict:
    """A finding, and the paragraph that gives its grounds."""

    finding: Finding
    """What the numbers allow to say."""
    opening: str
    """The finding in a word or two, without a full stop."""
    grounds: str
    """What it rests on, in plain words."""


def judge(before: Scored, after: Scored) -> Verdict:
    """Compare two networks on the same test clouds.

    Where it is known which clouds each network had right, McNemar's exact test on the clouds that
    changed decides (two-sided, 5 %). Otherwise the two 95 % intervals must not overlap.

    Example:
        >>> import numpy as np
        >>> from qs3.evaluation.records import score
        >>> labels = np.arange(100) % 2
        >>> before = Scored("source-only", score(labels, 0 * labels, ["bed", "chair"]))
        >>> judge(before, Scored("qbst", score(labels, labels, ["bed", "chair"]))).finding
        'helped'
        >>> judge(before, before).finding
        'no clear difference'
    """
    total = before.scores.clouds
    gain = 100.0 * (after.scores.accuracy - before.scores.accuracy)
    if before.right is not None and after.right is not None:
        change = mcnemar(after.right, before.right)
        clear = change.p < 0.05
        odds = "p < 0.001" if change.p < 0.001 else f"p = {change.p:.2g}"
        ground = (
            f"Of the {total} clouds, {change.first_only} became right and {change.second_only} "
            f"became wrong (exact sign test, {odds})."
        )
    else:
        low_before, high_before = before.scores.interval
        low_after, high_after = after.scores.interval
        clear = low_after > high_before or high_after < low_before
        ground = f"The two intervals {'do not overlap' if clear else 'overlap'}."

    finding: Finding = "no clear difference"
    opening = "No clear difference"
    words = (
        f"{after.name} and {before.name} differ by {gain:+.1f} points on the target, which "
        f"{total} clouds cannot tell from chance."
    )
    if clear:
        finding, way = ("helped", "more") if gain > 0 else ("hurt", "less")
        opening = f"Adaptation {finding}"
        words = (
            f"{after.name} is {abs(gain):.1f} points {way} accurate than {before.name} on the "
            "target."
        )
    elif after.correct == before.correct:
        words = f"{after.name} and {before.name} have the same number of the {total} target clouds "
        words += "right."
    sentences = [words, f"{_score(before)}; {_score(after)}.", ground]
    mean_gain = 100.0 * (after.scores.class_mean_accuracy - before.scores.class_mean_accuracy)
    if mean_gain * gain < 0:
        sentences.append(
            f"The class-mean accuracy went the other way ({mean_gain:+.1f} points): frequent and "
            "rare classes did not fare alike."
        )
    sentences.append(
        "The intervals cover the choice of test clouds, not the randomness of training: another "
        "seed gives other numbers."
    )
    return Verdict(finding, opening, " ".join(sentences))


def _score(network: Scored) -> str:
    scores = network.scores
    low, high = (100.0 * end for end in scores.interval)
    return (
        f"{network.name}: {100.0 * scores.accuracy:.1f} % of {scores.clouds} clouds "
        f"(95 % interval {low:.1f} to {high:.1f} %), "
        f"class mean {100.0 * scores.class_mean_accuracy:.1f} %"
    )
