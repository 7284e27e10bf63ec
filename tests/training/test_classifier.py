"""A trained network as an object: answers, kinds of clouds, saving."""

from dataclasses import replace

import numpy as np
import pytest
import torch

import qs3
from qs3.errors import InputError
from qs3.report.collect import collect
from qs3.training import Classifier, SelfTrainingSettings, evaluate, fit, read_run
from qs3.training.run import fingerprint, train_settings

pytestmark = pytest.mark.filterwarnings("ignore::qs3.adaptation.SingleClassWarning")


@pytest.fixture(scope="module")
def folder(source, settings, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run") / "run"
    fit("source-only", source, None, replace(settings, holdout=0.3), run_dir=folder)
    return folder


@pytest.fixture(scope="module")
def network(folder):
    return qs3.load(folder)


def test_predict_names_the_most_probable_class(network, folder, target):
    names, shares = network.predict(target), network.predict_proba(target.points)
    assert network.class_names == ("ball", "disc", "rod")
    assert names.tolist() == [network.class_names[row] for row in shares.argmax(axis=1)]
    assert np.allclose(shares.sum(axis=1), 1)
    right = (names == np.array(target.class_names)[target.labels]).mean()
    assert evaluate(folder, target).scores.accuracy == right


def test_unknown_and_calibrated_need_held_out_source(network, source, target, settings, tmp_path):
    plain, asked = network.predict(target), network.predict(target, unknown=0.5)
    assert "unknown" not in plain
    assert 0 < (asked == "unknown").sum() < 30
    assert (asked == plain)[asked != "unknown"].all()
    shares = network.predict_proba(target, calibrated=True)
    assert np.allclose(shares.sum(axis=1), 1)
    assert not np.allclose(shares, network.predict_proba(target))
    network.save(tmp_path / "saved")
    assert qs3.load(tmp_path / "saved").predict(target, unknown=0.5).tolist() == asked.tolist()
    fit("source-only", source, None, replace(settings, epochs=1), run_dir=tmp_path / "without")
    with pytest.raises(InputError, match="this network: cannot reject unknown objects"):
        Classifier.load(tmp_path / "without").predict(target, unknown=0.05)


def test_a_saved_network_is_a_run(network, folder, source, target, tmp_path):
    """`evaluate`, ``qs3 report`` and a warm-up take it, and so does `load`."""
    network.save(tmp_path / "saved")
    qs3.load(tmp_path / "saved").save(tmp_path / "again")
    for place in (tmp_path / "saved", tmp_path / "again"):
        run = read_run(place)
        assert (run.method, run.source) == ("source-only", read_run(folder).source)
        assert run.settings["source"] == fingerprint(source)
        assert evaluate(place, target).scores == evaluate(folder, target).scores
        assert collect(place).class_names == network.class_names
    settings = train_settings(tmp_path / "saved")
    rounds = SelfTrainingSettings(rounds=2, epochs=1, threshold_share=0.6)
    arguments = ("qbst", source, target.without_labels(), settings, rounds)
    after = fit(*arguments, run_dir=tmp_path / "run", warm_up=tmp_path / "saved")
    assert not read_run(tmp_path / "run").unknown_warm_up
    assert len(after.rounds) == 2
    with pytest.raises(InputError, match="run: holds another run; name another folder"):
        network.save(tmp_path / "run")
    with pytest.raises(InputError, match="is a file; name a folder"):
        network.save(tmp_path / "run" / "run.json")


def test_weights_alone_are_saved_alone(network, folder, target, tmp_path):
    (tmp_path / "bare.safetensors").write_bytes((folder / "model.safetensors").read_bytes())
    bare = qs3.load(tmp_path / "bare.safetensors")
    assert np.array_equal(bare.predict_proba(target), network.predict_proba(target))
    with pytest.raises(InputError, match="holds another run"):
        bare.save(folder)
    bare.save(tmp_path / "alone")
    for ask in (collect, lambda folder: evaluate(folder, target)):
        with pytest.raises(InputError, match=r"weights alone; settings.json and run.json are miss"):
            ask(tmp_path / "alone")


def test_clouds_may_be_arrays_lists_and_tensors(network, target):
    points = target.points[:4]
    wanted = network.predict(points).tolist()
    tensor = torch.from_numpy(points)
    for given in (points.tolist(), tensor, list(tensor), list(points), points.astype(np.float64)):
        assert network.predict(given).tolist() == wanted
    for given in (points[1], points[1].tolist(), tensor[1]):
        assert network.predict(given).tolist() == wanted[1:2]
    several = [points[0], points[1, :50].tolist(), tensor[2]]
    assert network.predict(several)[[0, 2]].tolist() == [wanted[0], wanted[2]]
    assert network.predict(np.round(100 * points).astype(int)).shape == (4,)


def test_clouds_may_be_paths(network, target, tmp_path):
    for place, points in enumerate(target.points[:3]):
        np.save(tmp_path / f"{place}.npy", points)
    wanted = network.predict(target.points[:3]).tolist()
    assert network.predict(tmp_path).tolist() == wanted
    assert network.predict([tmp_path / "2.npy", str(tmp_path / "0.npy")]).tolist() == wanted[2::-2]


def test_other_input_is_refused_with_the_number_of_the_cloud(network, target):
    good = target.points[0]
    bad = good.copy()
    bad[3, 0] = np.nan
    for given, said in (
        (np.zeros((50, 6)), r"cloud 0 has shape \[50, 6\]; a cloud is \[n 3\] numbers, in metres"),
        (np.zeros((2, 50, 2)), r"cloud 0 has shape \[50, 2\]; "),
        ([], "cloud 0 has shape"),
        (np.zeros((0, 3)), r"cloud 0 has shape \[0, 3\]; "),
        ([good, good[:50], np.zeros((0, 3))], r"cloud 2 has shape \[0, 3\]; "),
        ([good, np.full((50, 3), "chair")], "cloud 1 holds <U5; "),
        (np.stack([good, good, bad]), "points of cloud 2 are not finite"),
        ([good, bad[:50]], "points of cloud 1 are not finite"),
    ):
        with pytest.raises(InputError, match=said):
            network.predict(given)
