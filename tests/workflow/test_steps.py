"""The way for own parts does each thing once, and goes on with what is there."""

import csv
import inspect
import json
import shlex
import shutil
from collections import Counter
from dataclasses import replace
from itertools import takewhile
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest
import trimesh

import qs3
from qs3.clouds.layouts.store import read_ragged
from qs3.clouds.ply_writer import ply_bytes
from qs3.errors import TOLD, InputError
from qs3.meshes import collect, trees
from qs3.parts import LIBRARY, Library
from qs3.parts.cad import keep_cad
from qs3.parts.forest import read_forest, save_forest
from qs3.report.page import Report, write_report
from qs3.runs import read_run
from qs3.workflow import adapt as module
from qs3.workflow.options import AdaptOptions

from .conftest import PARTS, write_cad

OPTIONS = AdaptOptions(units="mm", workers=0)


class Finished(NamedTuple):
    """A folder of CAD and scans, what the whole way made of them, and its calls by argument."""

    place: Path
    adapted: module.Adapted
    calls: Counter[tuple[str, object]]


@pytest.fixture(scope="module")
def finished(quick, tmp_path_factory):
    place, calls = furnish(tmp_path_factory.mktemp("finished")), Counter()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(trees, "_KEPT", {})
        count_calls(patch, calls, qs3.answers.cloud_files, "read_placed", lambda path: path)
        count_calls(patch, calls, trees, "load_mesh", lambda path: path)
        count_calls(patch, calls, qs3.answers.answer, "note_cloud", lambda _, name: name)
        _, result = go(place)
    return Finished(place, result, calls)


@pytest.fixture
def again(finished, tmp_path):
    """A copy of that folder, to go on in."""
    return shutil.copytree(finished.place, tmp_path / "again")


@pytest.fixture
def place(tmp_path):
    return furnish(tmp_path)


def furnish(place):
    write_cad(place / "cad")
    (place / "scans").mkdir()
    for name in PARTS:
        for seed in range(2):
            (place / "scans" / f"{name}-{seed}.ply").write_bytes(ply_bytes(scan(name, seed)))
    return place


def scan(name, seed):
    points, faces = PARTS[name].sample(1500, return_index=True, seed=seed)
    seen = points[PARTS[name].face_normals[faces][:, 2] > -0.5] / 1000
    return (seen + np.random.default_rng(seed).normal(0, 0.0003, seen.shape)).astype(np.float32)


def go(place, options=OPTIONS, scans=None, out="out"):
    """Go the whole way; return what was said and what it ended with."""
    clouds = place / "scans" if scans is None else scans
    lines, result = [], None
    for step in module.steps(place / "cad", clouds, place / out, options):
        lines += [step.command, *step.lines]
        result = step.result
    return [line for line in lines if line], result


def learn(place, options=OPTIONS, scans=None, out="out"):
    """Go as far as the forest, and return its bytes."""
    clouds = place / "scans" if scans is None else scans
    steps = module.steps(place / "cad", clouds, place / out, options)
    for _ in takewhile(lambda step: step.verb != "predict", steps):
        pass
    name = "run" if options.labels is None else "run-labelled"
    return forest_of(place / out / name)


def forest_of(run):
    return (run / "forest.safetensors").read_bytes()


def count_calls(monkeypatch, calls, where, name, key):
    """Count the calls of a function by an argument."""
    plain = getattr(where, name)

    def counted(*arguments, **named):
        calls[name, key(*arguments)] += 1
        return plain(*arguments, **named)

    monkeypatch.setattr(where, name, counted)


def test_each_scan_and_mesh_is_read_once_and_answered_once(finished):
    assert len(finished.adapted.answers) == 6
    counts = Counter(name for name, _ in finished.calls)
    assert counts == {"read_placed": 6, "load_mesh": 3, "note_cloud": 6}
    assert {*finished.calls.values()} == {1}


