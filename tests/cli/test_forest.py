"""A forest of one's own parts, from the command line: labels, CAD and poses."""

import csv
import json
import os
import re
import shutil
import unicodedata

import numpy as np
import pytest
import safetensors
import safetensors.numpy
import trimesh
from matplotlib.figure import Figure
from PIL import Image

from qs3.answers import Classifier
from qs3.errors import InputError
from qs3.escapes import cell
from qs3.parts import locate_files, witness
from qs3.runs import read_run
from qs3.runs.run import _settings, claim_run
from qs3.workflow.labels import read_labels

from ..stores import generate_quickly, quicken

PARTS = {
    "block": trimesh.creation.box((0.06, 0.04, 0.02)),
    "rod": trimesh.creation.cylinder(0.01, 0.08),
    "wedge": trimesh.creation.cone(0.03, 0.05),
}


CAMERA = np.array([0.4, -0.5, 0.77])
"""Direction to a camera; the parts are convex."""


@pytest.fixture(scope="module", autouse=True)
def few_trees():
    with pytest.MonkeyPatch.context() as patch:
        quicken(patch, 60)
        yield


@pytest.fixture(scope="module")
def place(tmp_path_factory):
    """CAD in millimetres, labelled clouds and scans of the sides that a camera sees."""
    root = tmp_path_factory.mktemp("parts")
    rng = np.random.default_rng(0)
    for name, mesh in PARTS.items():
        for folder, count in (("source", 8), ("scans", 3)):
            (root / folder / name).mkdir(parents=True)
            for i in range(count):
                points, faces = mesh.sample(2400, return_index=True, seed=int(rng.integers(2**31)))
                seen = points[mesh.face_normals[faces] @ CAMERA > 0.1]
                noisy = seen + rng.normal(0, 0.0003, seen.shape)
                np.save(root / folder / name / f"{name}-{i}.npy", noisy.astype(np.float32))
        (root / "cad" / name).mkdir(parents=True)
        mesh.copy().apply_scale(1000).export(root / "cad" / name / f"{name}.stl")
    return root


@pytest.fixture(scope="module")
def run(place):
    from qs3.cli import run

    words = ["train", "--model", "forest", "--source", str(place / "source")]
    words += ["--meshes", str(place / "cad"), "--units", "mm", "--out", str(place / "run")]
    assert run(words) == 0
    return place / "run"


def test_a_prediction_tells_cad_and_pose(typed, place, run):
    answers = json.loads(typed("predict", run, place / "scans", "--json", "-").stdout)
    assert len(answers) == 9
    for answer in answers:
        assert answer["class"] in answer["file"]
        assert answer["cad"] == f"{answer['class']}/{answer['class']}"
        assert not answer["lost"]
        # The file as another program loads it, in metres, lies where the scan is.
        mesh = trimesh.load(place / "cad" / f"{answer['cad']}.stl")
        posed = mesh.apply_scale(0.001).apply_transform(np.array(answer["pose"]))
        away = np.abs(trimesh.proximity.closest_point(posed, np.load(answer["file"]))[1])
        assert np.quantile(away, 0.9) < 0.0015
        assert answer["residual"] < 0.003
    text = typed("predict", run, place / "scans" / "rod" / "rod-0.npy").stdout
    assert re.search(r"rod\t[\d.]+\trod/rod\tresidual [\d.]+ mm\tvisible \d+%$", text.strip())


def test_the_fast_forest_alone(typed, place, run, tmp_path):
    table = tmp_path / "answers.csv"
    text = typed("predict", run, place / "scans" / "rod", "--no-pose", "--csv", table).stdout
    assert "residual" not in text
    assert table.read_text().splitlines()[0] == "file,class,confidence,fault"


