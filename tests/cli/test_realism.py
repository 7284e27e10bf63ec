"""``qs3 realism`` on a small camera: the command itself, in this process but for the killed one."""

import functools
import json
import signal
import subprocess
import sys
import time

import pytest

# The D435's optics on a small chip: what is far is still measured, and a test takes a second.
SMALL = """
base = "d435"
name = "small"

[rig]
width = 200
height = 150
focal = 215.0

[matching]
num_disparities = 32
block_size = 15

[depth]
near = 0.5
far = 3.0
"""
FAST = ("--quick", "--variant", "scalar_rgb", "--samples", "1")


@pytest.fixture(scope="module")
def camera(tmp_path_factory):
    path = tmp_path_factory.mktemp("camera") / "small.toml"
    path.write_text(SMALL)
    return path


@pytest.fixture
def realism(typed):
    return functools.partial(typed, "realism")


@pytest.fixture
def refused(typed):
    return functools.partial(typed.refuses, "realism")


@pytest.fixture(scope="module")
def first(qs3, camera, tmp_path_factory):
    """A run of two tests, in a process of its own: its folder and what it said."""
    folder = tmp_path_factory.mktemp("realism") / "small"
    done = qs3("realism", "--sensor", camera, "--out", folder, "--tests", "t3", "T1", *FAST)
    return folder, done


def record(folder):
    return json.loads((folder / "realism.json").read_text())


def test_table_record_and_plots(first):
    folder, done = first
    made = record(folder)
    assert made["sensor"]["name"] == "small"
    assert made["renderer"]["samples"] == 1
    assert made["settings"] == {"quick": True, "seed": 0}
    assert made["versions"]
    assert [test["id"] for test in made["tests"]] == ["T1", "T3"]
    lines = done.stdout.splitlines()
    assert lines[0].split() == ["test", "what", "measured", "expected"]
    for test in made["tests"]:
        mine = next(line for line in lines if line.startswith(f"{test['id']} "))
        assert test["title"] in mine
        assert mine.endswith({True: "pass", False: "MISS", None: "does not apply"}[test["passed"]])
        for row in test["rows"]:
            assert any(row["what"] in line and row["expected"] in line for line in lines)
    pictures = sorted(path.name for path in folder.glob("*.png"))
    assert pictures == ["rms.png"]
    assert all((folder / name).read_bytes()[1:4] == b"PNG" for name in pictures)
    last = done.stderr.strip().splitlines()[-1]
    assert str(folder / "rms.png") in last
    assert "fill.png (T6 was not asked)" in done.stderr
    assert not [path for path in folder.iterdir() if ".tmp" in path.name]


def test_the_same_command_goes_on_and_others_add(realism, camera, first):
    folder, before = first
    old = record(folder)
    older = json.loads((folder / "realism.json").read_text())  # begun before these were added
    del older["renderer"]["cache_rays"], older["sensor"]["matching"]["bias_correction"]
    (folder / "realism.json").write_text(json.dumps(older))
    again = realism("--sensor", camera, "--out", folder, "--tests", "T1", "T3", *FAST)
    assert record(folder) == old  # seconds and all: nothing was measured anew
    assert again.stdout == before.stdout
    assert again.stderr.count("done before") == 2
    (folder / "rms.png").unlink()
    realism("--sensor", camera, "--out", folder, "--tests", "T9", "T1", *FAST)
    assert (folder / "rms.png").is_file()
    tests = record(folder)["tests"]
    assert [test["id"] for test in tests] == ["T1", "T3", "T9"]
    assert tests[:2] == old["tests"]


def test_other_settings_do_not_mix(refused, camera, first, tmp_path):
    folder, _ = first
    old = (folder / "realism.json").read_bytes()
    common = ("--sensor", camera, "--out", folder, "--tests", "T1")
    line = refused(*common, *FAST, "--seed", 3)
    assert "settings.seed was 0, is 3" in line
    line = refused(*common, *FAST, "--matching", "opencv-bm")
    assert "sensor.matching.method was ad-census, is opencv-bm" in line
    assert (folder / "realism.json").read_bytes() == old
    other = tmp_path / "other"
    other.mkdir()
    (other / "thesis.tex").write_text("x")
    assert "holds something else" in refused(*common[:3], other, *FAST)
    (other / "realism.json").write_text("{")
    assert "realism.json" in refused(*common[:3], other, *FAST)
    (other / "realism.json").write_text("[]")
    assert "not a record" in refused(*common[:3], other, *FAST)


def test_strict_ends_with_one_where_a_test_misses(realism, camera, first):
    """Verdicts are those of the record: once of a miss, once of a pass."""
    folder, _ = first
    path = folder / "realism.json"
    kept = path.read_text()
    try:
        for passed in (False, True):
            made = json.loads(kept)
            next(test for test in made["tests"] if test["id"] == "T3")["passed"] = passed
            path.write_text(json.dumps(made))
            common = ("--sensor", camera, "--out", folder, "--tests", "T3", *FAST)
            realism(*common)
            realism(*common, "--strict", code=0 if passed else 1)
    finally:
        path.write_text(kept)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--tests", "T1", "T11"), "T11"),
        (("--seed", -1), "seed"),
        (("--samples", 0), "samples"),
        (("--sensor", "d345"), "d435"),
    ],
)
def test_faults_are_one_line_and_leave_nothing(refused, tmp_path, arguments, named):
    out = tmp_path / "out"
    assert named in refused("--out", out, *arguments)
    assert not out.exists()


def test_a_killed_run_leaves_a_record_that_goes_on(realism, camera, tmp_path):
    folder = tmp_path / "killed"
    common = ("--sensor", camera, "--out", folder, *FAST, "--tests", "T3", "T4", "T9")
    running = subprocess.Popen(
        [sys.executable, "-m", "qs3", "realism", *map(str, common)],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    try:
        for _ in range(600):
            if (folder / "realism.json").is_file() and record(folder)["tests"]:
                break
            time.sleep(0.05)
    finally:
        running.send_signal(signal.SIGKILL)
        running.wait()
    before = record(folder)["tests"]
    assert before
    realism(*common)
    after = record(folder)["tests"]
    assert [test["id"] for test in after] == ["T3", "T4", "T9"]
    assert after[: len(before)] == before
