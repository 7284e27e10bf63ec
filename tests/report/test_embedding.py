import numpy as np
import pytest

from qs3.errors import InputError
from qs3.report.embedding import embed, feature_map


@pytest.fixture(scope="module")
def clusters():
    """Three clusters in twenty dimensions, and which cloud is of which."""
    rng = np.random.default_rng(20220712)
    labels = np.repeat(np.arange(3), 20)
    return 8 * np.eye(20)[labels] + rng.normal(size=(60, 20)), labels


def test_neighbours_stay_neighbours(clusters):
    features, labels = clusters
    placed = embed(features)
    assert placed.shape == (60, 2)
    assert np.linalg.norm(placed, axis=1).max() == pytest.approx(1.0)
    apart = np.linalg.norm(placed[:, None] - placed, axis=2)
    np.fill_diagonal(apart, np.inf)
    assert (labels[apart.argmin(axis=1)] == labels).all()


def test_same_features_give_the_same_bits(clusters):
    features, _ = clusters
    assert embed(features).tobytes() == embed(features.copy()).tobytes()


@pytest.mark.parametrize(
    "features", [np.eye(4), np.ones((8, 3)), np.full((8, 3), np.nan), np.zeros((0, 3))]
)
def test_what_has_no_map_is_refused(features):
    with pytest.raises(InputError, match="t-SNE"):
        embed(features)


def test_five_clouds_are_enough(rng):
    assert np.isfinite(embed(rng.normal(size=(5, 3)))).all()


def test_map_tells_classes_by_colour_and_domains_by_marker(rng):
    labels = np.array([0, 0, 2, 2])
    domains = ("source", "target", "source", "target")
    figure = feature_map(rng.normal(size=(4, 2)), labels, domains, ("a", "b", "c"), "name")
    source, target = figure.axes[0].collections
    assert not np.array_equal(source.get_edgecolors()[0], source.get_edgecolors()[1])
    np.testing.assert_array_equal(source.get_edgecolors()[:, :3], target.get_facecolors()[:, :3])
    first, second = (c.get_paths()[0].vertices.shape for c in (source, target))
    assert first != second
    texts = [text.get_text() for text in figure.legends[0].get_texts()]
    assert texts == ["source", "target", "a", "c"]  # no class that has no cloud
