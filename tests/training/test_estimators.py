import numpy as np
import pytest
import torch
from sklearn.base import clone, is_classifier

import qs3
from qs3.errors import InputError
from qs3.io.preparation import ROBUST
from qs3.training import (
    QBST,
    SPST,
    Adapter,
    SelfTrainingSettings,
    TrainSettings,
    evaluate,
    fit,
    read_run,
)
from qs3.training.config import GENTLE
from qs3.training.run import fingerprint, train_settings

from .common import TRAIN, same

pytestmark = pytest.mark.filterwarnings("ignore::qs3.adaptation.SingleClassWarning")
ROUNDS = {"rounds": 2, "epochs": 1, "threshold_share": 0.6}


def test_the_line_of_the_readme(source, target):
    made = QBST(model="pointnet", train=TRAIN, self_training=ROUNDS)
    predicted = made.fit(source, target.without_labels()).predict(target)
    assert predicted.shape == (30,)
    assert set(predicted) <= {"ball", "disc", "rod"}
    assert made.score(target) == (predicted == np.array(target.class_names)[target.labels]).mean()
    assert len(made.result_.rounds) == 2
    probabilities = made.predict_proba(target.points)
    assert (made.classes_[probabilities.argmax(axis=1)] == predicted).all()


@pytest.mark.parametrize(
    ("made", "method", "rounds"),
    [
        (Adapter("dann", "pointnet", train=TRAIN), "dann", None),
        (
            SPST("pointnet", train=TRAIN, self_training=ROUNDS, warm_up="dann"),
            "dann",
            {"rule": "spst", "weight_step": 0.005},
        ),
        (Adapter("qbst", "pointnet", train=TRAIN, self_training=ROUNDS), "qbst", GENTLE),
    ],
)
def test_it_is_the_fit_of_the_function(source, target, tmp_path, made, method, rounds):
    made.fit(source, target.without_labels())
    settings = TrainSettings(**TRAIN, model="pointnet", preparation=ROBUST)
    rounds = None if rounds is None else SelfTrainingSettings(**dict(rounds) | ROUNDS)
    arguments = (method, source, target.without_labels(), settings, rounds)
    assert same(fit(*arguments, run_dir=tmp_path / "run").model, made.model_)


@pytest.mark.parametrize("kind", [Adapter, QBST, SPST])
def test_clone_copies_parameters_and_nothing_else(kind, source):
    made = kind(model="pointnet", train=TRAIN, random_state=3)
    copied = clone(made)
    assert is_classifier(copied)
    assert type(copied) is kind
    assert copied is not made
    assert copied.get_params() == made.get_params()
    assert not hasattr(copied, "model_")
    assert clone(made.set_params(random_state=4)).random_state == 4
    if kind is not Adapter:
        assert made.set_params(warm_up="dann").get_params()["warm_up"] == "dann"
        assert "method" not in made.get_params()


def test_run_folder_stays_and_is_taken_up(source, target, tmp_path):
    made = Adapter(model="pointnet", train=TRAIN, run_dir=tmp_path / "run").fit(source)
    assert (tmp_path / "run" / "model.safetensors").is_file()
    assert same(made.model_, clone(made).fit(source).model_)


def test_unknown_is_an_answer_that_is_saved_with_the_network(source, target, tmp_path):
    made = Adapter(model="pointnet", train=TRAIN | {"holdout": 0.3}).fit(source)
    plain, asked = made.predict(target), made.predict(target, unknown=0.5)
    assert "unknown" not in plain
    assert 0 < (asked == "unknown").sum() < 30
    assert (asked == plain)[asked != "unknown"].all()
    loaded = qs3.load(made.save(tmp_path))
    assert loaded.predict(target, unknown=0.5).tolist() == asked.tolist()
    shares = made.predict_proba(target, calibrated=True)
    assert np.allclose(shares.sum(axis=1), 1)
    assert not np.allclose(shares, made.predict_proba(target))
    assert made.result_.known.clouds == 6
    without = Adapter(model="pointnet", train=TRAIN | {"holdout": 0.0}).fit(source)
    with pytest.raises(InputError, match="this network: cannot tell what is unknown"):
        without.predict(target, unknown=0.05)


def test_a_saved_network_is_a_run(source, target, tmp_path):
    """What `evaluate`, ``qs3 report`` and a warm-up ask of a run is there, after `load` too."""
    made = Adapter(model="pointnet", train=TRAIN | {"holdout": 0.0}).fit(source)
    made.save(tmp_path / "saved")
    qs3.load(tmp_path / "saved").save(tmp_path / "again")
    for folder in (tmp_path / "saved", tmp_path / "again"):
        run = read_run(folder)
        assert (run.method, run.source.clouds) == ("source-only", 24)
        assert run.settings["source"] == fingerprint(source)
        assert evaluate(folder, target).scores.accuracy == made.score(target)
        assert train_settings(folder).learning_rate == 1e-2
    arguments = ("qbst", source, target.without_labels(), train_settings(tmp_path / "saved"))
    rounds = SelfTrainingSettings(**ROUNDS)
    after = fit(*arguments, rounds, run_dir=tmp_path / "run", warm_up=tmp_path / "saved")
    assert not read_run(tmp_path / "run").unknown_warm_up
    assert len(after.rounds) == 2
    with pytest.raises(InputError, match="run: holds another run; name another folder"):
        made.save(tmp_path / "run")


