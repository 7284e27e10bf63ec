"""CAD models and unlabelled scans in, a classifier out, in one call."""

import json
from dataclasses import replace

import numpy as np
import pytest

import qs3
from qs3.errors import InputError
from qs3.io.clouds import PointClouds
from qs3.training import read_checkpoints, read_run

from .common import same

SMALL = {
    "model_settings": {"channels": [8, 8, 16], "hidden": [8], "transforms": False},
    "num_points": 32,
    "epochs": 2,
    "batch_size": 8,
}
ROUNDS = {"rounds": 1, "epochs": 1}


@pytest.fixture
def boxes(rng):
    """Flat and tall boxes of points, in metres."""
    shapes = np.where(np.arange(24)[:, None] % 2, [1.0, 1.0, 0.1], [0.3, 0.3, 1.5])
    points = (rng.random((24, 80, 3)) * shapes[:, None]).astype(np.float32)
    ids = tuple(f"box/{row}" for row in range(24))
    return PointClouds(points, np.arange(24) % 2, ("post", "slab"), ids)


def adapt(boxes, scans, tmp_path, **settings):
    settings = {"train": SMALL, "self_training": ROUNDS} | settings
    return qs3.adapt(boxes, scans, tmp_path / "out", **settings)


def run(tmp_path):
    return read_run(tmp_path / "out" / "run")


def test_three_lines(boxes, tmp_path):
    model = adapt(boxes, list(boxes.points), tmp_path)
    assert set(model.predict(boxes.points[:3])) <= {"post", "slab"}
    model.save(tmp_path / "mine")
    again = qs3.load(tmp_path / "mine")
    assert np.array_equal(again.predict_proba(boxes.points), model.predict_proba(boxes.points))
    made = json.loads((tmp_path / "out" / "run" / "settings.json").read_text())
    assert made["method"] == "qbst"
    assert made["self_training"]["teacher"] == "average"
    assert made["train"]["preparation"]["size_input"]
    assert made["train"]["augmentation"]["stretch"] == 1.0
    assert run(tmp_path).chosen["stage"] == "round"


def test_poisoned_labels_of_the_scans_change_no_bit(boxes, tmp_path):
    """As clouds that carry them, or in a file: true or wrong, the network is the same."""
    names, networks = np.array(boxes.class_names), []
    for labels in (boxes.labels, 1 - boxes.labels):
        path = tmp_path / str(len(networks)) / "scans.npz"
        path.parent.mkdir()
        np.savez(path, points=boxes.points, label=labels, class_names=names)
        for scans in (path, replace(boxes, labels=labels)):
            place = tmp_path / str(len(networks))
            networks.append(adapt(boxes, scans, place).model)
            assert [record["skipped"] for record in run(place).rounds] == [False]
    (file, clouds), (wrong_file, wrong_clouds) = networks[:2], networks[2:]
    assert same(file, wrong_file)
    assert same(clouds, wrong_clouds)


def test_rounds_are_kept_where_they_lose_nothing_on_held_out_source(boxes, tmp_path):
    rounds = {"rounds": 2, "epochs": 1}
    adapt(boxes, boxes, tmp_path, self_training=rounds)
    assert run(tmp_path).selection == "source-val"
    made = read_checkpoints(tmp_path / "out" / "run", "round")
    shares = {checkpoint.number: checkpoint.source_accuracy for checkpoint in made}
    assert list(shares) == [0, 1, 2]
    assert run(tmp_path).chosen["number"] == max(shares, key=shares.get)
    adapt(boxes, boxes, tmp_path / "last", train=SMALL | {"rule": "last"})
    assert run(tmp_path / "last").chosen == {"stage": "round", "number": 1}


def test_failed_scans_of_adapt_are_reported(boxes, tmp_path, caplog):
    few = boxes.select(np.arange(8))
    adapt(few, boxes, tmp_path / "few")
    assert run(tmp_path / "few").selection == "last"
    assert "the last round is kept" in caplog.text
    caplog.clear()
    never = ROUNDS | {"threshold_share": None, "threshold": 0.999}
    adapt(boxes, boxes, tmp_path / "never", self_training=never)
    assert [record["skipped"] for record in run(tmp_path / "never").rounds] == [True]
    assert "all 1 rounds were skipped" in caplog.text