def test_json_on_standard_output_is_alone_there(typed, place, run, tmp_path):
    done = typed("predict", run, place / "scans" / "rod", "--json", "-", "--pictures",
                 tmp_path / "poses", "--sort-into", tmp_path / "sorted", "--csv",
                 tmp_path / "a.csv", "--unknown", 0.05, "--top", 2)  # fmt: skip
    assert len(json.loads(done.stdout)) == 3
    assert str(tmp_path / "poses" / "poses.png") in done.stderr


def test_pictures_of_an_earlier_call_go_and_others_stay(typed, place, run, tmp_path, monkeypatch):
    monkeypatch.setattr("qs3.report.scans._A_PAGE", 1)
    words, folder, rods = ("predict", run), tmp_path / "poses", place / "scans" / "rod"
    done = typed(*words, rods, "--pictures", folder)
    pages = [folder / name for name in ("poses.png", "poses-2.png", "poses-3.png")]
    assert done.stdout.splitlines()[-3:] == [str(page) for page in pages]
    (folder / "poses-notes.png").write_bytes(b"mine")
    typed(*words, rods / "rod-0.npy", "--pictures", folder)
    assert sorted(path.name for path in folder.iterdir()) == ["poses-notes.png", "poses.png"]
    (folder / "poses-3.png").write_bytes(b"mine")
    line = typed.refuses(*words, rods / "rod-0.npy", "--pictures", folder)
    assert "poses-3.png: is no such picture of qs3" in line
    assert (folder / "poses-3.png").read_bytes() == b"mine"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--csv", "X.csv", "--json", "./a/../X.csv"), "--csv and --json name one file"),
        (("--csv", "new/X.csv", "--sort-into", "new"), "lies in --sort-into"),
        (("--pictures", "new", "--sort-into", "new"), "lies in --sort-into"),
    ],
)
def test_two_outputs_in_one_place_are_refused(
    typed, place, run, words, message, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert message in typed.refuses("predict", run, place / "scans" / "rod", *words)
    assert not list(tmp_path.iterdir())


def test_a_saved_forest_keeps_its_cad(run, tmp_path):
    Classifier.load(run).save(tmp_path / "saved")
    names = ("library.safetensors", "witness.safetensors", "forest.safetensors")
    assert [(tmp_path / "saved" / n).read_bytes() for n in names] == [
        (run / n).read_bytes() for n in names
    ]


def test_edges_of_the_cad_are_drawn_where_the_scan_lies(typed, place, run, tmp_path, monkeypatch):
    drawn = []
    monkeypatch.setattr(
        "qs3.report.scans.write_sheets", lambda path, tiles: drawn.extend(tiles) or [path]
    )
    monkeypatch.setattr("qs3.cli.predict.show", lambda *_: None)
    blocks = place / "scans" / "block"
    typed("predict", run, blocks, "--pictures", tmp_path / "poses")
    assert len(drawn) == 3
    for tile in drawn:
        assert len(tile.edges) == 12  # of a box
        low, high = tile.points.min(axis=0), tile.points.max(axis=0)
        ends = tile.edges.reshape(-1, 3)
        assert ends.min(axis=0)[:2] == pytest.approx(low[:2], abs=0.004)
        assert ends.max(axis=0) == pytest.approx(high, abs=0.004)
    words = ("--no-pose", "--pictures", tmp_path / "poses")
    assert "needs the pose" in typed.refuses("predict", run, blocks, *words)


def test_locate_takes_a_run_and_a_kept_library_for_the_cad(typed, place, run, tmp_path):
    scans, kept = place / "scans" / "rod", tmp_path / "kept.safetensors"
    typed("locate", place / "cad", scans, "--library", kept, "--csv", tmp_path / "cad.csv")
    for cad in (kept, run):
        typed("locate", cad, scans, "--csv", tmp_path / "other.csv")
        assert (tmp_path / "other.csv").read_text() == (tmp_path / "cad.csv").read_text()
        assert "leave --classes and --units out" in typed.refuses(
            "locate", cad, scans, "--units", "mm"
        )


def test_locate_takes_no_data_set_for_one_scan(typed, place, tmp_path):
    typed("convert", place / "scans", tmp_path / "six.npz", "--to", "npz")
    assert "six.npz: is a data set" in typed.refuses("locate", place / "cad", tmp_path / "six.npz")


def test_the_report_shows_names_that_are_not_utf8(typed, place, run, tmp_path):
    (tmp_path / "scans").mkdir()
    odd = os.fsdecode(os.fsencode(tmp_path / "scans") + b"/\xff.npy")
    try:
        shutil.copy(place / "scans" / "rod" / "rod-0.npy", odd)
    except OSError:
        pytest.skip("this file system has UTF-8 names alone")
    typed("report", run, "--scans", tmp_path / "scans", "--out", tmp_path / "page.html")
    for page in ("page.html", "parts.html"):
        assert r"\udcff.npy" in (tmp_path / page).read_text("utf-8")


@pytest.mark.parametrize("verb", ["predict", "locate"])
def test_what_is_answered_before_ctrl_c_stays(typed, place, run, tmp_path, monkeypatch, verb):
    """Printed and in the tables; a table of an earlier call stays as it is."""
    words = (verb, run, place / "scans" / "rod", "--csv", tmp_path / "a.csv", "--json")
    whole = typed(*words, tmp_path / "a.json").stdout.splitlines()
    before, compare, calls = (tmp_path / "a.csv").read_text(), witness.compare, []

    def stopped(*scan):
        calls.append(scan)
        if len(calls) == 3:
            raise KeyboardInterrupt
        return compare(*scan)

    for module in (witness, locate_files):
        monkeypatch.setattr(module, "compare", stopped)
    done = typed(*words, tmp_path / "b.json", code=130)
    assert done.stdout.splitlines() == whole[:2]
    rows = json.loads((tmp_path / "a.json").read_text())
    assert json.loads((tmp_path / "b.json").read_text()) == rows[:2]
    assert (tmp_path / "a.csv").read_text() == before
    calls[:] = [None, None]
    assert typed(*words, tmp_path / "c.json", code=130).stdout == ""
    assert not (tmp_path / "c.json").exists()


@pytest.mark.parametrize("verb", ["predict", "locate"])
def test_a_lost_scan_has_no_pose_in_any_table(typed, place, run, tmp_path, verb):
    wall, tables = tmp_path / "wall.npy", (tmp_path / "a.csv", tmp_path / "a.json")
    np.save(wall, np.random.default_rng(0).random((500, 3)) * [0.08, 0.07, 0.001])
    known = place / "scans" / "rod" / "rod-0.npy"
    words = (run,) if verb == "predict" else (place / "cad", "--units", "mm")
    typed(verb, *words, "--csv", tables[0], "--json", tables[1], wall, known)
    entries = json.loads(tables[1].read_text())
    rows = list(csv.DictReader(tables[0].read_text().splitlines()))
    for entry, row, lost in zip(entries, rows, (True, False), strict=True):
        assert entry["lost"] is lost and row["lost"] == str(lost).lower()
        assert (entry["pose"] is None) is lost
        assert (row["rotation"] == row["translation"] == "") is lost
        if not lost:
            pose = np.array(entry["pose"])
            for name, values in (("rotation", pose[:3, :3]), ("translation", pose[:3, 3])):
                written = [float(word) for word in row[name].split()]
                assert written == pytest.approx(values.ravel(), abs=1e-6)
        assert {"lost", "pose", "cad"} <= {*entry["candidates"][0]}
        assert any(not one["lost"] for one in entry["candidates"]) is not lost
        assert next(iter(entry)) == "file"
    if verb == "predict":
        assert [one.pose is None for one in Classifier.load(run).answers([wall, known])] == [
            True, False,
        ]  # fmt: skip


def test_an_unknown_keeps_its_confidence_and_has_a_familiarity(typed, place, run, tmp_path):
    np.save(tmp_path / "wall.npy", np.random.default_rng(0).random((500, 3)) * [0.2, 0.001, 0.1])
    answered = typed("predict", run, tmp_path / "wall.npy", "--unknown", 0.2)
    plain = typed("predict", run, tmp_path / "wall.npy").stdout.split()
    _, name, confidence, familiarity, *_, last = answered.stdout.strip().split("\t")
    assert (name, confidence) == ("unknown", plain[2])
    assert re.fullmatch(r"familiarity 0\.[01]\d\d", familiarity)
    assert last == "lost"


def test_a_run_without_cad_has_no_pose(typed, place, tmp_path):
    typed("train", "--model", "forest", "--source", place / "source", "--out", tmp_path / "bare")
    words = (place / "scans", "--json", "-")
    answers = json.loads(typed("predict", tmp_path / "bare", *words).stdout)
    assert not any({"pose", "cad", "lost"} & {*answer} for answer in answers)


def test_the_cad_joins_what_is_unknown(typed, place, run, tmp_path):
    """A bar as long and wide as the rod is unknown with and without; the parts stay known."""
    bar = trimesh.creation.box((0.02, 0.02, 0.08))
    points, faces = bar.sample(2400, return_index=True, seed=0)
    np.save(tmp_path / "bar.npy", points[bar.face_normals[faces] @ CAMERA > 0.1])
    shares = []
    for options in (["--no-pose"], []):
        words = (tmp_path / "bar.npy", place / "scans", "--unknown", 0.02, *options)
        typed("predict", run, *words, "--csv", tmp_path / "answers.csv")
        rows = list(csv.DictReader((tmp_path / "answers.csv").read_text("utf-8").splitlines()))
        shares.append([float(row["familiarity"]) for row in rows])
        known = [row["class"] != "unknown" for row in rows if row["file"] != str(words[0])]
        assert np.mean(known) > 0.8
        assert shares[-1][0] < 0.02
    assert shares[0][1:] != shares[1][1:]


def test_the_cad_is_a_setting_of_the_run(typed, place, run, tmp_path):
    """Its content is, and not the folder that holds it."""
    words = ("train", "--model", "forest", "--source", place / "source", "--out", run, "--dry-run")
    cad = shutil.copytree(place / "cad", tmp_path / "renamed")
    typed(*words, "--meshes", cad, "--units", "mm")
    (cad / "rod" / "rod.stl").write_bytes((cad / "block" / "block.stl").read_bytes())
    line = typed.refuses(*words, "--meshes", cad, "--units", "mm")
    assert "holds a run with another --meshes (files, their names or units differ)" in line
    assert "holds a run that was begun with --meshes" in typed.refuses(*words)
    without = shutil.copytree(run, tmp_path / "without")
    (without / "library.safetensors").unlink()
    assert "its CAD is missing" in typed.refuses("predict", without, place / "scans")


def test_cad_that_another_version_left_does_not_answer(typed, place, run, tmp_path):
    old = shutil.copytree(run, tmp_path / "old")
    settings = json.loads((old / "settings.json").read_text())
    del settings["cad"]
    (old / "settings.json").write_text(json.dumps(settings))
    typed("train", "--model", "forest", "--source", place / "source", "--out", old)
    assert not [*old.glob("library*"), *old.glob("witness*")]


def test_a_run_is_finished_and_free_once_its_cad_is_written(typed, place, tmp_path, monkeypatch):
    out, faults = tmp_path / "run", []

    def stopped(*_):
        try:
            with claim_run(out, _settings(out)):
                pytest.fail("the folder is free")
        except InputError as error:
            faults.append(str(error))
        raise KeyboardInterrupt

    words = ("train", "--model", "forest", "--source", place / "source", "--units", "mm")
    words += ("--meshes", place / "cad", "--out", out)
    with monkeypatch.context() as patch:
        patch.setattr("qs3.workflow.training.calibrate", stopped)
        typed(*words, code=130)
    assert "another qs3 is writing" in faults[0]
    with pytest.raises(InputError, match="the run is not finished"):
        read_run(out)
    with pytest.raises(InputError):
        Classifier.load(out)
    typed(*words)
    assert Classifier.load(out)._loaded.witness is not None


@pytest.mark.parametrize("damage", ["nan", "missing", "order", "weight", "library", "class"])
def test_damaged_cad_is_refused(typed, place, run, tmp_path, damage):
    shutil.copytree(run, tmp_path / "run")
    file = tmp_path / "run" / ("library" if damage in ("library", "class") else "witness")
    file = file.with_suffix(".safetensors")
    arrays = safetensors.numpy.load_file(file)
    with safetensors.safe_open(file, framework="numpy") as handle:
        facts = json.loads(handle.metadata()["qs3"])
    if damage == "nan":
        arrays["edges/0"][0] = np.nan
    elif damage == "order":
        facts["fusion"]["misfits"].reverse()
    elif damage == "weight":
        facts["fusion"]["witness"] = -1.0
    elif damage == "library":
        arrays["0/points"][0] = np.nan
    elif damage == "class":
        facts["parts"][0]["class_name"] = "bolt"
    else:
        del arrays["edges/1"]
    safetensors.numpy.save_file(arrays, file, {"qs3": json.dumps(facts)})
    fault = typed.refuses("predict", tmp_path / "run", place / "scans")
    assert file.name in fault


def test_labels_are_found_below_the_target(typed, place, tmp_path):
    with (tmp_path / "labels.csv").open("w", newline="") as file:
        csv.writer(file).writerows([["file", "class"], ["rod/rod-0.npy", "rod"]])
    command = ("train", "--model", "forest", "--source", place / "source", "--out", tmp_path / "r")
    labelled = ("--target", place / "scans", "--labels", tmp_path / "labels.csv")
    assert "few-label: learnt from 1 labelled scans" in typed(*command, *labelled).stderr


def test_a_network_learns_from_labels_by_a_head(typed, place, tmp_path):
    """The record has a name of its own, and prediction takes the run."""
    network, few = tmp_path / "network", tmp_path / "few"
    small = ("--model", "pointnet", "--model-set", "channels=[8, 8, 16]", "hidden=[8]",
             "transforms=false", "--num-points", 64, "--epochs", 2, "--threads", 1,
             "--metric-unit", 0.05, "--align")  # fmt: skip
    typed("train", "--source", place / "source", *small, "--out", network)
    (tmp_path / "labels.csv").write_text("file,class\nrod/rod-0.npy,rod\nblock/block-1.npy,block\n")
    words = ("train", "--warm-up", network, "--labels", tmp_path / "labels.csv",
             "--target", place / "scans")  # fmt: skip
    assert "few-label-head: learnt from 2 labelled scans" in typed(*words, "--out", few).stderr
    record = json.loads(typed("evaluate", few, "--data", place / "scans", "--json").stdout)
    assert record["method"] == "few-label-head"
    assert record["marks"] == ["training clouds"]
    typed("predict", few, place / "scans", "--csv", tmp_path / "answers.csv")
    assert "stays as it is" in typed.refuses(*words, "--epochs", 3, "--out", tmp_path / "no")
    other = typed.refuses(*words, "--source", place / "source", "--out", tmp_path / "no")
    assert "leave out --source" in other
    assert "a head on" in typed(*words, "--dry-run").stdout


def test_adapt_goes_the_whole_way(typed, place, tmp_path, monkeypatch):
    """Each step prints a command; a fault of single scans stops no later step."""
    monkeypatch.setattr("qs3.workflow.adapt.generate", generate_quickly)
    words = ("adapt", place / "cad", place / "scans", "--units", "mm", "--camera", "d415",
             "--seed", 3)  # fmt: skip
    mine = tmp_path / "mine"
    done = typed(*words, "--out", mine)
    printed = [line.split()[1] for line in done.stderr.splitlines() if line.startswith("qs3 ")]
    assert printed == ["meshes", "generate", "train", "predict", "report"]
    assert "9 scans: " in done.stderr
    answers = list(csv.DictReader((mine / "answers.csv").read_text().splitlines()))
    assert sum(row["class"] in row["file"] for row in answers) == 9
    with Image.open(mine / "contact-sheet.png"), Image.open(mine / "poses" / "poses.png"):
        pass
    assert (mine / "report.html").is_file()
    (place / "cad" / "rod" / "broken.stl").write_text("solid broken")
    words = ("adapt", place / "cad", place / "scans" / "rod", *words[3:])
    try:
        done = typed(*words, "--out", tmp_path / "broken", code=2)
    finally:
        (place / "cad" / "rod" / "broken.stl").unlink()
    (line,) = [line for line in done.stderr.splitlines() if line.startswith("10 scans failed")]
    assert "rod/broken#0" in line
    assert Classifier.load(tmp_path / "broken" / "run").class_names == tuple(PARTS)
    assert done.stderr.endswith("repair the file and name a new --out\n")
    assert "rod" in done.stdout
    assert "rod-0.npy" not in done.stdout  # a summary, and no line per scan
    assert (tmp_path / "broken" / "report.html").is_file()


def test_the_printed_report_makes_the_page_of_learnt_labels_again(
    typed, place, tmp_path, monkeypatch
):
    """The run keeps them: a page without would save new labels alone, and lose these."""
    monkeypatch.setattr("qs3.workflow.adapt.generate", generate_quickly)
    scans, out = tmp_path / "scans", tmp_path / "out"
    shutil.copytree(place / "scans", scans)
    (scans / "rod" / "rod-0.npy").rename(scans / "rod" / "caf\udce9 \u0645.npy")
    rows = ["rod/caf\\udce9 \u0645.npy,rod", "block/block-1.npy,block"]
    (tmp_path / "labels.csv").write_text("\n".join(["file,class", *rows]), "utf-8")
    words = ("--units", "mm", "--labels", tmp_path / "labels.csv", "--out", out)
    typed("adapt", place / "cad", scans, *words)
    page = (out / "parts.html").read_bytes()
    assert page.count(b"<option selected>") == 2
    (out / "parts.html").unlink()
    # They are names below the folder of the scans, which may move.
    scans.rename(tmp_path / "moved")
    words = ("--scans", tmp_path / "moved", "--out", out / "report.html")
    typed("report", out / "run-labelled", *words)
    assert (out / "parts.html").read_bytes() == page
    assert str(tmp_path) not in (out / "run-labelled" / "learnt.json").read_text("utf-8")


def test_adapt_refuses_what_cannot_be_before_a_scan(typed, place, tmp_path, monkeypatch):
    def scanned(*_, **__):
        pytest.fail("was scanned")

    monkeypatch.setattr("qs3.workflow.adapt.generate", scanned)
    mine, scans = tmp_path / "mine", place / "scans"
    other = ("--units", "mm", "--out", tmp_path / "other")
    assert "no such folder" in typed.refuses("adapt", tmp_path / "none", scans, *other)
    line = typed.refuses("adapt", place / "cad", scans, *other, "--camera", "d345")
    assert "no sensor 'd345'" in line
    assert not (tmp_path / "other").exists()
    files = [f"{path},{path.parent.name}" for path in scans.glob("*/*.npy")]
    (tmp_path / "labels.csv").write_text("\n".join(["file,class", *files]))
    words = ("adapt", place / "cad", scans, "--units", "mm", "--out", mine)
    done = typed(*words, "--method", "qbst", "--labels", tmp_path / "labels.csv", code=2)
    assert "labels.csv: labels every scan" in done.stderr
    (mine / "run").mkdir()
    (mine / "run" / "thesis.txt").touch()
    assert "run: holds something else" in typed(*words, code=2).stderr


NAMES = {
    "Persian": "\u0645\u06cc\u200c\u062e\u06481",
    "Hindi": "\u0915\u094d\u200d\u0937",
    "family": "\U0001f468\u200d\U0001f469\u200d\U0001f467",
    "flag": "\U0001f3f4\U000e0067\U000e007f",
    "direction": "a\u200eb\u202ec",
    "soft hyphen": "a\u00adb",
    "line": "a\nb\tc",
    "next line": "a\x85b\u2028c",
    "bytes": "caf\udce9",
    "decomposed": unicodedata.normalize("NFD", "Gr\u00f6\u00dfe"),
    "formula": "-a",
    "apostrophe": "'-a",
    "space": " =a ",
    "escape": r"a\u200db",
}


def test_any_file_name_survives_from_suggestion_to_label(typed, place, run, tmp_path):
    (tmp_path / "scans").mkdir()
    scans = sorted(place.glob("scans/*/*.npy"))
    files = [tmp_path / "scans" / f"{name}.npy" for name in NAMES.values()]
    for row, file in enumerate(files):
        shutil.copy(scans[row % 9], file)
    table = tmp_path / "labels.csv"
    typed("suggest", run, tmp_path / "scans", "-n", len(files), "--out", table)
    text = table.read_text("utf-8")
    assert NAMES["Persian"] in text and NAMES["family"] in text  # as their writers know them
    assert not {"\u200e", "\u202e", "\x85"} & {*text}  # turns and breaks are escaped
    rows = list(csv.DictReader(text.splitlines()))
    for is_whole, beside in ((True, False), (False, True)):
        with table.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, rows[0])
            writer.writeheader()
            for row in rows:
                name = (
                    row["file"] if is_whole else cell(row["file"].replace(f"{tmp_path}/scans/", ""))
                )
                writer.writerow(row | {"file": name, "class": row["suggested"]})
        read = read_labels(table, [*PARTS], tmp_path / "scans" if beside else None)
        assert sorted(read.ids) == sorted(map(str, files))