@pytest.mark.parametrize("away", [(60.25, -45, 0), (500000, 4600000.5, 100)])
@pytest.mark.parametrize("as_files", [True, False])
def test_poses_of_scans_far_away_belong_to_their_files(finished, tmp_path, away, as_files):
    near = scan("wedge", 0).astype(np.float64)
    clouds = [near, near + away]
    if as_files:
        for row, cloud in enumerate(clouds):
            np.save(tmp_path / f"{row}.npy", cloud)
        clouds = [tmp_path / "0.npy", tmp_path / "1.npy"]
    one, far = finished.adapted.classifier.answers(clouds)
    np.testing.assert_allclose(far.pose[:3, 3] - one.pose[:3, 3], away, atol=3e-4)
    np.testing.assert_allclose(far.points.mean(axis=0) - one.points.mean(axis=0), away, atol=1e-3)


def test_simulated_scans_of_many_sizes_are_read(finished):
    stored = [len(cloud) for cloud in read_ragged(finished.place / "out/source", "points").clouds]
    assert len({*stored}) > 2
    source = finished.adapted.source
    counts = [len(np.unique(cloud, axis=0)) for cloud in source.points]
    first = np.unique(source.scan_rows())
    assert [counts[row] for row in first] == stored


def test_a_run_whose_cad_has_another_format_is_trained_again(finished, again, monkeypatch):
    """A run of an earlier version: the next step could not read it."""
    monkeypatch.setattr("qs3.parts.witness.FORMAT", 99)
    lines, result = go(again)
    assert not any("has learnt from these already" in line for line in lines)
    assert shares(result) == shares(finished.adapted)


def test_cad_is_looked_at_again_if_a_file_has_changed_alone(again, monkeypatch):
    calls, run = Counter(), again / "out" / "run"
    count_calls(monkeypatch, calls, qs3.parts.library, "_look_at", lambda item, _: item.id)
    before = forest_of(run)
    shutil.rmtree(run)
    assert learn(again) == before
    assert not calls
    (again / "out" / "cad" / LIBRARY).write_bytes(b"damaged")
    shutil.rmtree(run)
    assert learn(again) == before
    assert len(calls) == 3
    PARTS["rod"].copy().apply_scale(1.1).export(again / "cad" / "rod.stl")
    shutil.rmtree(again / "out" / "source")
    shutil.rmtree(run)
    learn(again)
    assert {*calls.values()} == {2}
    rod = {part.cad: part for part in Library.read(run / LIBRARY)}["rod"]
    assert np.ptp(rod.points[:, 2]) == pytest.approx(0.088, rel=0.02)


@pytest.mark.parametrize("change", ["versions", "unreadable"])
def test_kept_cad_is_that_of_these_versions_and_files(place, monkeypatch, change):
    """A file that cannot be opened for its checksum is no other than one that cannot be read."""
    calls, items = Counter(), collect(place / "cad")
    count_calls(monkeypatch, calls, qs3.parts.library, "_look_at", lambda item, _: item.id)
    if change == "unreadable":
        monkeypatch.setattr("qs3.store.manifest.sha256", closed)
    keep_cad(place / "kept", items, tuple(PARTS), "mm")
    assert (place / "kept").exists() == (change == "versions")
    monkeypatch.setattr("qs3.parts.cad.package_versions", lambda *_: {"trimesh": "0"})
    keep_cad(place / "kept", items, tuple(PARTS), "mm")
    assert {*calls.values()} == {2}


def closed(path):
    raise PermissionError(13, "Permission denied", str(path))


def test_warnings_about_kept_cad_are_said_each_time(place, caplog):
    inside_out = PARTS["rod"].copy()
    inside_out.invert()
    inside_out.export(place / "cad" / "rod.stl")
    for _ in range(2):
        TOLD.clear()
        caplog.clear()
        keep_cad(place / "kept", collect(place / "cad"), tuple(PARTS), "mm")
        assert "rod.stl: its faces look inwards" in caplog.text
        trees._KEPT.clear()
    assert (place / "kept").exists()


