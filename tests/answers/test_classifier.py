"""A trained network as an object: answers, kinds of clouds, saving."""

import dataclasses
import inspect
from dataclasses import replace

import numpy as np
import pytest
import torch

import qs3
from qs3.answers import Classifier, evaluate
from qs3.clouds.preparation import Preparation
from qs3.errors import TOLD, InputError, StorageError
from qs3.report.collect import collect
from qs3.runs import SelfTrainingSettings, read_run
from qs3.runs.digests import fingerprint
from qs3.runs.run import train_settings
from qs3.runs.weights import read_tensors, write_tensors
from qs3.training import fit

from ..clouds.hostile import refused

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
    assert repr(network).endswith("of ball, disc, rod>")
    assert names.tolist() == [network.class_names[row] for row in shares.argmax(axis=1)]
    assert np.allclose(shares.sum(axis=1), 1)
    right = (names == np.array(target.class_names)[target.labels]).mean()
    assert evaluate(folder, target).scores.accuracy == right


def test_unknown_and_calibrated_need_held_out_source(network, source, target, settings, tmp_path):
    plain, doubting = network.predict(target), network.predict(target, unknown=0.5)
    assert "unknown" not in plain
    assert 0 < (doubting == "unknown").sum() < 30
    assert (doubting == plain)[doubting != "unknown"].all()
    shares = network.predict_proba(target, calibrated=True)
    assert np.allclose(shares.sum(axis=1), 1)
    assert not np.allclose(shares, network.predict_proba(target))
    fit("source-only", source, None, replace(settings, epochs=1), run_dir=tmp_path / "without")
    with pytest.raises(InputError, match="without: cannot reject unknown objects"):
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
    for taken in ("run", "run/run.json"):
        with pytest.raises(InputError, match="is there already"):
            network.save(tmp_path / taken)


def test_a_network_is_saved_whole_or_not_at_all(network, tmp_path, monkeypatch):
    def full_disk(path, data):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(data[:10])
        raise StorageError("the disk is full")

    with monkeypatch.context() as patched, pytest.raises(StorageError):
        patched.setattr("qs3.answers.classifier.write_bytes", full_disk)
        network.save(tmp_path / "saved")
    assert not (tmp_path / "saved").exists()
    assert Classifier.load(network.save(tmp_path / "saved")).class_names == network.class_names


def test_weights_alone_are_saved_alone(network, folder, target, tmp_path):
    (tmp_path / "bare.safetensors").write_bytes((folder / "model.safetensors").read_bytes())
    bare = qs3.load(tmp_path / "bare.safetensors")
    assert np.array_equal(bare.predict_proba(target), network.predict_proba(target))
    bare.save(tmp_path / "alone")
    for ask in (collect, lambda folder: evaluate(folder, target)):
        with pytest.raises(InputError, match=r"weights alone; settings.json and run.json are miss"):
            ask(tmp_path / "alone")


def test_clouds_may_be_arrays_lists_and_tensors(network, target):
    points = target.points[:4]
    wanted = network.predict(points).tolist()
    tensor = torch.from_numpy(points)
    for form in (points.tolist(), tensor, list(tensor), list(points), points.astype(np.float64)):
        assert network.predict(form).tolist() == wanted
    for form in (points[1], points[1].tolist(), tensor[1]):
        assert network.predict(form).tolist() == wanted[1:2]
    several = [points[0], points[1, :50].tolist(), tensor[2]]
    assert network.predict(several)[[0, 2]].tolist() == [wanted[0], wanted[2]]
    assert network.predict(np.round(100 * points).astype(int)).shape == (4,)


def test_clouds_may_be_paths(network, target, tmp_path):
    for place, points in enumerate(target.points[:3]):
        np.save(tmp_path / f"{place}.npy", points)
    wanted = network.predict(target.points[:3]).tolist()
    assert network.predict(tmp_path).tolist() == wanted
    assert network.predict([tmp_path / "2.npy", str(tmp_path / "0.npy")]).tolist() == wanted[2::-2]
    assert network.predict(iter(sorted(tmp_path.glob("*")))).tolist() == wanted
    (tmp_path / "link.npy").symlink_to(tmp_path / "0.npy")
    twice = [tmp_path / f"{name}.npy" for name in (2, 2, 0, "link")]
    assert network.predict(twice).tolist() == [wanted[row] for row in (2, 2, 0, 0)]
    assert [answer.file for answer in network.answers(twice)] == twice
    assert network.predict(iter(target.points[:3])).tolist() == wanted


def test_a_cloud_loses_its_points_without_a_measurement(network, target):
    cloud = target.points[0] + 1
    for mark in (np.nan, 0):
        marked = np.insert(cloud, range(0, len(cloud), 2), mark, axis=0)
        for form in (marked, marked[None], [marked], marked.astype(float).tolist()):
            assert np.array_equal(network.predict_proba(form), network.predict_proba(cloud))