def test_suggested_scans_can_be_labelled_and_learnt_from(typed, place, run, tmp_path):
    table = tmp_path / "labels.csv"
    typed("suggest", run, place / "scans", "-n", 4, "--out", table)
    rows = list(csv.DictReader(table.read_text().splitlines()))
    assert len({row["file"] for row in rows}) == 4
    assert {row["suggested"] for row in rows} == {*PARTS}  # spread over the classes
    assert {row["class"] for row in rows} == {""}
    assert [row["number"] for row in rows] == ["1", "2", "3", "4"]
    with Image.open(table.with_suffix(".png")) as sheet:
        assert sheet.width > 1000
    assert "may hold labels" in typed.refuses("suggest", run, place / "scans", "--out", table)
    with table.open("w", newline="") as file:
        writer = csv.DictWriter(file, rows[0])
        writer.writeheader()
        writer.writerows(row | {"class": row["suggested"]} for row in rows[:3])
    command = ("train", "--model", "forest", "--source", place / "source", "--labels", table)
    assert "learnt from 3 labelled" in typed(*command, "--out", tmp_path / "few").stderr
    more, labelled = tmp_path / "more.csv", {row["file"] for row in rows[:3]}
    scans = len([*place.glob("scans/*/*.npy")])
    typed("suggest", tmp_path / "few", place / "scans", "-n", scans, "--out", more)
    found = {row["file"] for row in csv.DictReader(more.read_text().splitlines())}
    assert len(found) == scans - 3 and not found & labelled
    words = ("suggest", tmp_path / "few", *sorted(labelled), "--out", tmp_path / "none.csv")
    assert "has learnt from each of these scans" in typed.refuses(*words)