def test_a_finished_run_is_not_trained_again_even_if_its_cad_is_renamed(
    finished, again, monkeypatch
):
    monkeypatch.setattr(
        "qs3.parts.forest_training.fit_forest", lambda *_, **__: pytest.fail("trained")
    )
    (again / "cad").rename(again / "renamed")
    steps = module.steps(again / "renamed", again / "scans", again / "out", OPTIONS)
    done = [(step.result, step.lines) for step in steps]
    assert any("has learnt from these already" in line for _, lines in done for line in lines)
    assert shares(done[-1][0]) == shares(finished.adapted)


@pytest.mark.parametrize("name", ["records.jsonl", "report.html"])
def test_another_training_leaves_the_run_and_its_records(again, name):
    run = again / "out" / "run"
    (run / name).write_text("mine")
    before = {path.name: path.read_bytes() for path in run.iterdir()}
    qbst = AdaptOptions(units="mm", workers=0, method="qbst")
    for dry_run in (True, False):
        with pytest.raises(InputError, match=r"out/run: holds a run with method = 'source-only'"):
            [*module.steps(again / "cad", again / "scans", again / "out", qbst, dry_run=dry_run)]
    PARTS["rod"].copy().apply_scale(1.1).export(again / "cad" / "rod.stl")
    shutil.rmtree(again / "out" / "source")
    for dry_run in (True, False):
        places = again / "cad", again / "scans", again / "out"
        begun = takewhile(lambda step: step.verb != "generate",
                          module.steps(*places, OPTIONS, dry_run=dry_run))  # fmt: skip
        with pytest.raises(InputError, match=rf"out/run: .* would remove {name}; move it"):
            _ = [*begun]
    assert before == {path.name: path.read_bytes() for path in run.iterdir()}


@pytest.mark.parametrize("name", ["answers.csv", "run/labels.csv", "source/labels.csv"])
@pytest.mark.parametrize("dry_run", [True, False])
def test_labels_that_the_call_would_overwrite_are_refused_at_once(again, name, dry_run):
    file = again / "out" / name
    file.write_text("file,class\nrod-0.ply,block\n")
    options = AdaptOptions(units="mm", workers=0, labels=again / "out" / ".." / "out" / name)
    steps = module.steps(again / "cad", again / "scans", again / "out", options, dry_run=dry_run)
    with pytest.raises(InputError, match=f"{file.name}: lies where this call writes"):
        next(steps)
    assert "rod-0.ply,block" in file.read_text()


OURS = ("answers.csv", "poses.json", "parts.html", "report.html", "contact-sheet.png")


@pytest.mark.parametrize("name", [*OURS, "poses/poses.png"])
@pytest.mark.parametrize("dry_run", [(), ("--dry-run",)])
def test_results_of_others_in_the_folder_are_refused_before_any_work(again, typed, name, dry_run):
    file = again / "out" / name
    file.parent.mkdir(exist_ok=True)
    file.write_text("file,class\nrod-0.ply,mine\n")
    (again / "scans" / "more.ply").write_bytes(ply_bytes(scan("rod", 9)))
    before = {path: path.stat().st_mtime_ns for path in again.rglob("*")}
    words = (again / "cad", again / "scans", "--units", "mm", "--out", again / "out", *dry_run)
    line = typed.refuses("adapt", *words)
    assert f"{file}: is " in line
    assert "move it" in line
    assert {path: path.stat().st_mtime_ns for path in again.rglob("*")} == before
    if name in OURS[:2]:
        with pytest.raises(InputError, match="holds no answers"):
            qs3.adapt(again / "cad", again / "scans", again / "out", units="mm")


