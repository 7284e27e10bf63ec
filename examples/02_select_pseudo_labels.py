"""Quasi-balanced selection (Algorithm 1) on made-up confidences: the common class is cut most."""

import numpy as np

from qs3.adaptation.selection import select_confident, select_quasi_balanced

rng = np.random.default_rng(0)
labels = rng.choice(3, size=300, p=[0.7, 0.2, 0.1])
confidence = rng.uniform(0.5, 1.0, size=300)
probabilities = np.repeat((1 - confidence)[:, None] / 2, 3, axis=1)
probabilities[np.arange(300), labels] = confidence

over = select_confident(probabilities, 0.8)
kept = select_quasi_balanced(probabilities, 0.8)
for k in range(3):
    n_k, n = int((over & (labels == k)).sum()), int(over.sum())
    left = int((kept & (labels == k)).sum())
    print(f"class {k}: {n_k} of {n} confident, {left} kept = ⌈{n_k}·(1 − {n_k}/{n})⌉")
