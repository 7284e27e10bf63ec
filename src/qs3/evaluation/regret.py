"""Which rule of selection can be trusted: what its choice loses against the best checkpoint."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from qs3.evaluation.metrics import MeanSEM, mean_sem
from qs3.evaluation.records import RunRecord


def choose_each(checkpoints: Sequence[Mapping[str, Any]]) -> dict[str, int]:
    """Return which of ``RunRecord.checkpoints`` each rule picks: the highest, the first of equals.

    Returns:
        Row by rule: ``last``, each validator that says something, and ``oracle``, which looks at
        the accuracies.

    Example:
        >>> said = [{"accuracy": a, "validators": {"im": v}} for a, v in ((0.6, 0.1), (0.5, 0.9))]
        >>> choose_each(said)
        {'last': 1, 'im': 1, 'oracle': 0}
    """
    return {rule: int(np.nanargmax(values)) for rule, values in _values(checkpoints).items()}


def validator_regret(records: Sequence[RunRecord]) -> pd.DataFrame:
    """Compare rules of selection over runs whose checkpoints were all scored.

    Records without scored checkpoints (``evaluate`` with ``checkpoints``) and those with a single
    one are left out.

    Returns:
        One line a test set and rule: number of ``runs``; ``regret`` in accuracy and
        ``class_mean_regret``, what the chosen checkpoint has less than the most accurate one;
        ``correlation``, Spearman's, of the rule's values with the accuracies, over the runs where
        neither is constant (None without such a run). Means with their standard errors, as
        `MeanSEM`.
    """
    lines = []
    for record in records:
        if len(record.checkpoints) < 2:
            continue
        accuracies, means = (
            np.array([made[name] for made in record.checkpoints], dtype=np.float64)
            for name in ("accuracy", "class_mean_accuracy")
        )
        best = int(accuracies.argmax())
        for rule, values in _values(record.checkpoints).items():
            picked, given = int(np.nanargmax(values)), ~np.isnan(values)
            varied = all(len(np.unique(v[given])) > 1 for v in (values, accuracies))
            lines.append(
                {
                    "test": record.test.label,
                    "rule": rule,
                    "regret": accuracies[best] - accuracies[picked],
                    "class_mean_regret": means[best] - means[picked],
                    "correlation": _spearman(values[given], accuracies[given]) if varied else None,
                }
            )
    if not lines:
        return pd.DataFrame(columns=["test", "rule", "runs", *_COLUMNS])
    table = pd.DataFrame(lines)
    grouped = table.groupby(["test", "rule"], sort=False)
    return grouped.agg(
        runs=("rule", "size"), **{name: (name, _mean) for name in _COLUMNS}
    ).reset_index()


_COLUMNS = ("regret", "class_mean_regret", "correlation")


def _mean(values: pd.Series) -> MeanSEM | None:
    present = values.dropna().tolist()
    return mean_sem(present) if present else None


def _spearman(first: np.ndarray, second: np.ndarray) -> float:
    """Return the correlation of the ranks; equals share the mean of theirs."""
    ranks = [pd.Series(values).rank() for values in (first, second)]
    return float(ranks[0].corr(ranks[1]))


def _values(checkpoints: Sequence[Mapping[str, Any]]) -> dict[str, np.ndarray]:
    """What each rule says of each checkpoint; NaN where it said nothing."""
    names = list(dict.fromkeys(name for made in checkpoints for name in made["validators"]))
    columns: dict[str, Sequence[float | None]] = {"last": range(len(checkpoints))}
    columns |= {name: [made["validators"].get(name) for made in checkpoints] for name in names}
    columns["oracle"] = [made["accuracy"] for made in checkpoints]
    arrays = {rule: np.array(values, dtype=np.float64) for rule, values in columns.items()}
    return {rule: values for rule, values in arrays.items() if not np.isnan(values).all()}