def test_weights_alone_say_what_is_missing(source, target, tmp_path):
    path = Adapter(model="pointnet", train=TRAIN).fit(source).save(tmp_path / "saved")
    (tmp_path / "bare.safetensors").write_bytes(path.read_bytes())
    bare = qs3.load(tmp_path / "bare.safetensors")
    with pytest.raises(InputError, match="holds another run"):
        bare.save(tmp_path / "saved")
    bare.save(tmp_path / "alone")
    with pytest.raises(InputError, match=r"weights alone; settings.json and run.json are miss"):
        evaluate(tmp_path / "alone", target)


def test_clouds_may_be_what_numpy_takes_for_them(source, target):
    made = Adapter(model="pointnet", train=TRAIN).fit(source)
    points = target.points[:4]
    wanted = made.predict(points).tolist()
    tensor = torch.from_numpy(points)
    for given in (points.tolist(), tensor, list(tensor), list(points), points.astype(np.float64)):
        assert made.predict(given).tolist() == wanted
    for given in (points[1].tolist(), tensor[1]):
        assert made.predict(given).tolist() == wanted[1:2]
    several = [points[0], points[1, :50].tolist(), tensor[2]]
    assert made.predict(several).tolist() == made.predict([*map(np.asarray, several)]).tolist()
    assert made.predict(np.round(100 * points).astype(int)).shape == (4,)


def test_clouds_may_be_paths(source, target, tmp_path):
    made = Adapter(model="pointnet", train=TRAIN).fit(source)
    for place, points in enumerate(target.points[:3]):
        np.save(tmp_path / f"{place}.npy", points)
    wanted = made.predict(target.points[:3]).tolist()
    assert made.predict(tmp_path).tolist() == wanted
    assert made.predict([tmp_path / "2.npy", str(tmp_path / "0.npy")]).tolist() == wanted[2::-2]
    with pytest.raises(InputError, match="is a file; name a folder"):
        made.save(tmp_path / "0.npy")


def test_what_is_no_cloud_is_refused(source, target):
    made = Adapter(model="pointnet", train=TRAIN).fit(source)
    good, expected = target.points[0], r"a cloud is \[n 3\] numbers, in metres, z up"
    bad = good.copy()
    bad[3, 0] = np.nan
    for given, said in (
        (np.zeros((50, 6)), r"cloud 0 has shape \[50, 6\]; "),
        (np.zeros((2, 50, 2)), r"cloud 0 has shape \[50, 2\]; "),
        ([], r"no cloud in an array of shape \[0\]; "),
        (np.zeros(3), r"no cloud in an array of shape \[3\]; "),
        (np.zeros((0, 3)), r"cloud 0 has shape \[0, 3\]; "),
        ([good, good[:50], np.zeros((0, 3))], r"cloud 2 has shape \[0, 3\]; "),
        ([good, good[:50, :2]], r"cloud 1 has shape \[50, 2\]; "),
        (iter([]), "there is no cloud; "),
        ([good, "chair"], "cloud 1 is no array of numbers; "),
        (np.zeros((1, 1, 9, 3)), r"no cloud in an array of shape \[1, 1, 9, 3\]; "),
    ):
        with pytest.raises(InputError, match=said + expected):
            made.predict(given)
    for given in ([good, bad, good], np.stack([good, bad, good]), [good, bad, good[:50]]):
        with pytest.raises(InputError, match="points of cloud 1 are not finite"):
            made.predict(given)


def test_score_takes_names_of_classes_alone(source, target):
    made = Adapter(model="pointnet", train=TRAIN).fit(source)
    names = np.array(target.class_names)[target.labels]
    assert made.score(target.points, names) == made.score(target)
    for labels, said in (
        (target.labels, "label 0 is not the name of a class; known are ball, disc, rod"),
        (["stool"] * 30, "label 'stool' is not the name"),
        (names[:3], r"30 clouds have labels of shape \[3\]"),
        (None, "these clouds have no labels"),
    ):
        with pytest.raises(InputError, match=said):
            made.score(target.points, labels)


def test_faults(source, target):
    with pytest.raises(InputError, match="not fitted yet"):
        QBST().predict(target)
    with pytest.raises(ValueError, match="Invalid parameter 'epochs'"):
        QBST().set_params(epochs=3)
    with pytest.raises(InputError, match="unknown setting 'epoch' in train"):
        Adapter(train={"epoch": 3}).fit(source)
    with pytest.raises(InputError, match="give seed as the parameter random_state"):
        Adapter(train={"seed": 3}).fit(source)
    with pytest.raises(InputError, match="unknown setting 'theta' in self_training"):
        QBST(self_training={"theta": 0.9}).fit(source, target.without_labels())
    with pytest.raises(InputError, match="QBST selects by qbst"):
        QBST(self_training={"rule": "spst"}).fit(source, target.without_labels())
    with pytest.raises(InputError, match="needs a target"):
        QBST().fit(source)
