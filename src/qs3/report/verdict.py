"""The verdict: did adaptation help, hurt, or make no clear difference? From the numbers alone."""

from dataclasses import dataclass
from typing import Literal

from scipy.stats import binomtest

from qs3.report.records import Outcome

Finding = Literal["helped", "no clear difference", "hurt"]


@dataclass(frozen=True)
class Verdict:
    """A finding, and the paragraph that gives its grounds."""

    finding: Finding
    """What the numbers allow to say."""
    text: str
    """Paragraph in plain words."""


def judge(before: Outcome, after: Outcome) -> Verdict:
    """Compare two models on the same test clouds.

    Where it is known which clouds each model had right, an exact sign test on the clouds that
    changed decides (McNemar's test, exact form; two-sided, 5 %). Otherwise the two 95 % intervals
    must not overlap.

    Example:
        >>> import numpy as np
        >>> before = Outcome("source-only", np.array([[20, 30], [30, 20]]))
        >>> judge(before, Outcome("qbst", np.array([[45, 5], [5, 45]]))).finding
        'helped'
        >>> judge(before, Outcome("qbst", np.array([[21, 29], [30, 20]]))).finding
        'no clear difference'
    """
    gain = 100.0 * (after.accuracy - before.accuracy)
    better = after.correct > before.correct
    if before.right is not None and after.right is not None:
        won = int((after.right & ~before.right).sum())
        lost = int((before.right & ~after.right).sum())
        p = float(binomtest(won, won + lost).pvalue) if won + lost else 1.0
        clear = p < 0.05
        odds = "p < 0.001" if p < 0.001 else f"p = {p:.2g}"
        ground = (
            f"Of the {before.total} clouds, {won} became right and {lost} became wrong "
            f"(exact sign test, {odds})."
        )
    else:
        (low_before, high_before), (low_after, high_after) = before.interval, after.interval
        clear = low_after > high_before or high_after < low_before
        ground = f"The two intervals {'do not overlap' if clear else 'overlap'}."

    finding: Finding = "no clear difference"
    if clear:
        finding = "helped" if better else "hurt"
    opening = {
        "helped": f"Adaptation helped: {after.name} is {gain:.1f} points more accurate than "
        f"{before.name} on the target.",
        "hurt": f"Adaptation hurt: {after.name} is {-gain:.1f} points less accurate than "
        f"{before.name} on the target.",
        "no clear difference": f"No clear difference: {after.name} and {before.name} differ by "
        f"{gain:+.1f} points on the target, which {before.total} clouds cannot tell from chance.",
    }[finding]
    if finding == "no clear difference" and after.correct == before.correct:
        opening = (
            f"No clear difference: {after.name} and {before.name} have the same number of the "
            f"{before.total} target clouds right."
        )
    sentences = [opening, f"{_score(before)}; {_score(after)}.", ground]
    mean_gain = 100.0 * (after.class_mean_accuracy - before.class_mean_accuracy)
    if mean_gain * gain < 0:
        sentences.append(
            f"The class-mean accuracy went the other way ({mean_gain:+.1f} points): frequent and "
            "rare classes did not fare alike."
        )
    sentences.append(
        "The intervals cover the choice of test clouds, not the randomness of training: another "
        "seed gives other numbers."
    )
    return Verdict(finding, " ".join(sentences))


def _score(outcome: Outcome) -> str:
    low, high = (100.0 * x for x in outcome.interval)
    return (
        f"{outcome.name}: {100.0 * outcome.accuracy:.1f} % of {outcome.total} clouds "
        f"(95 % interval {low:.1f} to {high:.1f} %), "
        f"class mean {100.0 * outcome.class_mean_accuracy:.1f} %"
    )
