"""Clouds on their way into a network: laws of `Preparation` from training to prediction."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from qs3.answers import evaluate
from qs3.clouds.preparation import PAPER, ROBUST, Preparation, distinct_inliers, normalise, resample
from qs3.clouds.types import PointClouds
from qs3.errors import InputError
from qs3.training import fit, load_model, predict_probabilities
from qs3.training.prepared import (
    Prepared,
    _rank,
    label_clouds,
    normalise_batch,
    prepare_clouds,
    prepare_each,
)

OWN = replace(ROBUST, size_input=True)


@pytest.fixture
def strayed(target):
    """Clouds of which two points lie far out, and ten repeat others."""
    points = target.points.copy()
    points[:, 7] += 40
    points[:, 9, 2] -= 60
    points[:, 20:30] = points[:, 30:40]
    return replace(target, points=points)


def test_outliers_go_alike_from_source_and_target(strayed):
    """Each cloud by itself: what else is in the set, and whether it has labels, does not matter."""
    as_source = prepare_clouds(strayed, 40, ROBUST)
    as_target = prepare_clouds(strayed.without_labels(), 40, ROBUST)
    assert np.array_equal(as_source.points, as_target.points)
    alone = prepare_clouds(strayed.select(np.array([5])), 40, ROBUST)
    assert np.array_equal(alone.points[0], as_source.points[5])
    for row, cloud in enumerate(strayed.points):
        kept = distinct_inliers(cloud, True)
        assert not {7, 9} & set(kept)
        chosen = as_source.chosen(slice(row, row + 1))[0]
        assert np.array_equal(chosen, resample(cloud[kept], 40))
        assert as_source.counts[row] == len(kept)
        # What is drawn from holds every point that counts, and no other.
        drawn = as_source.indices(np.array([row]))[0]
        assert set(drawn) == set(kept)
        assert len(set(drawn[: len(kept)])) == len(kept)
    for share in (as_source, as_target):
        assert np.abs(share.points).max() < 4


@pytest.mark.parametrize("redraw", [False, True])
@pytest.mark.parametrize("count", [20, 64, 90])
def test_the_fixed_choice_does_not_depend_on_redrawing(strayed, redraw, count):
    preparation = Preparation(remove_outliers=True, redraw=redraw)
    prepared = prepare_clouds(strayed, count, preparation)
    wanted = [resample(cloud[distinct_inliers(cloud, True)], count) for cloud in strayed.points]
    assert np.array_equal(prepared.chosen(slice(None)), np.stack(wanted))
    assert np.array_equal(prepared.points, normalise(np.stack(wanted), preparation))


@pytest.mark.parametrize("preparation", [PAPER, ROBUST])
def test_the_points_of_a_cloud_are_chosen_once(strayed, preparation, monkeypatch):
    drawn, ranks = [], {}

    def counted(cloud, *how):
        drawn.append(len(cloud))
        return _rank(cloud, *how)

    monkeypatch.setattr("qs3.training.prepared._rank", counted)
    monkeypatch.setattr("qs3.training.prepared._ranks", ranks)
    first = prepare_clouds(strayed, 40, preparation)
    assert len(drawn) == len(strayed)
    again = prepare_clouds(strayed, 40, preparation)
    each = prepare_each([*strayed.points], 40, preparation)
    assert len(drawn) == len(strayed)
    assert np.array_equal(first.index, again.index) and np.array_equal(first.points, each)
    # What is kept is not for another number of points or another preparation, and has a limit.
    prepare_clouds(strayed, 39, preparation)
    prepare_clouds(strayed, 40, replace(preparation, remove_outliers=True, radius_share=0.9))
    assert len(drawn) == 3 * len(strayed)
    monkeypatch.setattr("qs3.training.prepared._MOST_RANKS", 3)
    prepare_clouds(strayed, 41, preparation)
    assert len(ranks) <= 3


def test_nothing_is_copied(source):
    prepared = prepare_clouds(source, 40, ROBUST)
    part = prepared.select(np.arange(24) % 3 == 0)
    assert part.clouds.points is source.points
    assert np.array_equal(part.labels, source.labels[::3])
    assert part.ids == source.ids[::3]
    assert np.array_equal(part.points, prepared.points[::3])
    assert np.array_equal(np.concatenate(list(part.blocks())), part.chosen(slice(None)))


def test_pseudo_labels_go_to_their_clouds(target):
    prepared = prepare_clouds(target.without_labels(), 40).select(np.arange(5, 25))
    rows, labels = np.array([3, 17, 4]), np.array([2, 0, 1])
    labelled = label_clouds(prepared, rows, labels, target.class_names)
    assert isinstance(labelled.clouds, PointClouds)
    assert labelled.labels.tolist() == [2, 0, 1]
    assert labelled.clouds.points is target.points
    assert np.array_equal(labelled.points, prepared[rows])


@pytest.mark.parametrize("preparation", [PAPER, replace(ROBUST, redraw=False), OWN])
def test_normalising_by_torch_is_that_of_numpy(strayed, preparation):
    points = torch.from_numpy(strayed.points)
    assert np.array_equal(
        normalise_batch(points, preparation).numpy(), normalise(strayed.points, preparation)
    )


def test_empty_and_broken_clouds_are_refused(source):
    points = source.points.copy()
    points[3, 5, 1] = np.inf
    with pytest.raises(InputError, match="cloud 0-3 are not finite"):
        prepare_clouds(replace(source, points=points), 40, ROBUST)
    few = source.points.copy()
    few[3, 11:] = few[3, 0]  # eleven places
    for some, names in ((points[:, :0], "clouds 0-0, "), (few, "cloud 0-3: ")):
        with pytest.raises(InputError, match=f"{names}.*fewer than 12 distinct points"):
            prepare_clouds(replace(source, points=some), 40, ROBUST)


@pytest.fixture(scope="module")
def run(source, target, settings, tmp_path_factory):
    """A run with all of it: outliers, robust ball, redrawn points, size."""
    folder = tmp_path_factory.mktemp("own") / "run"
    chosen = replace(settings, preparation=OWN, num_points=40)
    fit("source-only", source, target.without_labels(), chosen, run_dir=folder)
    return folder


def test_a_run_knows_its_preparation(run, strayed, tmp_path):
    """Scores, predictions and the lone file of weights need not be told."""
    loaded = load_model(run)
    assert loaded.preparation == OWN
    prepared = prepare_clouds(strayed, 40, OWN)
    wanted = predict_probabilities(loaded, strayed.points)
    direct = predict_probabilities(
        loaded.model, strayed.points, num_points=40, preparation=OWN, batch_size=7
    )
    np.testing.assert_allclose(wanted, direct, atol=1e-6)
    record = evaluate(run, strayed)
    right = (wanted.argmax(axis=1) == strayed.labels).mean()
    assert record.scores.accuracy == pytest.approx(right)
    assert record.settings["train"]["preparation"]["size_input"] is True
    assert isinstance(prepared, Prepared)

    (tmp_path / "alone.safetensors").write_bytes((run / "model.safetensors").read_bytes())
    alone = load_model(tmp_path / "alone.safetensors")
    assert alone.preparation == OWN
    assert np.array_equal(predict_probabilities(alone, strayed.points), wanted)


def test_predictions_depend_on_the_size_only_with_size_input(run, target, settings):
    """Metres in and out: the same clouds as millimetres are other objects."""
    loaded = load_model(run)
    scaled = [predict_probabilities(loaded, factor * target.points) for factor in (1, 8)]
    assert np.abs(scaled[0] - scaled[1]).max() > 1e-4
    free = replace(OWN, size_input=False)
    inside = loaded.model.model
    scaled = [
        predict_probabilities(inside, factor * target.points, num_points=40, preparation=free)
        for factor in (1, 8)
    ]
    np.testing.assert_allclose(scaled[0], scaled[1], atol=1e-5)


def test_a_warm_up_of_another_preparation_is_refused(run, source, target, settings, tmp_path):
    with pytest.raises(InputError, match=r"preparation\.radius_share = 0\.95, not 1\.0"):
        fit("qbst", source, target.without_labels(), replace(settings, num_points=40),
            run_dir=tmp_path / "run", warm_up=run)  # fmt: skip