@pytest.mark.parametrize(("pattern", "whole"), [("*.ply", True), ("*-0.ply", False)])
def test_a_pattern_knows_the_camera_and_prints_commands_for_a_shell(place, pattern, whole):
    scans = (place / "scans").rename(place / "my scans")
    rows = [f"{file.name},0.5,60" for file in sorted(scans.glob("*.ply"))]
    (scans / "objects.csv").write_text("\n".join(["file,distance,elevation", *rows]))
    (place / "labels.csv").write_text("file,class\nrod-0.ply,rod\n")  # below the folder
    options = AdaptOptions(units="mm", workers=0, labels=place / "labels.csv")
    steps = module.steps(place / "cad", [scans / pattern], place / "out", options, dry_run=True)
    lines = [line for step in steps for line in (step.command, *step.lines) if line]
    assert "distance 0.5 to 0.5 m, elevation 60 to 60°" in lines[0]
    training = lines[-1]
    assert training.startswith("qs3 train") == whole
    words = shlex.split(training)
    assert Path(words[words.index("--target") + 1]) == scans


@pytest.mark.parametrize("ours", [True, False])
def test_files_of_the_user_in_the_folder_of_kept_cad_stay(again, ours):
    """An earlier version kept no CAD there, so that the folder may be the user's."""
    kept = again / "out" / "cad"
    if not ours:
        shutil.rmtree(kept)
        kept.mkdir()
    (kept / "notes.txt").write_text("mine")
    before = {path.name: path.read_bytes() for path in kept.iterdir()}
    with pytest.raises(InputError, match="cad: holds something else"):
        go(again)
    assert {path.name: path.read_bytes() for path in kept.iterdir()} == before


def test_one_more_scan_is_answered_by_the_run_that_is_there(again, monkeypatch):
    """As a new training would: a forest without rounds learns nothing from it."""
    (again / "scans" / "more.ply").write_bytes(ply_bytes(scan("rod", 9)[::2]))
    shutil.copytree(again / "out", again / "anew")
    shutil.rmtree(again / "anew" / "run")
    go(again, out="anew")
    monkeypatch.setattr(
        "qs3.parts.forest_training.fit_forest", lambda *_, **__: pytest.fail("trained")
    )
    lines, result = go(again)
    assert len(result.answers) == 7
    assert any("has learnt from these already" in line for line in lines)
    for name in ("answers.csv", "poses.json"):
        assert (again / "out" / name).read_bytes() == (again / "anew" / name).read_bytes()


def test_labels_and_one_more_scan_learn_from_the_simulated_scans_that_are_there(again):
    shards = {path: path.read_bytes() for path in (again / "out" / "source").glob("*.parquet")}
    (again / "labels.csv").write_text("file,class\nrod-0.ply,rod\n")
    labelled = AdaptOptions(units="mm", workers=0, labels=again / "labels.csv")
    before = forest_of(again / "out" / "run")
    one = learn(again, labelled)
    assert read_run(again / "out" / "run-labelled").method == "few-label"
    assert forest_of(again / "out" / "run") == before != one
    (again / "labels.csv").write_text("file,class\nrod-0.ply,rod\nblock-0.ply,block\n")
    assert learn(again, labelled) != one
    assert read_run(again / "out" / "run-labelled").method == "few-label"
    (again / "scans" / "more.ply").write_bytes(ply_bytes(scan("rod", 9)[::2]))
    page = again / "out" / "run-labelled" / "report.html"  # goes with the run that it is about
    write_report(page, Report("a run", "", ("block", "rod")))
    lines, result = go(again, labelled)
    assert len(result.answers) == 7
    files = {(again / "scans" / f"{name}-0.ply").resolve(): name for name in ("rod", "block")}
    assert result.labels == files
    assert any(" 7 scans: " in line for line in lines)
    assert not page.exists()
    assert shards == {p: p.read_bytes() for p in (again / "out" / "source").glob("*.parquet")}


