from dataclasses import replace

import numpy as np
import pytest
import torch

from qs3.clouds.types import Origin, PointClouds
from qs3.errors import InputError
from qs3.runs import SelfTrainingSettings, is_run, save_model
from qs3.runs.digests import fingerprint
from qs3.runs.run import MODEL, read_run
from qs3.runs.weights import new_model, write_tensors
from qs3.training import fit, load_model, predict_probabilities

from .common import same

ROUNDS = SelfTrainingSettings(rounds=1, epochs=1, threshold=0.4)


def test_a_class_without_a_cloud_is_reported(source, settings, tmp_path, caplog):
    few = source.select(np.flatnonzero(source.labels != 1))
    short = replace(settings, epochs=1, holdout=0.0)
    fit("source-only", few, None, short, run_dir=tmp_path / "few")
    assert "no cloud of disc to learn from" in caplog.text
    caplog.clear()
    fit("source-only", source, None, short, run_dir=tmp_path / "all")
    assert "to learn from" not in caplog.text


def test_source_only(source, settings, tmp_path):
    result = fit("source-only", source, None, settings, run_dir=tmp_path / "run")
    assert len(result.history) == settings.epochs
    assert result.rounds == ()
    assert is_run(tmp_path / "run")
    loaded = load_model(tmp_path / "run")
    assert same(loaded.model, result.model)
    assert not loaded.model.training
    assert loaded.class_names == ("ball", "disc", "rod")
    assert loaded.settings["method"] == "source-only"
    assert loaded.settings["train"]["num_points"] == 64
    alone = load_model(tmp_path / "run" / MODEL)
    assert same(alone.model, result.model)
    assert alone.settings["train"]["num_points"] == 64


def test_other_settings_in_the_folder_are_refused(source, settings, tmp_path):
    fit("source-only", source, None, settings, run_dir=tmp_path)
    changes = {
        r"train\.seed = 0, not 1": {"seed": 1},
        r"train\.learning_rate = 0\.01, not 0\.5": {"learning_rate": 0.5},
        r"train\.model_settings": {"model_settings": {}},
    }
    for named, change in changes.items():
        with pytest.raises(InputError, match=named):
            fit("source-only", source, None, replace(settings, **change), run_dir=tmp_path)


def test_other_data_or_method_in_the_folder_are_refused(source, target, settings, tmp_path):
    fit("source-only", source, None, settings, run_dir=tmp_path)
    with pytest.raises(InputError, match="another --source"):
        fit("source-only", target, None, settings, run_dir=tmp_path)
    with pytest.raises(InputError, match="method = 'source-only', not 'qbst'"):
        fit("qbst", source, target.without_labels(), settings, ROUNDS, run_dir=tmp_path)


def test_arguments_that_do_not_go_together(source, target, settings, tmp_path):
    unlabelled = target.without_labels()
    run = tmp_path / "run"
    with pytest.raises(InputError, match="needs a target"):
        fit("qbst", source, None, settings, run_dir=run)
    with pytest.raises(InputError, match="needs a target"):
        fit("source-only", source, None, settings, ROUNDS, run_dir=run)
    with pytest.raises(InputError, match="selects by spst, its self-training settings say qbst"):
        fit("spst", source, unlabelled, settings, ROUNDS, run_dir=run)
    with pytest.raises(InputError, match="unknown method 'gasp'"):
        fit("gasp", source, unlabelled, settings, run_dir=run)
    strange = replace(settings, method_settings={"weight": 1})
    with pytest.raises(InputError, match="unknown setting 'weight' of method source-only"):
        fit("source-only", source, unlabelled, strange, run_dir=run)
    with pytest.raises(InputError, match="takes no warm-up"):
        fit("source-only", source, None, settings, run_dir=run, warm_up=tmp_path)
    assert not run.exists()


def test_warm_up_must_fit(source, target, settings, tmp_path):
    unlabelled = target.without_labels()
    fit("source-only", source, None, settings, run_dir=tmp_path / "warm")
    other = replace(source, class_names=("a", "b", "c"))
    for case, (clouds, changed, message) in enumerate(
        [
            (other, settings, "classes"),
            (source, replace(settings, num_points=32), "num_points = 64, not 32"),
            (source, replace(settings, model="dgcnn", model_settings={}), "model = 'pointnet'"),
        ]
    ):
        with pytest.raises(InputError, match=message):
            arguments = ("qbst", clouds, unlabelled, changed, ROUNDS)
            fit(*arguments, run_dir=tmp_path / str(case), warm_up=tmp_path / "warm")
    with pytest.raises(InputError, match=r"no model\.safetensors"):
        load_model(tmp_path / "0")


