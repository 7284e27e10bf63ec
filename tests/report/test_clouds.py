import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.spatial.transform import Rotation

from qs3.report.clouds import SIDES, caption, draw_cloud, gallery, project


def test_convention_sides():
    """From the front +x is right and −y is near; from the side +y is right; from above +z near."""
    expected = {  # of x, y and z: right, up, towards the viewer
        "front": [[1, 0, 0], [0, 0, -1], [0, 1, 0]],
        "side": [[0, 0, 1], [1, 0, 0], [0, 1, 0]],
        "top": [[1, 0, 0], [0, 1, 0], [0, 0, 1]],
    }
    for side, axes in expected.items():
        np.testing.assert_allclose(project(np.eye(3), *SIDES[side]), axes, atol=1e-12)


@pytest.mark.parametrize(("azimuth", "elevation"), [(30.0, 20.0), (-110.0, -35.0), (200.0, 90.0)])
def test_project_is_the_rotation_that_scipy_gives(rng, azimuth, elevation):
    points = rng.normal(size=(50, 3))
    turned = Rotation.from_euler("zx", [-azimuth, elevation], degrees=True).apply(points)
    right, up, towards = turned[:, 0], turned[:, 2], -turned[:, 1]
    expected = np.stack([right, up, towards], axis=1)
    np.testing.assert_allclose(project(points, azimuth, elevation), expected, atol=1e-12)


def test_near_points_are_drawn_last_and_strongest():
    points = np.array([[0.0, -1, 0], [1.0, 1, 0], [2.0, 0, 0], [np.nan, 0, 0]])
    axes = Figure().add_subplot()  # near, far, middle, and one that is left out
    draw_cloud(axes, points, *SIDES["front"])
    scatter = axes.collections[0]
    assert np.asarray(scatter.get_offsets())[:, 0].tolist() == [1.0, 2.0, 0.0]
    lightness = np.asarray(scatter.get_facecolors())[:, :3].sum(axis=1)
    assert lightness[0] > lightness[1] > lightness[2]


def test_gallery_keeps_every_cloud_in_its_cell(rng):
    samples = {
        "far away": [1000.0 + 50 * rng.normal(size=(40, 3)), 1e-6 * rng.normal(size=(30, 3))],
        "flat": [rng.normal(size=(20, 3)) * [1, 1, 0], np.zeros((5, 3)), np.zeros((0, 3))],
        "absent": [],
    }
    figure = gallery(samples, "title", columns=3)
    axes = figure.axes[0]
    spots = np.asarray(axes.collections[0].get_offsets())
    cells, counts = np.unique(np.round(spots), axis=0, return_counts=True)
    assert dict(zip(map(tuple, cells.astype(int)), counts, strict=True)) == {
        (0, 0): 40,
        (1, 0): 30,
        (0, -1): 20,
        (1, -1): 5,
    }
    assert np.abs(spots - np.round(spots)).max() < 0.49
    shadow = np.asarray(axes.collections[1].get_offsets())
    assert np.abs(shadow - np.round(shadow)).max() < 0.49
    bars = {text.get_text(): line for text, line in zip(
        (t for t in axes.texts if t.get_text() != "none"), axes.lines, strict=True)}  # fmt: skip
    assert len(bars) == 3  # a cloud that is a point has none
    extent = np.ptp(project(samples["flat"][0], 30.0, 20.0)[:, 0])  # the shadow's is no wider
    cell = spots[np.round(spots[:, 0]) == 0][
        np.round(spots[np.round(spots[:, 0]) == 0][:, 1]) == -1
    ]
    length = np.ptp(axes.lines[2].get_xdata()) * extent / np.ptp(cell[:, 0])
    assert f"{length:g}" == list(bars)[2]
    assert [t.get_text() for t in axes.get_yticklabels()] == list(samples)
    assert "none" in [t.get_text() for t in axes.texts]


def test_captions_are_cut_in_their_middle_and_printable():
    names = ["chair", "kenney__loungeDesignSofaCorner", "LOUNGE_WWMM_0001_LEFT", "\u6905\n"]
    cut = ["chair", "kenne…nSofaCorner", "LOUNG…M_0001_LEFT", "□\\n"]
    assert [caption(name) for name in names] == cut