def test_a_scan_larger_than_every_part_makes_no_other_simulation(again):
    shards = {path: path.read_bytes() for path in (again / "out" / "source").glob("*.parquet")}
    frame = np.random.default_rng(0).random((9000, 3)) * [0.6, 0.4, 0.3]
    np.save(again / "scans" / "frame.npy", frame)
    result = go(again)[1]
    assert [answer.file.name for answer in result.answers if answer.fault] == ["frame.npy"]
    assert shards == {p: p.read_bytes() for p in (again / "out" / "source").glob("*.parquet")}


def test_scans_that_an_earlier_version_simulated_are_refused_at_once(again):
    path = again / "out" / "source" / "dataset.json"
    record = json.loads(path.read_text("utf-8"))
    del record["settings"]["table_cut"]
    path.write_text(json.dumps(record), "utf-8")
    with pytest.raises(InputError, match=r"source: an earlier version of qs3 .* --out"):
        go(again)


def test_other_scans_are_another_simulation(again):
    for path in (again / "scans").glob("*.ply"):
        path.write_bytes(ply_bytes(scan(path.stem.split("-")[0], 1)[::3]))
    with pytest.raises(InputError, match="made with num_points"):
        go(again)
    with pytest.raises(InputError, match=r"made with sensor\."):
        go(again, replace(OPTIONS, camera="kinect-v1"))


@pytest.fixture(scope="module")
def troubled(quick, tmp_path_factory):
    """A folder with scans that are none, and one of no part, and what the way made of it."""
    place = furnish(tmp_path_factory.mktemp("troubled"))
    (place / "scans" / "bad.ply").write_text("no cloud")
    table = np.random.default_rng(0).random((900, 3)) * [0.6, 0.4, 0.001]
    whole = scan("rod", 7)
    organised = np.concatenate([whole, np.full((len(whole), 3), np.nan, np.float32)])
    others = {
        "three": np.eye(3) / 20,
        "table": table,
        "organised": organised.reshape(2, -1, 3),
        "ball": trimesh.creation.icosphere(subdivisions=2, radius=0.03).sample(900, seed=1),
    }
    for name, points in others.items():
        np.save(place / "scans" / f"{name}.npy", points.astype(np.float32))
    return place, go(place)[1]


def test_bad_scans_cost_themselves(troubled):
    place, result = troubled
    faults = {a.file.name: a.fault for a in result.answers if a.fault}
    assert {*faults} == {"bad.ply", "three.npy", "table.npy"}
    assert "fewer than 12 distinct points" in faults["three.npy"]
    assert "several parts, or the table?" in faults["table.npy"]
    rows = list(csv.DictReader((place / "out" / "answers.csv").read_text().splitlines()))
    assert len(rows) == 11
    assert sum(bool(row["class"]) for row in rows) == 8
    _, forced = go(place, AdaptOptions(units="mm", workers=0, force=True), out="forced")
    assert {a.file.name for a in forced.answers if a.fault} == {"bad.ply", "three.npy"}
    steps = module.steps(place / "cad", place / "scans", place / "dry", OPTIONS, dry_run=True)
    assert {*faults.values()} <= {line for step in steps for line in step.lines}