def test_scans_of_any_kind_are_the_same_target(boxes, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where a folder has the name of the network that comes with qs3
    folder = tmp_path / "rooms"
    folder.mkdir()
    for name, cloud in zip(boxes.ids, boxes.points, strict=True):
        np.save(folder / f"{name.replace('/', '-')}.npy", cloud)
    asked = []
    for number, scans in enumerate((folder, list(boxes.points), boxes.points, boxes)):
        model = adapt(boxes, scans, tmp_path / str(number), method="source-only")
        asked.append(model.predict_proba(boxes.points))
    assert all(np.array_equal(asked[0], other) for other in asked[1:])


def test_invalid_arguments_of_adapt_are_reported(boxes, tmp_path):
    with pytest.raises(InputError, match="no cloud found"):
        adapt(boxes, [], tmp_path)
    with pytest.raises(InputError, match="model"):  # before a mesh is scanned
        adapt("shapes", boxes, tmp_path, train={"model": "dgcnn"})
    with pytest.raises(InputError, match="epochs = 0"):
        adapt("shapes", boxes, tmp_path, train={"epochs": 0})
    with pytest.raises(InputError, match="threshold_share = 0"):
        adapt("shapes", boxes, tmp_path, self_training={"threshold_share": 0.0})
    with pytest.raises(InputError, match="nope"):
        adapt("shapes", boxes, tmp_path, method="nope")
    with pytest.raises(InputError, match="absent"):
        adapt("shapes", tmp_path / "absent", tmp_path)
    with pytest.raises(InputError, match="units mm: goes with a folder of meshes alone"):
        adapt(boxes, boxes, tmp_path, units="mm")
    with pytest.raises(InputError, match="scan sensor: goes with a folder of meshes alone"):
        adapt(boxes, boxes, tmp_path, scan={"sensor": "d415"})
    cad(tmp_path / "cad")
    with pytest.raises(InputError, match=r"unknown setting 'sensr' in scan .did you mean sensor"):
        adapt(tmp_path / "cad", boxes, tmp_path, scan={"sensr": "d415"})
    assert not (tmp_path / "out").exists()


def cad(folder, scale=1.0):
    import trimesh

    for name, size in {"slab": (0.5, 0.5, 0.05), "post": (0.2, 0.2, 1.0)}.items():
        place = folder / name
        place.mkdir(parents=True)
        trimesh.creation.box(scale * np.array(size)).export(place / "one.stl")


@pytest.mark.parametrize("units", [None, "mm"])
def test_meshes_get_the_sizes_of_the_given_unit(boxes, tmp_path, monkeypatch, units):
    class ReachedError(Exception):
        pass

    def stop(items, folder, recipe, **_):
        raise ReachedError(recipe)

    monkeypatch.setattr("qs3.store.generate.generate", stop)
    cad(tmp_path / "cad", 1000.0)
    with pytest.raises(ReachedError) as reached:
        adapt(tmp_path / "cad", boxes, tmp_path, units=units, scan={"sensor": "d415"})
    (recipe,) = reached.value.args
    assert (recipe.object_size, recipe.units) == ("file", units)
    assert (recipe.sensor, recipe.views) == ("d415", 1)


@pytest.mark.slow
def test_meshes_are_scanned_first(boxes, tmp_path, caplog):
    cad(tmp_path / "cad")
    (tmp_path / "cad" / "post" / "broken.stl").write_text("solid broken")
    here = {"workers": 0, "train": SMALL | {"epochs": np.int64(1)}}
    model = adapt(tmp_path / "cad", boxes, tmp_path, method="source-only", **here)
    assert model.class_names == ("post", "slab")
    assert "1 of 3 scans failed, told in" in caplog.text
    assert "post/broken#0" in caplog.text
    assert (tmp_path / "out" / "source" / "dataset.json").is_file()