def test_suggestions_are_drawn_as_the_sheets_of_poses_are(typed, place, run, tmp_path, monkeypatch):
    drawn, rods = [], place / "scans" / "rod"
    sheet = lambda tiles: drawn.append(tiles) or Figure()  # noqa: E731
    monkeypatch.setattr("qs3.report.scans.scan_sheet", sheet)
    typed("suggest", run, rods, "-n", 3, "--out", tmp_path / "labels.csv")
    typed("predict", run, rods, "--pictures", tmp_path / "poses")
    picked, poses = (sorted(tiles, key=lambda tile: tile.points.tolist()) for tiles in drawn)
    for one, other in zip(picked, poses, strict=True):
        assert re.match(r"[123]: rod\? \([01]\.\d\d\)", one.caption)
        for name in ("points", "edges", "camera", "lost", "turn"):
            assert np.array_equal(getattr(one, name), getattr(other, name)), name


def test_a_new_table_of_suggestions_keeps_no_picture_of_the_last(
    typed, place, run, tmp_path, monkeypatch
):
    monkeypatch.setattr("qs3.report.scans._A_PAGE", 1)
    words = ("suggest", run, place / "scans", "-n")
    typed(*words, 2, "--out", tmp_path / "labels-2.csv")
    typed(*words, 4, "--out", tmp_path / "labels.csv")
    (tmp_path / "labels.csv").unlink()
    others = {"labels-1.png", "labels-02.png"}  # no page has such a name
    for name in others:
        shutil.copy(tmp_path / "labels.png", tmp_path / name)
    typed(*words, 1, "--out", tmp_path / "labels.csv")
    wanted = {"labels.csv", "labels.png", "labels-2.csv", "labels-2.png", "labels-2-2.png", *others}
    assert {path.name for path in tmp_path.iterdir()} == wanted


