"""Features of two domains in the plane, by t-SNE."""

from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int
from matplotlib.figure import Figure
from matplotlib.lines import Line2D

from qs3.errors import InputError
from qs3.report.figure import class_colour, house_style, short, without_frame

_LEAST = 5
_MARKERS = ("o", "^", "s", "D")


def embed(features: Float[np.ndarray, "b c"], seed: int = 0) -> Float[np.ndarray, "b 2"]:
    """Lay features out in the plane by t-SNE (van der Maaten & Hinton, JMLR 2008).

    It starts from the principal components and runs on one thread: the same features give the same
    bits on the same machine. Neighbours stay neighbours; distances between clusters mean little.

    Returns:
        Positions, scaled so that the farthest is 1 from their mean.

    Raises:
        InputError: where there are fewer than five clouds, or the features are not finite or all
            the same.

    Example:
        >>> embed(np.random.default_rng(0).normal(size=(12, 4))).shape
        (12, 2)
    """
    if len(features) < _LEAST:
        raise InputError(f"t-SNE needs {_LEAST} clouds or more, not {len(features)}")
    features = np.asarray(features, np.float64)
    spread = features.std(axis=0)
    if not np.isfinite(spread).all() or not (spread > 0).any():
        raise InputError("t-SNE: the features are not finite, or the same for all clouds")
    from sklearn.manifold import TSNE
    from threadpoolctl import threadpool_limits

    with threadpool_limits(limits=1):
        positions = TSNE(
            init="pca",
            perplexity=min(30.0, (len(features) - 1) / 3.0),
            random_state=seed,
            n_jobs=1,
        ).fit_transform(features)
    positions = positions.astype(np.float64)
    positions -= positions.mean(axis=0)
    return positions / max(float(np.linalg.norm(positions, axis=1).max()), 1e-12)


@house_style
def feature_map(
    positions: Float[np.ndarray, "b 2"],
    labels: Int[np.ndarray, "b"],
    domains: Sequence[str],
    class_names: Sequence[str],
    title: str = "",
) -> Figure:
    """Draw clouds in the plane: classes by colour, domains by marker.

    Of two domains or more the first that occurs is drawn hollow and below.
    """
    figure = Figure(figsize=(5.2, 6.2), layout="constrained")
    axes = figure.add_subplot()
    kinds = list(dict.fromkeys(domains))
    legend = []
    for index, kind in enumerate(kinds):
        rows = np.flatnonzero(np.array([domain == kind for domain in domains]))
        colours = [class_colour(int(label)) for label in labels[rows]]
        hollow = index == 0 and len(kinds) > 1
        marker = _MARKERS[index % len(_MARKERS)]
        axes.scatter(
            positions[rows, 0],
            positions[rows, 1],
            s=34,
            marker=marker,
            facecolors="none" if hollow else colours,
            edgecolors=colours if hollow else "white",
            linewidths=1.2 if hollow else 0.4,
            zorder=1 + index,
        )
        face = "none" if hollow else "#555555"
        style = {"markersize": 6.5, "markerfacecolor": face, "markeredgecolor": "#555555"}
        legend.append(Line2D([], [], linestyle="", marker=marker, label=short(kind, 20), **style))
    for index in map(int, np.unique(labels)):
        colour, name = class_colour(index), short(class_names[index])
        legend.append(
            Line2D([], [], linestyle="", marker="s", markersize=7, color=colour, label=name)
        )
    axes.set_title(short(title, 40))
    axes.set_aspect("equal", adjustable="datalim")
    without_frame(axes)
    axes.spines[:].set(visible=True, color="#dddddd")
    figure.legend(handles=legend, loc="outside lower center", ncols=3, fontsize=9)
    return figure