def test_given_warm_up_is_the_trained_one(source, target, settings, tmp_path):
    """A warm-up trained first or handed over leads to the same bits."""
    unlabelled = target.without_labels()
    settings = replace(settings, epochs=20)
    fit("source-only", source, None, settings, run_dir=tmp_path / "warm")
    arguments = ("qbst", source, unlabelled, settings, ROUNDS)
    handed = fit(*arguments, run_dir=tmp_path / "a", warm_up=tmp_path / "warm")
    trained = fit(*arguments, run_dir=tmp_path / "b")
    assert same(handed.model, trained.model)
    assert same(load_model(tmp_path / "b" / "warm-up").model, load_model(tmp_path / "warm").model)
    steps = [read_run(tmp_path / name).steps for name in ("warm", "a", "b")]
    assert steps[1]["warm-up"] == steps[0]["total"] == steps[2]["source"] > steps[1]["source"] == 0


def test_threads_are_put_back(source, settings, tmp_path):
    before = torch.get_num_threads()
    fit("source-only", source, None, replace(settings, threads=2), run_dir=tmp_path)
    assert torch.get_num_threads() == before


def test_weights_of_another_kind_are_refused(settings, tmp_path):
    path = tmp_path / MODEL
    write_tensors(path, {"a": torch.zeros(1)}, {"format": 1})
    with pytest.raises(InputError, match="does not say which network"):
        load_model(path)
    write_tensors(path, {}, {"format": 99})
    with pytest.raises(InputError, match="format 99"):
        load_model(path)
    save_model(tmp_path, new_model(settings, 3, 0), ("a", "b"), settings)
    with pytest.raises(InputError, match="another network"):
        load_model(path)


def test_fingerprint_sees_points_labels_and_names(source):
    seen = {fingerprint(source), fingerprint(source.without_labels())}
    seen.add(fingerprint(replace(source, labels=source.labels[::-1].copy())))
    seen.add(fingerprint(replace(source, class_names=("x", "y", "z"))))
    seen.add(fingerprint(replace(source, points=source.points + 1)))
    assert len(seen) == 5
    assert fingerprint(source) == fingerprint(replace(source, ids=source.ids[::-1]))


def test_predictions_are_probabilities_and_deterministic(source, settings):
    model = new_model(settings, 3, 0).train()
    first = predict_probabilities(model, source.points)
    assert model.training  # the mode is put back
    assert first.dtype == np.float64
    np.testing.assert_allclose(first.sum(axis=1), 1.0, atol=1e-12)
    assert np.array_equal(first, predict_probabilities(model, source.points))
    np.testing.assert_allclose(
        first, predict_probabilities(model, source.points, batch_size=5), atol=1e-6
    )
    broken = source.points.copy()
    broken[3, 0, 0] = np.inf
    with pytest.raises(InputError, match="cloud 3 are not finite"):
        predict_probabilities(model, broken)
    moved = predict_probabilities(model, source.points * 5 + 2)  # the unit ball undoes it
    np.testing.assert_allclose(first, moved, atol=1e-4)
    assert predict_probabilities(model, source.points[:0]).shape == (0, 3)


def test_all_three_clouds_of_a_scan_are_trained_on_or_held_out_together(source, settings, tmp_path):
    kinds = ("points", "clean", "surface")
    three = PointClouds(
        points=np.concatenate([source.points + np.float32(0.01 * i) for i in range(3)]),
        labels=np.tile(source.labels, 3),
        class_names=source.class_names,
        ids=tuple(f"{name}/{kind}" for kind in kinds for name in source.ids),
        origin=Origin("set", None, "all"),
    )
    chosen = replace(settings, epochs=1, holdout=0.25)
    alone = fit("source-only", source, None, chosen, run_dir=tmp_path / "alone").holdout
    held = fit("source-only", three, None, chosen, run_dir=tmp_path / "three").holdout
    assert held.ids == tuple(f"{name}/{kind}" for kind in kinds for name in alone.ids)
    record = read_run(tmp_path / "three").source
    assert record.label == "set (all)"
