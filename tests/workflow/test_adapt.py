"""CAD of parts and unlabelled scans in, a classifier out, in one call."""

import json
import shlex
import subprocess
import sys
from itertools import takewhile
from pathlib import Path

import numpy as np
import pytest
import trimesh

import qs3
from qs3.clouds.load import load_clouds
from qs3.errors import InputError
from qs3.files import read_json
from qs3.runs import read_run
from qs3.workflow import adapt as module
from qs3.workflow.options import AdaptOptions

from .conftest import PARTS, write_cad


@pytest.fixture
def cad(tmp_path):
    return write_cad(tmp_path / "cad")


def scan(name, seed, count=900):
    """The sides of a part that one camera sees, in metres, turned about z."""
    points, faces = PARTS[name].sample(3000, return_index=True, seed=seed)
    seen = points[PARTS[name].face_normals[faces] @ (0.4, 0.2, 0.9) > 0.1][:count] / 1000
    seen += np.random.default_rng(seed).normal(0, 0.0003, seen.shape)
    turn = trimesh.transformations.rotation_matrix(seed, (0, 0, 1))
    return trimesh.transform_points(seen, turn).astype(np.float32)


NAMES = [name for name in PARTS for _ in range(3)]


@pytest.fixture
def scans():
    return [scan(name, seed, 700 + 10 * seed) for seed, name in enumerate(NAMES)]


def test_three_lines(cad, scans, tmp_path):
    model = qs3.adapt(cad, scans, tmp_path / "out", units="mm", method="qbst")
    new = [scan(name, 100) for name in PARTS]
    assert model.predict(new).tolist() == [*PARTS]
    model.save(tmp_path / "mine")
    again = qs3.load(tmp_path / "mine")
    assert np.array_equal(again.predict_proba(new), model.predict_proba(new))
    run = read_run(tmp_path / "out" / "run")
    assert run.method == "qbst"
    assert sum(run.rounds[0]["kept"]) > 0
    assert model.answers(new)[0].pose.shape == (4, 4)


def test_parts_named_like_furniture_are_the_only_classes(cad, scans, tmp_path):
    for name, other in {"block": "chair", "rod": "table"}.items():
        (cad / f"{name}.stl").rename(cad / f"{other}.stl")
    (cad / "wedge.stl").unlink()
    model = qs3.adapt(cad, scans[:6], tmp_path / "out", units="mm")
    assert model.class_names == ("chair", "table")
    assert model.predict([scan("block", 100), scan("rod", 100)]).tolist() == ["chair", "table"]
    kept = load_clouds(tmp_path / "out" / "source", num_points=None)
    assert kept.class_names == ("chair", "table")


def steps_before(verb, cad, scans, out, **options):
    """Go the way for own parts up to a step."""
    steps = module.steps(cad, scans, out, AdaptOptions(units="mm", **options))
    return [*takewhile(lambda step: step.verb != verb, steps)]


def test_poisoned_labels_of_the_scans_change_no_bit(cad, tmp_path):
    """As a file with true or wrong labels, and as clouds that carry them."""
    forests, points = set(), np.stack([scan(name, seed) for seed, name in enumerate(NAMES)])
    labels = np.array([[*PARTS].index(name) for name in NAMES])
    names = np.array([*PARTS])
    files = [tmp_path / "right" / "scans.npz", tmp_path / "wrong" / "scans.npz"]
    for shift, file in enumerate(files):
        file.parent.mkdir()
        np.savez(file, points=points, label=(labels + shift) % 3, class_names=names)
    for out, scans in enumerate((*files, load_clouds(files[1], num_points=None))):
        steps_before("predict", cad, scans, tmp_path / str(out), method="qbst")
        forests.add((tmp_path / str(out) / "run" / "forest.safetensors").read_bytes())
    assert len(forests) == 1


def test_printed_commands_repeat_their_steps(cad, scans, tmp_path, capfd):
    from qs3.cli import run

    lines, out = [], tmp_path / "out"
    (tmp_path / "labels.csv").write_text("file,class\n000000.ply,block\n", "utf-8")
    options = {"units": "mm", "camera": "d415", "seed": 3, "workers": 0}
    qs3.adapt(cad, scans[::2], out, labels=tmp_path / "labels.csv", say=lines.append, **options)
    assert any("This says nothing about real scans" in line for line in lines)
    commands = [shlex.split(line)[1:] for line in lines if line.startswith("qs3 ")]
    assert [words[0] for words in commands] == ["meshes", "generate", "train", "predict"]
    files = (out / "run-labelled" / "forest.safetensors", out / "answers.csv")
    before = [file.read_bytes() for file in files]
    for words in commands:
        assert run(words) == 0
    assert "0 scans written, 30 were there before" in capfd.readouterr().err
    assert [file.read_bytes() for file in files] == before
    assert read_run(out / "run-labelled").method == "few-label"
    assert not (out / "run").exists()