def test_the_end_counts_classes_doubts_and_lost_scans_as_the_page_does(troubled):
    from qs3.report.parts_page import parts_page

    place, result = troubled
    head, *rows, (title, *total) = result.summary()
    assert head == ("class", "scans", "in doubt", "lost")
    counts = np.array([row[1:] for row in rows], int)
    assert title == "all"
    assert counts.sum(axis=0).tolist() == [int(text) for text in total]
    assert counts[:, 0].sum() == 8
    assert next(a for a in result.answers if a.file.name == "ball.npy").in_doubt
    page = parts_page(result.answers, result.classifier.class_names)
    # The page also has the scans without an answer.
    assert page.count('class="scan doubt"') == counts[:, 1].sum() + 3
    first, last = module.describe(result, place / "parts.html")
    assert f"{total[1]} of 11 scans are in doubt" in first
    assert f"{total[2]} of them lost" in first
    assert "unknown" not in first
    assert f"choose their classes there, or: qs3 suggest {result.run}" in first
    learnt = replace(result, labels={place / "rod-0.ply": "rod"})
    more = module.describe(learnt, place)[0]
    assert more.endswith("--out more-labels.csv, and add its rows to those that you have")
    data = place / "set.npz"
    np.savez(data, points=np.zeros((2, 20, 3), np.float32))
    files = replace(result, scans=replace(result.scans, places=(data,)))
    assert f"qs3 convert {data} FOLDER --to ply" in module.describe(files, place)[0]
    assert "suggest" not in module.describe(files, place)[0]
    unsure = tuple(replace(answer, refused=True) for answer in result.answers)
    assert (
        "below 0.5, unknown, or lost" in module.describe(replace(result, answers=unsure), place)[0]
    )
    assert "parts.html" in first
    assert "3 scans have no answer" in last
    assert "three.npy" in last
    kept = tuple(a for a in result.answers if a.file.name not in ("bad.ply", "table.npy"))
    assert module.describe(replace(result, answers=kept), place)[-1].startswith("1 scan has no")


def test_a_fault_of_cad_or_scans_brings_no_warnings_about_the_other(place, caplog):
    TOLD.clear()
    (place / "empty").mkdir()
    with pytest.raises(InputError, match="no cloud found"):
        go(place, scans=place / "empty")
    for name in ("rod", "wedge"):
        (place / "cad" / f"{name}.stl").unlink()
    with pytest.raises(InputError, match="holds one class alone"):
        go(place)
    assert not [text for text in caplog.messages if "scans: a flat folder" in text]
    assert not [text for text in caplog.messages if "does not name its unit" in text]


def shares(result):
    return [answer.probabilities for answer in result.answers]


def test_lists_of_paths_and_arrays_give_the_answers_of_their_folder(finished, again):
    files = sorted((again / "scans").glob("*.ply"))
    result = go(again, scans=iter(files), out="files")[1]
    assert [answer.file for answer in result.answers] == files
    assert shares(result) == shares(finished.adapted)
    clouds = [scan(path.stem.split("-")[0], int(path.stem.split("-")[1])) for path in files]
    assert learn(again, scans=clouds, out="arrays") == forest_of(again / "files" / "run")