def test_a_map_renames_the_cad_as_it_renames_the_source(typed, place, tmp_path):
    (tmp_path / "map.toml").write_text('block = "brick"\n')
    words = ["train", "--model", "forest", "--source", place / "source", "--units", "mm"]
    words += ["--meshes", place / "cad", "--map", tmp_path / "map.toml"]
    typed(*words, "--out", tmp_path / "run")
    answers = typed("predict", tmp_path / "run", place / "scans" / "block", "--json", "-").stdout
    assert {(each["class"], each["cad"]) for each in json.loads(answers)} == {
        ("brick", "block/block")
    }


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--csv", "-"), "--csv -: --json alone prints"),
        (("--csv", "labels.csv"), "holds no answers, but maybe labels, a camera or a run"),
    ],
)
@pytest.mark.parametrize("verb", ["predict", "locate"])
def test_answers_replace_nothing_but_answers(
    typed, place, run, verb, words, message, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    held = {"labels.csv": "file,class\na.ply,rod\n"}
    (tmp_path / "labels.csv").write_text(held["labels.csv"])
    cad = run if verb == "predict" else place / "cad"
    assert message in typed.refuses(verb, cad, place / "scans" / "rod", *words)
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == held


def test_a_library_that_cannot_be_kept_is_refused_at_once(typed, place, tmp_path, monkeypatch):
    monkeypatch.setattr("qs3.parts.library.look_at", lambda *_: pytest.fail("has begun"))
    (tmp_path / "file").touch()
    (tmp_path / "loop").symlink_to("loop")
    words = ("locate", place / "cad", place / "scans" / "rod", "--library")
    assert "a link that leads back to itself" in typed.refuses(*words, tmp_path / "loop")
    assert "name another file" in typed.refuses(*words, tmp_path / "file" / "a.safetensors")
    for name in ("lib.txt", "lib", "file"):
        assert "name a file that ends in .safetensors" in typed.refuses(*words, tmp_path / name)


def test_answers_replace_answers(typed, place, run, tmp_path):
    scans, outs = (
        place / "scans" / "rod",
        ("--csv", tmp_path / "a.csv", "--json", tmp_path / "a.json"),
    )
    for words in (("predict", run, scans, "--no-pose"), ("locate", place / "cad", scans)) * 2:
        typed(*words, *outs)
    assert len(json.loads((tmp_path / "a.json").read_text())) == 3
