import subprocess
import sys

import matplotlib
import numpy as np
import pytest

from qs3.errors import InputError
from qs3.report.figure import png_bytes
from qs3.report.plots import Curve, confusion_heatmap, selection_counts, training_curves

from .conftest import a_round

NAMES = ("bed", "chair", "table")


def test_curves_of_one_panel_share_axes():
    epochs = np.arange(1, 5)
    curves = [
        Curve("train", epochs, np.array([3.0, 2.0, np.nan, 1.0])),
        Curve("held out", epochs, np.ones(4), "accuracy"),
        Curve("pseudo", epochs[1:], np.zeros(3), "loss"),
    ]
    figure = training_curves(curves, marks=[2.0, 3.0])
    loss, accuracy = figure.axes
    assert (loss.get_ylabel(), accuracy.get_ylabel()) == ("loss", "accuracy")
    drawn = {line.get_label(): line for line in loss.lines}
    np.testing.assert_array_equal(drawn["train"].get_ydata(), curves[0].y)
    assert "pseudo" in drawn
    assert sum(str(name).startswith("_") for name in drawn) == 2  # the two marks
    styles = {line.get_linestyle() for name, line in drawn.items() if name in ("train", "pseudo")}
    assert len(styles) == 2  # told apart without colour
    assert "round begins" in accuracy.get_xlabel()


def test_bars_stack_to_what_was_selected():
    rounds = [a_round(1, [3, 0, 2], [5, 0, 2]), a_round(2, [0, 0, 0], [1, 0, 1], skipped=True)]
    figure = selection_counts(rounds, NAMES)
    theta, bars = figure.axes
    np.testing.assert_allclose(theta.lines[0].get_ydata(), [0.81, 0.82])
    by_class = [[bar.get_height() for bar in group] for group in bars.containers]
    assert by_class == [[3, 0], [0, 0], [2, 0], [7, 2]]  # the last is the outline above θ
    assert [bar.get_y() for bar in bars.containers[2]] == [3, 0]
    assert [t.get_text() for t in bars.get_xticklabels()] == ["1\n5/7", "2\n0/2"]


def test_confusion_shades_by_row_and_writes_counts():
    matrix = np.array([[8, 2, 0, 0], [0, 1, 0, 3], [0, 0, 0, 0]])
    axes = confusion_heatmap(matrix.tolist(), NAMES, "before").axes[0]
    shown = np.asarray(axes.images[0].get_array())
    np.testing.assert_allclose(shown, [[0.8, 0.2, 0, 0], [0, 0.25, 0, 0.75], [0, 0, 0, 0]])
    written = {tuple(map(int, t.get_position()))[::-1]: t.get_text() for t in axes.texts}
    assert written == {(0, 0): "8", (0, 1): "2", (1, 1): "1", (1, 3): "3"}
    assert [t.get_text() for t in axes.get_xticklabels()] == [*NAMES, "other"]
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("predicted", "true")


def test_no_global_state_of_pyplot():
    before = dict(matplotlib.rcParams)
    png_bytes(confusion_heatmap(((1, 0), (0, 1)), ("a", "b")), dpi=30)
    assert dict(matplotlib.rcParams) == before
    code = "import sys, qs3.report.page; "
    code += "sys.exit('matplotlib.pyplot' in sys.modules or 'torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0


@pytest.mark.parametrize("shape", [(2, 2), (2, 3), (3, 5), (4, 4)])
def test_a_confusion_matrix_of_other_classes_is_refused(shape):
    with pytest.raises(InputError, match="is not of 3 classes"):
        confusion_heatmap(np.ones(shape, int).tolist(), ("a", "b", "c"))


@pytest.mark.parametrize(("other", "drawn"), [(0, ["a", "b"]), (2, ["a", "b", "other"])])
def test_predictions_of_no_class_have_a_column_if_there_are_any(other, drawn):
    axes = confusion_heatmap(((1, 0, 0), (0, 1, other)), ("a", "b")).axes[0]
    assert [label.get_text() for label in axes.get_xticklabels()] == drawn