@pytest.mark.parametrize(
    ("inputs", "fault"),
    [
        ("swapped", "holds no CAD, and .*cad does: name the CAD first"),
        ("one class", "holds one class alone, block"),
        ("one cloud", "one cloud; adapt learns from many"),
        ("one array", "one cloud|several clouds"),
        ("no such scans", r"nowhere: no such file or folder$"),
        ("same CAD", "block and copy have the same shape"),
        ("units", r"is the CAD in millimetres\? Give --units mm"),
        ("units of two kinds", r"wedge for milli.*: --units mm, say; if not, scale some of them"),
        ("word", "cad: class Unknown of Unknown is a word of the answers; rename it"),
        ("damaged CAD", r"^\S*cad: has no usable mesh of rod; mend it, or remove its class$"),
        ("label", r"labels.csv: labels a scan without an answer: .*far.npy: is .* m large"),
        ("label elsewhere", r"labels.csv: .*far.npy: is .* m large, and no part is over"),
    ],
)
def test_what_cannot_be_is_refused_before_anything_is_scanned(place, monkeypatch, inputs, fault):
    monkeypatch.setattr(module, "generate", lambda *_, **__: pytest.fail("scanned"))
    cad, scans, options = place / "cad", place / "scans", OPTIONS
    if inputs == "swapped":
        cad, scans = scans, cad
    elif inputs == "one class":
        for name in ("rod", "wedge"):
            (cad / f"{name}.stl").unlink()
    elif inputs == "one cloud":
        scans = scans / "rod-0.ply"
    elif inputs == "one array":
        scans = scan("rod", 0)
    elif inputs == "no such scans":
        scans = [scans, place / "nowhere"]
    elif inputs == "same CAD":
        PARTS["block"].copy().apply_translation((1, 2, 3)).export(cad / "copy.off")
    elif inputs == "units":
        options = AdaptOptions(units="cm", workers=0)
    elif inputs == "units of two kinds":
        PARTS["block"].copy().apply_scale(0.05).export(cad / "block.stl")
        options = AdaptOptions(workers=0, force=True)  # which cannot help
    elif inputs == "word":
        (cad / "rod.stl").rename(cad / "Unknown.stl")
    elif inputs == "damaged CAD":
        (cad / "rod.stl").write_bytes(b"solid rod")
    elif inputs in ("label", "label elsewhere"):
        far = scans / "far.npy" if inputs == "label" else place / "far.npy"
        np.save(far, 1000 * scan("rod", 2))
        (place / "labels.csv").write_text("file,class\nfar.npy,rod\nrod-0.ply,rod\n")
        options = AdaptOptions(units="mm", workers=0, labels=place / "labels.csv")
    with pytest.raises(InputError, match=fault):
        list(module.steps(cad, scans, place / "out", options))
    with pytest.raises(InputError, match=fault):
        list(module.steps(cad, scans, place / "dry", options, dry_run=True))
    assert not (place / "dry").exists()


@pytest.mark.parametrize("name", ["distance", "elevation"])
def test_a_range_has_its_smaller_number_first(name):
    with pytest.raises(
        InputError, match=rf"adapt: {name} \(0\.8, 0\.4\): give two numbers, the sm"
    ):
        AdaptOptions(**{name: (0.8, 0.4)})


def test_the_place_of_the_camera_is_chosen_measured_or_its_own(place):
    def stands(out, **named):
        options = AdaptOptions(units="mm", workers=0, **named)
        steps = module.steps(place / "cad", place / "scans", place / out, options)
        [*takewhile(lambda step: step.verb != "train", steps)]
        settings = qs3.files.read_json(place / out / "source" / "dataset.json")["settings"]
        near = settings["sensor"]["depth"]["near"]
        return near, *(settings["sensor"]["placement"][name] for name in ("radius", "elevation"))

    assert stands("plain")[1:] == ([0.35, 0.8], [35.0, 80.0])
    assert stands("named", distance=(0.4, 0.6), elevation=(50.0, 70.0))[1:] == (
        [0.4, 0.6], [50.0, 70.0],
    )  # fmt: skip
    near, (low, high), _ = stands("far", camera="kinect-v1")
    assert near < low < high  # of what is nearer it sees nothing
    text = 'base = "d435"\nplacement.radius = [0.5, 0.6]\n'
    (place / "mine.toml").write_text(text)
    assert stands("own", camera=str(place / "mine.toml"))[1] == [0.5, 0.6]


def test_probabilities_are_calibrated_by_simulated_scans_alone(again):
    file = again / "out" / "run" / "forest.safetensors"
    forest, facts = read_forest(file)
    assert 0.25 <= facts["temperature"] <= 4
    assert facts["known"]["temperature"] == 1
    save_forest(file, forest, facts | {"temperature": 1e-300})
    with pytest.raises(InputError, match="temperature is damaged"):
        qs3.load(file.parent)


def test_the_help_names_arguments_and_options_alone():
    names = list(inspect.signature(qs3.adapt).parameters)
    assert names[:3] == ["cad", "scans", "out"]
    assert {"camera", "units", "labels", "distance", "force", "say"} <= {*names}
    assert len(str(inspect.signature(qs3.adapt))) < 500
    with pytest.raises(TypeError, match="unit"):
        qs3.adapt("cad", "scans", unit="mm")