def test_other_input_is_refused_with_the_number_of_the_cloud(network, target):
    good = target.points[0]
    bad = np.full_like(good, np.nan)
    for form, message in (
        (np.zeros((50, 6)), r"cloud 0 has shape \[50, 6\]; a cloud is \[n 3\] numbers, in metres"),
        (np.zeros((2, 50, 2)), r"cloud 0 has shape \[50, 2\]; "),
        (good * 1e-300, "cloud 0 has fewer than 12 distinct points"),  # in single precision
        (np.zeros((0, 3)), r"cloud 0 has shape \[0, 3\]; "),
        ([good, good[:50], np.zeros((0, 3))], r"cloud 2 has shape \[0, 3\]; "),
        ([good, np.full((50, 3), "chair")], "cloud 1 holds <U5; "),
        (np.stack([good, good, bad]), "2: holds no point that is finite"),
        ([good, np.full((50, 3), np.nan)], "1: holds no point that is finite"),
        ([[1, 2, 3], [1, 2]], "cloud 0: is no array of numbers"),
    ):
        with pytest.raises(InputError, match=message):
            network.predict(form)
    for options in ({"tolerance": "a"}, {"tolerance": "a", "pose": False}, {"tolerance": True},
                    {"place": "table"}):  # fmt: skip
        with pytest.raises(InputError, match=f"{next(iter(options))} "):
            inspect.unwrap(Classifier.answers)(network, good, **options)  # types are not checked


def test_half_precision_and_masked_points_are_as_others(network, target):
    half = (target.points[0] + 1).astype(np.float16)
    wanted = network.predict_proba(half.astype(float))
    assert np.array_equal(network.predict_proba(half), wanted)
    assert np.array_equal(network.predict_proba(half[None]), wanted)
    hidden = np.arange(len(half)) % 3 == 0
    masked = np.ma.masked_array(half, mask=np.repeat(hidden[:, None], 3, axis=1))
    assert np.array_equal(network.predict_proba(masked), network.predict_proba(half[~hidden]))


def _weights(tensors):
    return next(part for part in tensors.values() if part.is_floating_point()).view(-1)


def _edited(folder, path, change):
    """A file of weights whose tensors and facts are changed."""
    tensors, facts = read_tensors(folder / "model.safetensors")
    change(tensors, facts)
    write_tensors(path, tensors, facts)
    return path


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t, f: _weights(t).fill_(np.nan), "weights are not finite"),
        (lambda t, f: f["class_names"].__setitem__(1, f["class_names"][0]), "is named twice"),
        (lambda t, f: f["class_names"].__setitem__(0, "../../x"), "a path"),
        (lambda t, f: f.update(class_names="abc"), "no list of texts"),
        (lambda t, f: f.update(known=_known([2.0, 1.0])), "energies in rising order"),
        (lambda t, f: f.update(known=_known([1.0], temperature=0.0)), "a positive temperature"),
        (lambda t, f: f.update(sizes=[2.0, 1.0]), "sizes are no range"),
        (lambda t, f: f.update(sizes="ab"), "'sizes': 'ab' is not a list"),
    ],
)
def test_damaged_weights_are_refused_when_they_are_read(folder, tmp_path, change, message):
    path = _edited(folder, tmp_path / "a.safetensors", change)
    with refused(message, path):
        Classifier.load(path)


def _known(energies, temperature=1.0):
    return {"temperature": temperature, "energies": energies, "clouds": 3}


def test_answers_that_are_not_finite_are_refused(folder, target, tmp_path):
    path = tmp_path / "a.safetensors"
    _edited(folder, path, lambda t, f: [w.mul_(1e25) for w in t.values() if w.is_floating_point()])
    with refused("answers of the network are not finite"):
        Classifier.load(path).predict(target)


@pytest.mark.parametrize(("factor", "unit"), [(1000, "millimetres"), (100, "centimetres")])
def test_clouds_in_another_unit_are_refused_with_it(target, factor, unit):
    network = Classifier.load("rooms")  # furniture
    chair = target.points[:1] * np.float32(0.8 / np.ptp(target.points[0], axis=0).max())
    assert network.predict(chair).shape == (1,)
    with refused(f"are they in {unit}"):
        network.predict(factor * chair)
    with refused(f"1: points are to be in metres: a cloud is .* are they in {unit}"):
        network.predict([chair[0], factor * chair[0]])
    with refused("over 1,000 km apart"):
        network.predict(1e8 * chair)


def test_sizes_of_the_training_bound_the_clouds(source, target, settings, tmp_path):
    sized = dataclasses.replace(settings, epochs=1, preparation=Preparation(size_input=True))
    small = dataclasses.replace(source, points=source.points * np.float32(0.01))
    fit("source-only", small, None, sized, run_dir=tmp_path / "run")
    network = Classifier.load(tmp_path / "run")
    network.predict(0.05 * target.points)
    with refused("are they in millimetres"):
        network.predict(10 * target.points)
    with refused("target: points are to be in metres"):
        aim = dataclasses.replace(target, points=10 * target.points).without_labels()
        fit("dann:DANN", small, aim, sized, run_dir=tmp_path / "other")


def test_far_and_collinear_clouds_are_answered_as_they_are(network, target, caplog):
    TOLD.clear()
    cloud = target.points[0].astype(np.float64)
    far = cloud + np.array([512345.67, 5403210.12, 321.5])
    assert network.predict_proba(far) == pytest.approx(network.predict_proba(cloud), abs=1e-3)
    assert not caplog.messages
    network.predict(np.linspace(0, 1, 100)[:, None] * [[1.0, 2.0, 3.0]])
    assert "lies on one line" in caplog.text


def test_other_weights_are_not_overwritten(network, folder, tmp_path):
    (tmp_path / "model.safetensors").write_bytes(b"mine")
    with refused("is there already", tmp_path):
        network.save(tmp_path)
    assert (tmp_path / "model.safetensors").read_bytes() == b"mine"
