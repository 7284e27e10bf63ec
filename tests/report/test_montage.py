import dataclasses

import matplotlib
import numpy as np
import pytest
from matplotlib.colors import to_rgb
from matplotlib.figure import Figure
from matplotlib.image import imread

from qs3.report.figure import NO_VALUE, png_bytes, write_png
from qs3.report.montage import montage
from qs3.sensor.rig import Region
from qs3.sensor.view import ViewImages

HEIGHT, WIDTH = 40, 60


@pytest.fixture
def view(rng) -> ViewImages:
    """A slanted plate, 20 × 30 pixels: two of its columns are lost, one beside it is won."""
    mask = np.zeros((HEIGHT, WIDTH), bool)
    mask[10:30, 20:50] = True
    true = np.full((HEIGHT, WIDTH), 9.0)
    true[10:30, 20:50] = np.linspace(1.0, 2.0, 30)
    depth = np.where(mask, true + 0.01, np.nan).astype(np.float32)
    depth[10:30, 20:22] = np.nan
    depth[10:30, 50] = 9.0
    image = rng.integers(0, 256, (HEIGHT, WIDTH), dtype=np.uint8)
    region = Region(0, 0, WIDTH, HEIGHT)
    return ViewImages(region, image, image, 10.0 / depth, depth, true, mask)


def draw(view, unit="mesh units", title="", points=100):
    cloud = np.random.default_rng(0).normal(size=(points, 3)).astype(np.float32)
    clouds = {"noisy cloud": cloud, "clean twin": cloud[:50]}
    return montage(view, clouds, np.eye(8), unit, title)


def axes_of(figure: Figure) -> dict:
    return {a.get_title(): a for f in figure.subfigs for a in f.axes if a.get_title()}


def test_convention_pixels_lie_where_they_are_y_down(view, monkeypatch):
    """Pixel (row, column) is drawn at y = row, x = column, with y growing downwards."""
    monkeypatch.setattr("qs3.report.montage._MARGIN", 5)
    axes = axes_of(draw(view))["left image"]
    shown = axes.images[0]
    assert list(shown.get_extent()) == [14.5, 54.5, 34.5, 4.5]
    assert axes.get_ylim()[0] > axes.get_ylim()[1]
    np.testing.assert_array_equal(shown.get_array(), view.left[5:35, 15:55])
    assert (shown.origin, shown.get_clim()) == ("upper", (0, 255))


def test_depth_and_truth_share_their_colours(view):
    panels = axes_of(draw(view))
    depth, true = (panels[f"{n} [mesh units]"].images[0] for n in ("depth", "true depth"))
    assert depth.get_clim() == true.get_clim() == pytest.approx((1.0, 2.0))
    assert depth.cmap == true.cmap


def test_no_value_is_grey_and_no_map_holds_that_grey(view):
    shown = axes_of(draw(view))["depth [mesh units]"].images[0]
    colours = shown.to_rgba(shown.get_array())
    np.testing.assert_allclose(colours[0, 0, :3], to_rgb(NO_VALUE), atol=1e-6)
    for name in ("viridis", "viridis_r", "RdBu_r"):
        distance = np.abs(matplotlib.colormaps[name](np.arange(256))[:, :3] - to_rgb(NO_VALUE))
        assert distance.max(axis=1).min() > 0.02


def test_error_is_signed_centred_and_tells_lost_from_won(view):
    reasons, error = axes_of(draw(view))["depth error [mesh units]"].images
    low, high = error.get_clim()
    assert low == -high < 0
    values = np.ma.filled(error.get_array(), np.nan)
    np.testing.assert_allclose(values[10:30, 22:50], 0.01, atol=1e-6)
    assert np.isnan(values).sum() == HEIGHT * WIDTH - 20 * 28
    red, _, blue, _ = error.to_rgba(error.get_array())[15, 30]
    assert red > blue  # too far is red
    reason = np.asarray(reasons.get_array())
    assert (reason[10:30, 20:22] == 1).all()
    assert (reason[10:30, 50] == 2).all()
    assert (reason != 0).sum() == 20 * 3
    # Where there is no error, the reasons below must shine through.
    assert error.to_rgba(error.get_array())[15, 50, 3] == 0


def test_a_scan_that_saw_nothing_is_drawn_too(view):
    nothing = np.full((HEIGHT, WIDTH), np.nan, np.float32)
    blind = dataclasses.replace(view, disparity=nothing, depth=nothing, true_depth=nothing)
    assert len(png_bytes(draw(blind, points=0), dpi=20)) > 1000


def test_bytes_depend_on_the_view_alone(view, tmp_path):
    first = png_bytes(draw(view, title="a"), dpi=20)
    with matplotlib.rc_context({"font.size": 30, "axes.facecolor": "red", "savefig.dpi": 10}):
        assert png_bytes(draw(view, title="a"), dpi=20) == first
    assert not any(word in first for word in (b"Software", b"matplotlib", b"tIME", b"Creation"))
    assert png_bytes(draw(view, title="a part 🔩"), dpi=20)  # no font has it: no warning either
    write_png(tmp_path / "new" / "a.png", Figure(figsize=(2, 1)), dpi=50)
    assert imread(tmp_path / "new" / "a.png").shape[:2] == (50, 100)
