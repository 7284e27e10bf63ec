"""Networks that come with qs3: their files, their names, and how they are made from a run."""

import json
import logging
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import safetensors.torch
import torch

import qs3
from qs3.answers import evaluate
from qs3.answers.to_onnx import export_run
from qs3.cli import run
from qs3.clouds.preparation import ROBUST, Preparation, unit_ball
from qs3.clouds.types import PointClouds
from qs3.errors import TOLD, InputError
from qs3.evaluation.records import read_records
from qs3.runs import read_run
from qs3.runs.bundled import WEIGHTS, find_run, shipped, workplace
from qs3.runs.checks import note_size
from qs3.runs.weights import read_facts
from qs3.training import fit, load_model
from qs3.training.prepared import prepare_clouds

from ..scripts import load_script

ROOT = Path(__file__).parents[2]
CLOUDS = np.random.default_rng(0).uniform(size=(6, 300, 3)).astype(np.float32)


@pytest.fixture
def ship():
    return load_script(ROOT / "benchmarks" / "ship.py")


@pytest.fixture(autouse=True)
def elsewhere(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.parametrize("name", shipped())
def test_files_are_small_half_precision_and_tell_no_path(name):
    files = {path.name: path for path in (WEIGHTS / name).iterdir()}
    assert set(files) == {"README.md", "model.safetensors", "run.json", "settings.json"}
    assert sum(path.stat().st_size for path in files.values()) < 4e6
    tensors = safetensors.torch.load_file(files["model.safetensors"])
    assert {t.dtype for t in tensors.values() if t.is_floating_point()} == {torch.float16}
    for file in ("README.md", "run.json", "settings.json"):
        assert not re.search(r"(?<![\w.])/\w+/", files[file].read_text("utf-8"))
    card = files["README.md"].read_text("utf-8")
    assert all(f"<!-- {part}: benchmarks/ship.py -->" in card for part in ("facts", "scores"))
    loaded, run = load_model(Path(name)), read_run(Path(name))
    assert {value.dtype for value in loaded.model.parameters()} == {torch.float32}
    assert loaded.known.clouds == pytest.approx(0.1 * run.source.clouds, rel=0.02)
    assert run.target is None
    assert not run.target_clouds
    assert len(run.source_clouds) == run.source.clouds


def test_rooms_loads_without_the_heights_in_its_file():
    facts = read_facts(WEIGHTS / "rooms" / "model.safetensors")
    assert "heights" in facts
    assert facts["preparation"]["height_input"]
    assert not hasattr(load_model(Path("rooms")).preparation, "height_input")


@pytest.mark.slow
def test_rooms_has_the_scores_of_its_card(shared_data):
    scores = evaluate(Path("rooms"), shared_data / "nyuv2_objects.npz", split="strict-dev").scores
    assert scores.accuracy == pytest.approx(0.5115, abs=0.003)
    card = (WEIGHTS / "rooms" / "README.md").read_text("utf-8")
    assert f"| 520 | {scores.accuracy:.1%} (" in card
    assert f"| {scores.class_mean_accuracy:.1%} |" in card


def test_wheel_and_sdist_hold_them():
    sdist = pytest.importorskip("hatchling.builders.sdist").SdistBuilder(str(ROOT))
    wheel = pytest.importorskip("hatchling.builders.wheel").WheelBuilder(str(ROOT))
    packed = {file.distribution_path for file in wheel.recurse_included_files()}
    source = {file.relative_path for file in sdist.recurse_included_files()}
    for path in WEIGHTS.rglob("*.*"):
        inside = path.relative_to(ROOT / "src").as_posix()
        assert inside in packed
        assert f"src/{inside}" in source


def test_a_file_of_the_name_wins_and_unknown_names_get_suggestions(tmp_path):
    assert find_run("rooms") == WEIGHTS / "rooms"
    with pytest.raises(InputError, match=r"rooms2: .*networks that come with it.*: rooms"):
        load_model(Path("rooms2"))
    with pytest.raises(InputError, match=r"networks that come with it.*: rooms"):
        read_run(Path("rooms2"))
    (tmp_path / "rooms").mkdir()
    assert find_run("rooms") == Path("rooms")
    assert workplace("rooms") == Path("rooms")
    (tmp_path / "rooms").rmdir()
    for make in (workplace, export_run, lambda name: run(["report", str(name)])):
        with pytest.raises(InputError, match=r"rooms: comes with qs3 .*name the file: --out"):
            make(Path("rooms"))
    assert not [*tmp_path.iterdir()]
    (tmp_path / "rooms").mkdir()
    with pytest.raises(InputError, match="where no file has their name"):
        qs3.load("rooms")


def test_a_record_of_a_bundled_network_is_written_where_asked_alone(tmp_path, capsys):
    before = {path: path.stat().st_mtime_ns for path in WEIGHTS.rglob("*")}
    names = load_model(Path("rooms")).class_names
    np.savez("labelled.npz", points=CLOUDS, label=np.arange(6), class_names=np.array(names))
    record = evaluate(Path("rooms"), "labelled.npz")
    assert record.method == "source-only"
    assert record.marks == ()
    assert [path.name for path in tmp_path.iterdir()] == ["labelled.npz"]
    place = tmp_path / "mine" / "rooms.jsonl"
    words = ["rooms", "--data", "labelled.npz", "--records", str(place)]
    assert run(["evaluate", *words]) == 0
    assert str(place) in capsys.readouterr().err
    assert [one for _, one in read_records(place)[0]] == [record]
    assert run(["report", "rooms", "--records", str(place), "--out", "page.html"]) == 0
    assert re.search(r'<div class="score">source-only<b>', Path("page.html").read_text("utf-8"))
    assert run(["evaluate", *words[:3]]) == 0
    assert "not written; name a file with --records" in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["labelled.npz", "mine", "page.html"]
    assert {path: path.stat().st_mtime_ns for path in WEIGHTS.rglob("*")} == before


@pytest.mark.slow
def test_a_bundled_network_is_exported_where_asked():
    before = {path: path.stat().st_mtime_ns for path in WEIGHTS.rglob("*")}
    assert export_run(Path("rooms"), Path("model.onnx")).path == Path("model.onnx")
    assert {path: path.stat().st_mtime_ns for path in WEIGHTS.rglob("*")} == before


@pytest.mark.parametrize(("factor", "word"), [(1000, "give metres"), (0.001, "give metres")])
def test_sizes_of_no_metres_are_reported_once(caplog, factor, word):
    sized, strayed = replace(ROBUST, size_input=True), CLOUDS.copy()
    strayed[:, 0] += 40
    TOLD.clear()
    with caplog.at_level(logging.WARNING):
        for clouds in (CLOUDS, CLOUDS[:0], strayed, CLOUDS / 25):  # some of a few centimetres
            note_size(clouds, sized)
        note_size(CLOUDS * np.float32(factor), ROBUST)
        assert not caplog.messages
        for _ in range(2):
            note_size(CLOUDS * np.float32(factor), sized)
    (message,) = caplog.messages
    assert re.search(word, message)


def test_clouds_without_a_size_are_reported_for_every_preparation(caplog):
    sized = Preparation(size_input=True)
    balls = PointClouds(unit_ball(CLOUDS), np.zeros(6, np.int64), ("box",), tuple("abcdef"))
    TOLD.clear()
    with caplog.at_level(logging.WARNING):
        prepare_clouds(replace(balls, points=CLOUDS), 32, sized)
        prepare_clouds(balls.select(np.arange(1)), 32, sized)  # one may be just so large
        prepare_clouds(balls, 32)
        assert not caplog.messages
        prepare_clouds(balls.without_labels(), 32, sized)
    (message,) = caplog.messages
    assert "fills the unit ball" in message


def test_too_few_points_are_reported_once(caplog, tmp_path):
    TOLD.clear()
    network, few = qs3.load("rooms"), np.tile(CLOUDS[0, :31], (4, 1))
    np.save(tmp_path / "few.npy", few)
    with caplog.at_level(logging.WARNING):
        network.predict([CLOUDS[0], CLOUDS[0, :32]])
        assert not caplog.messages
        network.predict([CLOUDS[0], few])
        network.predict(few)
        assert len(caplog.messages) == 1
        TOLD.clear()
        qs3.load("rooms").answers([tmp_path / "few.npy"])
    assert len(caplog.messages) == 2
    assert "few.npy has fewer than 32 distinct points" in caplog.messages[1]


def test_a_run_becomes_one(ship, source, target, settings, tmp_path):
    settings = replace(settings, holdout=0.3)
    result = fit("source-only", source, None, settings, run_dir=tmp_path / "run")
    evaluate(tmp_path / "run", target)
    evaluate(tmp_path / "run", source)  # marked: the network has learnt from it
    out = tmp_path / "mine"
    out.mkdir()
    parts = "".join(
        f"<!-- {part}: benchmarks/ship.py -->\n<!-- end of {part} -->\n"
        for part in ("facts", "scores")
    )
    (out / "README.md").write_text(f"# mine\n{parts}The end.\n")
    ship.ship(tmp_path / "run", out, "balls", tmp_path / "run")
    first = {path.name: path.read_bytes() for path in out.iterdir()}
    card = first["README.md"].decode()
    assert card.startswith("# mine\n<!-- facts")
    assert card.endswith("<!-- end of scores -->\nThe end.\n")
    assert card.count("| arrays  | 30 |") == 1
    assert "| 24 |" not in card
    assert json.loads(first["run.json"])["source"]["name"] == "balls"
    answers = [load_model(place).model.state_dict() for place in (tmp_path / "run", out)]
    for name, value in answers[0].items():
        torch.testing.assert_close(answers[1][name], value, rtol=1e-3, atol=1e-4)
    assert load_model(out).known == result.known
    # From itself: the same bytes, the figure of the rounding too.
    ship.ship(out, out, "balls", tmp_path / "run")
    assert {path.name: path.read_bytes() for path in out.iterdir()} == first
    # Measured anew on the rounded network, which is hardly another.
    ship.ship(tmp_path / "run", out, "balls", tmp_path / "run", source)
    known = load_model(out).known
    assert known.clouds == result.known.clouds
    assert known.energies == pytest.approx(result.known.energies, rel=1e-2, abs=1e-2)
    with pytest.raises(SystemExit, match="not trained on this source"):
        ship.ship(tmp_path / "run", out, "balls", tmp_path, target)
    fit("dann:DANN", source, target.without_labels(), settings, run_dir=tmp_path / "adapted")
    with pytest.raises(SystemExit, match="saw no target"):
        ship.ship(tmp_path / "adapted", out, "balls", tmp_path)
