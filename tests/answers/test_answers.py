"""Answers of a network for files: listed, told in tables, linked by class."""

import json
import os
import shutil
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch

from qs3 import load
from qs3.answers.answer import Answer, answers_csv, answers_json, sort_into
from qs3.answers.cloud_files import list_clouds
from qs3.clouds.layouts.folders import CloudFile, read_files, read_folder
from qs3.clouds.load import convert, load_clouds, read_clouds
from qs3.errors import TOLD, InputError
from qs3.models import create_model
from qs3.runs import TrainSettings, save_model
from qs3.runs.loaded import Measured, facts_of
from qs3.runs.run import train_settings
from qs3.training import fit, load_model

from ..clouds.hostile import refused

NAMES = ("cup", "plate", "jug")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three clouds, one of them in a folder below, one damaged, and what is no cloud."""
    folder = tmp_path_factory.mktemp("scans")
    rng = np.random.default_rng(0)
    (folder / "more").mkdir()
    for name in ("a.npy", "b.npy", "more/a.npy"):
        np.save(folder / name, rng.standard_normal((50, 3)))
    (folder / "bad.ply").write_text("no PLY")
    (folder / "notes.md").write_text("no cloud")
    (folder / ".hidden.npy").write_text("")
    return folder


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    torch.manual_seed(0)
    settings = TrainSettings(model="pointnet", num_points=32)
    return save_model(tmp_path_factory.mktemp("run"), create_model("pointnet", 3), NAMES, settings)


@pytest.fixture(scope="module")
def knowing(tmp_path_factory, source, settings):
    """A run whose source has a held-out part."""
    run = tmp_path_factory.mktemp("knowing") / "run"
    fit("source-only", source, None, replace(settings, holdout=0.3), run_dir=run)
    return run


def names(paths, folder):
    return [path.relative_to(folder).as_posix() for path in paths]


def test_files_folders_and_patterns_are_listed_once(folder):
    every = ["a.npy", "b.npy", "bad.ply", "more/a.npy"]
    assert names(list_clouds([folder]), folder) == every
    assert names(list_clouds([folder / "*.npy"]), folder) == ["a.npy", "b.npy"]
    assert names(list_clouds([folder / "**" / "a.npy"]), folder) == ["a.npy", "more/a.npy"]
    assert names(list_clouds([folder / "b.npy", folder]), folder)[0] == "b.npy"
    assert len(list_clouds([folder, folder / "*.npy"])) == 4
    (folder.parent / "links").mkdir()
    (folder.parent / "links" / "a.npy").symlink_to(folder / "a.npy")
    others = [Path(os.path.relpath(folder)), folder / "more" / ".." / "b.npy"]
    others += [folder.parent / "links"]
    assert names(list_clouds([folder, *others]), folder) == every
    with refused("no cloud found", "*.pcd"):
        list_clouds([folder / "*.pcd"])


def test_other_names_of_a_scan_are_reported(tmp_path, caplog):
    TOLD.clear()
    np.save(tmp_path / "a.npy", np.eye(3))
    assert list_clouds([tmp_path, tmp_path / "*.npy", tmp_path / "." / "a.npy"]) == [
        tmp_path / "a.npy"
    ]
    assert caplog.messages == []
    for name in "bc":
        (tmp_path / f"{name}.npy").symlink_to("a.npy")
    for _ in range(2):
        assert list_clouds([tmp_path, tmp_path / "*.npy"]) == [tmp_path / "a.npy"]
    assert caplog.messages == [
        f"{tmp_path / 'a.npy'} has another name, {tmp_path / 'b.npy'}: 2 such names are left out"
    ]


def test_other_files_of_a_folder_are_reported_once(tmp_path, caplog):
    np.save(tmp_path / "a.npy", np.eye(3))
    (tmp_path / "below").mkdir()
    passed = ("b.npz", "below/c.LAZ", "d.laz", "noend")
    ours = (".h.npz", "segment.json", "objects.csv", "montage.png", "scene.png", "README.md")
    for name in passed + ours:
        (tmp_path / name).write_text("")
    for _ in range(2):
        assert names(list_clouds([tmp_path]), tmp_path) == ["a.npy"]
    assert caplog.messages == [f"{tmp_path}: not read: 2 .laz, 1 .npz, 1 noend"]


def test_a_data_set_is_answered_cloud_by_cloud(folder, model, tmp_path):
    points = np.stack([np.load(folder / f"{name}.npy") for name in "ab"]).astype(np.float32)
    data = tmp_path / "data.npz"
    named = {"name": np.array(["one", "two"]), "class_names": np.array(NAMES)}
    np.savez(data, points=points, label=np.array([0, 1]), **named)
    convert(data, tmp_path / "store", "store")
    plain = load(model).answers([folder / "a.npy", folder / "b.npy"])
    for path in (data, tmp_path / "store"):
        assert list_clouds([path]) == [path]
        answers = load(model).answers(list_clouds([path]))
        assert [answer.file.name for answer in answers] == ["one", "two"]
        assert [a.probabilities for a in answers] == [a.probabilities for a in plain]
        with refused("one", "qs3 convert"):
            sort_into(tmp_path / "sorted", answers)
    (tmp_path / "store" / "shard-00000.parquet").write_bytes(b"")
    damaged, good = load(model).answers([tmp_path / "store", folder / "a.npy"])
    assert "store" in damaged.fault
    assert good.probabilities == pytest.approx(plain[0].probabilities, abs=1e-6)


def test_answers_are_the_likeliest_first_and_one_bad_file_stops_no_other(folder, model):
    answers = load(model).answers(list_clouds([folder]))
    assert [bool(answer.fault) for answer in answers] == [False, False, True, False]
    assert "bad.ply" in answers[2].fault
    for answer in answers[:2]:
        shares = list(answer.probabilities.values())
        assert shares == sorted(shares, reverse=True)
        assert sum(shares) == pytest.approx(1.0)
        assert set(answer.probabilities) == set(NAMES)
        assert answer.best(2) == list(answer.probabilities.items())[:2]


def test_tables_hold_the_predictions(folder, tmp_path, model):
    answers = load(model).answers(list_clouds([folder]))
    (tmp_path / "a.csv").write_text(answers_csv(answers, top=3))
    rows = pd.read_csv(tmp_path / "a.csv", keep_default_na=False)
    assert rows["class"].tolist() == [(answer.best() or [("", 0)])[0][0] for answer in answers]
    assert set(rows.loc[0, ["class", "class_2", "class_3"]]) == set(NAMES)
    assert rows["fault"].tolist() == [answer.fault for answer in answers]
    assert answers_csv(answers, top=9) == answers_csv(answers, top=3)  # there are three classes
    entries = json.loads(answers_json(answers))
    assert entries[0]["probabilities"] == answers[0].probabilities
    assert entries[2] == {"file": str(folder / "bad.ply"), "fault": answers[2].fault}


def test_unfamiliar_clouds_are_unknown(knowing, folder, tmp_path):
    files = list_clouds([folder])
    plain, refused = [], {}
    for share in (None, 0.0, 0.5, 1.0):
        answers = load(knowing).answers(files, unknown=share)
        plain = plain or answers
        assert [a.probabilities for a in answers] == [a.probabilities for a in plain]
        assert bool(answers[2].fault)
        refused[share] = {a.file for a in answers if a.refused}
        for answer in answers if share is not None else []:
            assert answer.fault or answer.refused == (answer.familiarity < share)
            if answer.refused:
                ((likeliest, share),) = plain_best(answer)
                assert answer.best(2) == [("unknown", share), (likeliest, share)]
    assert refused[None] == refused[0.0] == set()
    assert refused[0.5] <= refused[1.0]
    assert refused[1.0]
    (tmp_path / "a.csv").write_text(answers_csv(answers, top=2))
    rows = pd.read_csv(tmp_path / "a.csv", keep_default_na=False)
    entries = json.loads(answers_json(answers))
    sort_into(tmp_path / "sorted", answers)
    for row, entry, answer in zip(rows.to_dict("records"), entries, answers, strict=True):
        assert (row["class"] == "unknown") == answer.refused == (entry.get("class") == "unknown")
        if answer.refused:
            assert row["class_2"] == plain_best(answer)[0][0]
            assert float(row["familiarity"]) == pytest.approx(answer.familiarity, abs=1e-6)
            assert entry["familiarity"] == answer.familiarity
            assert answer.file in [p.resolve() for p in (tmp_path / "sorted" / "unknown").iterdir()]


def plain_best(answer):
    return list(answer.probabilities.items())[:1]


def test_calibrated_probabilities_keep_their_order(knowing, folder):
    files = list_clouds([folder / "*.npy"])
    plain, calibrated = (
        load(knowing).answers(files, calibrated=is_calibrated) for is_calibrated in (False, True)
    )
    temperature = load_model(knowing).known.temperature
    for one, other in zip(plain, calibrated, strict=True):
        assert list(one.probabilities) == list(other.probabilities)
        powers = np.array(list(one.probabilities.values())) ** (1 / temperature)
        assert list(other.probabilities.values()) == pytest.approx(powers / powers.sum())


def test_an_invalid_share_and_a_class_named_unknown_are_refused(knowing, folder, tmp_path):
    for share in (-0.1, 1.5, float("nan")):
        with refused("unknown .* must be at least 0 and at most 1"):
            load(knowing).answers([folder / "a.npy"], unknown=share)
    loaded, named = load_model(knowing), ("ball", "unknown", "rod")
    training = train_settings(knowing)
    other = save_model(
        tmp_path, loaded.model, named, training, facts=facts_of(Measured(known=loaded.known))
    )
    with refused("has a class unknown itself"):
        load(other).answers([folder / "a.npy"], unknown=0.1)


def test_links_by_class_are_a_data_set(folder, tmp_path):
    one, two, below = (folder / name for name in ("a.npy", "b.npy", "more/a.npy"))
    answers = [Answer(one, {"cup": 0.9, "jug": 0.1}), Answer(two, {"jug": 1.0}),
               Answer(below, {"cup": 1.0}), Answer(folder / "bad.ply", fault="bad")]  # fmt: skip
    sort_into(tmp_path / "sorted", answers)
    links = {p.relative_to(tmp_path / "sorted").as_posix(): p.resolve()
             for p in (tmp_path / "sorted").rglob("*.npy")}  # fmt: skip
    assert links == {"cup/a.npy": one, "jug/b.npy": two, "cup/2_a.npy": below}
    clouds = load_clouds(tmp_path / "sorted", num_points=None)
    assert clouds.class_names == ("cup", "jug")
    with refused("is there already"):
        sort_into(tmp_path / "sorted", answers)
    with refused("cannot name a folder"):
        sort_into(tmp_path / "other", [Answer(one, {"../up": 1.0})])
    (tmp_path / "a.csv").touch()
    with refused("is not a file of points"):
        sort_into(tmp_path / "other", [Answer(tmp_path / "a.csv", {"cup": 1.0})])
    assert not (tmp_path / "other").exists()


def test_links_to_files_of_one_name_get_a_number_and_none_is_lost(tmp_path):
    places = ["1/f/o.npy", "2/f/o.npy", "f/o.npy", "2_o.npy"]
    for place in places:
        (tmp_path / place).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / place).touch()
    sort_into(tmp_path / "sorted", [Answer(tmp_path / place, {"cup": 1.0}) for place in places])
    links = {link.name: link.resolve() for link in (tmp_path / "sorted" / "cup").iterdir()}
    assert sorted(links.values()) == sorted(tmp_path / place for place in places)
    assert {*links} == {"o.npy", "2_o.npy", "3_o.npy", "2_2_o.npy"}


@pytest.mark.parametrize("option", ["--csv", "--json"])
def test_no_cloud_is_overwritten_by_a_table(model, folder, tmp_path, typed, option):
    for name in ("scan.xyz", "other.txt", "other.pts", "data.npz"):
        (tmp_path / name).write_text("0 0 0\n1 1 1\n")
    (tmp_path / "link.out").symlink_to(tmp_path / "scan.xyz")
    (tmp_path / "hard.out").hardlink_to(tmp_path / "scan.xyz")
    for out in ("scan.xyz", "link.out", "hard.out"):
        line = typed.refuses("predict", model, tmp_path / "scan.xyz", option, tmp_path / out)
        assert "one of the clouds" in line
    assert "one of the clouds" in typed.refuses(
        "predict", model, folder, option, folder / "more" / ".." / "b.npy"
    )
    for out in ("other.txt", "other.pts", "data.npz"):
        line = typed.refuses("predict", model, tmp_path / "scan.xyz", option, tmp_path / out)
        assert "may be a cloud" in line
    assert all(p.read_text() == "0 0 0\n1 1 1\n" for p in tmp_path.iterdir())
    table = tmp_path / f"table.{option[2:]}"
    for _ in range(2):
        typed("predict", model, folder / "a.npy", option, table)
    typed("predict", model, folder / "a.npy", option, tmp_path / "new.txt")


@pytest.fixture
def unprivileged():
    """A folder in which this process has no rights that a mode takes away."""
    folder = Path(tempfile.mkdtemp())
    folder.chmod(0o777)
    root = os.geteuid() == 0
    if root:
        os.seteuid(65534)
    yield folder
    if root:
        os.seteuid(0)
    for place in folder.rglob("closed"):
        place.chmod(0o755)
    shutil.rmtree(folder)


def test_a_file_without_permission_stops_no_other(unprivileged):
    (unprivileged / "closed").mkdir()
    for name in ("a.npy", "b.npy", "closed/c.npy"):
        np.save(unprivileged / name, np.eye(3))
    loaded = load(Path("rooms")).answers([unprivileged / "a.npy"])  # its modules are loaded
    (unprivileged / "b.npy").chmod(0)
    (unprivileged / "closed").chmod(0)
    answers = load(Path("rooms")).answers(list_clouds([unprivileged]))
    assert [answer.file.name for answer in answers] == ["a.npy", "b.npy", "closed"]
    assert answers[0] == loaded[0]
    assert answers[1].fault == f"{answers[1].file}: cannot be read: no permission"
    assert answers[2].fault.startswith(f"{answers[2].file}: ")
    faults = []
    files = [CloudFile(answer.file, "", "") for answer in answers[:2]]
    assert read_files(unprivileged, files, (), faults).ids == ("a.npy",)
    assert [str(fault) for fault in faults] == [answers[1].fault]
    faults.clear()  # evaluate loses no more than predict
    assert read_clouds(unprivileged, faults=faults)[0].ids == ("a.npy",)
    closed = f"{answers[2].file}: cannot be read: no permission"
    assert {str(fault) for fault in faults} == {answers[1].fault, closed}
    (unprivileged / "closed").chmod(0o755)
    (unprivileged / "closed" / "link").symlink_to(unprivileged / "a.npy")
    (unprivileged / "closed").chmod(0o444)  # its names can be listed, and a link not be followed
    faults.clear()
    assert read_clouds(unprivileged, faults=faults)[0].ids == ("a.npy",)
    assert any("closed/link: cannot be read: no permission" in str(fault) for fault in faults)
    (unprivileged / "closed").chmod(0)
    (unprivileged / "a.npy").unlink()
    (unprivileged / "b.npy").unlink()
    with pytest.raises(InputError, match="closed: cannot be read: no permission"):
        read_folder(unprivileged, faults=[])
    for place in (unprivileged, unprivileged / "closed"):
        with pytest.raises(PermissionError):
            read_folder(place)
