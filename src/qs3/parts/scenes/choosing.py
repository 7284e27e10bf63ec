"""Which of many hypotheses hold together: they explain the most points, no two in one place."""

from collections.abc import Collection, Sequence

import numpy as np

from qs3.parts.scenes.verifying import Hypothesis

_TWICE = 1.0
"""What a pixel costs that two parts claim."""
_CELLS = 2_000_000
"""Most hypotheses times pixels; of a larger picture every so many-th pixel is counted."""
_COST = 0.1
"""Share of its own area that a part must explain beyond what the others do. With 0.05 two points
more of the parts of heaps are found, and of the answers among foreign things in heaps 80 % are
right, not 84."""


def choose(hypotheses: Sequence[Hypothesis]) -> list[Hypothesis]:
    """Return the subset of largest value, by greedy steps and exchanges."""
    if not hypotheses:
        return []
    every = np.unique(np.concatenate([h.pixels for h in hypotheses]))
    step = 1 + len(hypotheses) * len(every) // _CELLS
    gains = np.zeros((len(hypotheses), -(-len(every) // step)), np.float32)
    for row, h in zip(gains, hypotheses, strict=True):
        at = np.searchsorted(every, h.pixels)
        row[at[at % step == 0] // step] = step * h.gains[at % step == 0]
    base = np.array([h.value - h.gains.sum() - _COST * h.area for h in hypotheses])
    chosen = _grown([], gains, base)
    value = _value(chosen, gains, base)
    for _ in range(4):
        better = False
        for out in list(chosen):
            other = _grown([k for k in chosen if k != out], gains, base, [out])
            if (changed := _value(other, gains, base)) > value + 1e-6:
                chosen, value, better = other, changed, True
                break
        if not better:
            break
    return [hypotheses[k] for k in chosen]


def _grown(
    chosen: list[int], gains: np.ndarray, base: np.ndarray, barred: Collection[int] = ()
) -> list[int]:
    """Add hypotheses, the most valuable first, as long as one adds something."""
    chosen = list(chosen)
    best = gains[chosen].max(axis=0) if chosen else np.zeros(gains.shape[1], np.float32)
    claimed = best > 0
    while True:
        more = np.where(claimed, -_TWICE * np.minimum(gains, best), gains).sum(axis=1) + base
        more[[*chosen, *barred]] = -np.inf
        k = int(more.argmax())
        if not more[k] > 0:
            return chosen
        chosen.append(k)
        best = np.maximum(best, gains[k])
        claimed = best > 0


def _value(chosen: list[int], gains: np.ndarray, base: np.ndarray) -> float:
    if not chosen:
        return 0.0
    few = gains[chosen]
    top = few.max(axis=0)
    return float(top.sum() - _TWICE * (few.sum(axis=0) - top).sum() + base[chosen].sum())