def test_scans_are_made_like_yours_unless_told_otherwise(cad, scans, tmp_path):
    """With as many points, and from where the camera stood if the scans record it."""
    place = tmp_path / "like" / "scans"
    (line,) = steps_before("train", cad, scans, place.parent)[0].lines
    assert "9 scans: " in line
    assert "do not record where the camera stood" in line
    # The 95 % quantile of 700, 710 … 780.
    assert made_like(tmp_path / "like") == (776, [0.35, 0.8], [35.0, 80.0])
    rows = [f"{file.name},0.5,60" for file in sorted(place.glob("*.ply"))]
    (place / "objects.csv").write_text("\n".join(["file,distance,elevation", *rows]), "utf-8")
    for name, like in (("recorded", True), ("unlike", False)):
        steps_before("train", cad, place, tmp_path / name, like=like)
    assert made_like(tmp_path / "recorded") == (776, [0.5, 0.5], [60.0, 60.0])
    record = json.loads((tmp_path / "recorded" / "source" / "dataset.json").read_text("utf-8"))
    cut = record["settings"]["table_cut"]
    assert 0 <= cut[0] <= cut[1] and [float(f"{height:g}") for height in cut] == cut  # as printed
    assert made_like(tmp_path / "unlike") == (4096, [0.35, 0.8], [35.0, 80.0])


def made_like(folder):
    settings = read_json(folder / "source" / "dataset.json")["settings"]
    place = settings["sensor"]["placement"]
    return settings["num_points"], place["radius"], place["elevation"]


def test_faults_come_before_a_scan(cad, scans, tmp_path):
    out = tmp_path / "out"
    with pytest.raises(InputError, match="give a folder, paths, or several clouds"):
        qs3.adapt(cad, [], out)
    with pytest.raises(InputError, match="absent: no such file"):
        qs3.adapt(cad, tmp_path / "absent", out)
    with pytest.raises(InputError, match="are they in millimetres"):
        qs3.adapt(cad, [1000 * points for points in scans], out)
    (tmp_path / "labels.csv").write_text("file,class\n000000.ply,blok\n", "utf-8")
    with pytest.raises(InputError, match="unknown class 'blok'"):
        qs3.adapt(cad, scans, out, units="mm", labels=tmp_path / "labels.csv")
    with pytest.raises(InputError, match=r"kinnect"):
        qs3.adapt(cad, scans, out, units="mm", camera="kinnect")
    with pytest.raises(InputError, match=r"holds scans of another call \(000008\.ply\)"):
        qs3.adapt(cad, scans[:8], out, units="mm")
    assert not (out / "source").exists()
    # In its own process: the tests check types.
    call = "import qs3; qs3.adapt('cad', 'scans', method='gast')"
    done = subprocess.run([sys.executable, "-c", call], capture_output=True, text=True)
    assert "InputError: adapt: field 'method': 'gast' must be one of qbst" in done.stderr


def test_options_are_taken_as_python_and_numpy_have_them(monkeypatch):
    def seen(cad, scans, out, chosen):
        raise LookupError(chosen)

    monkeypatch.setattr(module, "steps", seen)
    options = {"camera": Path("mine.toml"), "seed": np.int64(3), "labels": "labels.csv"}
    options |= {"distance": np.array([0.4, 1]), "elevation": [40, 60], "unknown": np.float32(0.5)}
    with pytest.raises(LookupError) as caught:
        qs3.adapt("cad", "scans", **options)
    assert caught.value.args[0] == AdaptOptions(
        camera="mine.toml", seed=3, labels=Path("labels.csv"), distance=(0.4, 1.0),
        elevation=(40.0, 60.0), unknown=0.5,
    )  # fmt: skip
    with pytest.raises(InputError, match=r"seed 4294967296 must be .* at most 4294967295"):
        qs3.adapt("cad", "scans", seed=2**32)
    for name, value in {"seed": 3.0, "camera": 435, "like": "no", "workers": True}.items():
        with pytest.raises(InputError, match=f"adapt: field '{name}': .* is not "):
            qs3.adapt("cad", "scans", **{name: value})
