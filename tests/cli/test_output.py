"""What the command prints, whatever names say, however its streams are set."""

import contextlib
import errno
import logging
import os
import re
import subprocess
import sys
import warnings
from pathlib import Path

import numpy as np
import pytest

from qs3 import cli
from qs3.cli import main
from qs3.cli.answer_files import AnswerFiles
from qs3.cli.evaluate import _scores
from qs3.cli.text import columns, notify, prepare_streams, printable, quoted, raise_last, show
from qs3.errors import InputError
from qs3.evaluation.records import score
from qs3.frames.cameras import DepthFrame
from qs3.frames.intrinsics import Intrinsics
from qs3.store.bars import progress_bar
from qs3.workflow import watch as watching
from qs3.workflow.options import command, options

HOSTILE = "a\x1b[2J\x9b31m\r\n\u202eb"


def run(redirection="", **environment):
    """`qs3 sensors` in a shell: what it prints is not ASCII, on both streams."""
    return subprocess.run(
        ["sh", "-c", f'"$0" -m qs3 sensors {redirection}', sys.executable],
        env=os.environ | environment,
        capture_output=True,
    )


@pytest.mark.parametrize(
    "environment",
    [{"PYTHONIOENCODING": "ascii"}, {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}],
)
def test_output_is_readable_where_it_is_not_utf8(environment):
    done = run(**environment)
    assert done.returncode == 0
    assert b"d435" in done.stdout
    assert b"\\xd7" in done.stdout  # × of the pixels
    done.stdout.decode("ascii")


def test_closed_streams_are_no_fault_and_talk_goes_nowhere_else():
    done = run("2>&-")
    assert (done.returncode, done.stderr) == (0, b"")
    assert b"range:" not in done.stdout
    assert run("<&- >&- 2>&-").returncode == 0
    assert run("show nosuch 2>&-").returncode == 2


@pytest.mark.skipif(not os.path.exists("/dev/full"), reason="no /dev/full here")  # noqa: PTH110
def test_a_full_disk_names_the_file_and_what_to_do(typed, monkeypatch, tmp_path):
    done = run("> /dev/full")
    assert (done.returncode, done.stderr.count(b"\n")) == (2, 1)
    assert done.stderr.startswith(b"qs3: <stdout>: No space left on device; make room")

    def write(*_):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(tmp_path / "scan.json"))

    monkeypatch.setattr("qs3.sensor.presets.load_sensor", write)
    line = typed.refuses("sensors", "show", "d435")
    assert f"{tmp_path / 'scan.json'}: No space left on device; make room" in line


def test_control_characters_reach_no_terminal(typed, capfd, tmp_path):
    line = typed.refuses("scan", tmp_path / f"{HOSTILE}.off", "--out", tmp_path / "out")
    assert r"a\x1b[2J\x9b31m\r\n\u202eb.off" in line
    show(HOSTILE)
    logging.lastResort.handle(logging.makeLogRecord({"msg": HOSTILE, "levelno": 30}))
    warned = warnings.formatwarning(HOSTILE, UserWarning, "a.py", 1)
    rows = columns([(HOSTILE, "1"), ("b", "2")])
    printed = capfd.readouterr()
    assert "a\\x1b" in printed.err
    for text in (printed.out, printed.err, warned, *rows):
        assert not set(text.removesuffix("\n")) & set("\x1b\x9b\r\u202e")
    assert len(rows[0].splitlines()) == 1
    assert printable("σ é 椅子\ud800") == r"σ é 椅子\ud800"


@pytest.mark.parametrize(
    "words",
    [
        ("predict", "run", "a.npy", "--csv", ""),
        ("predict", "run", "a.npy", "--json="),
        ("predict", "run", ""),
        ("report", "run", "--out", ""),
        ("convert", "", "b", "--to", "ply"),
        ("train", "--source", "a", "--out", "b", "--warm-up", ""),
        ("meshes", "chair", "--labels", ""),
    ],
)
def test_an_empty_path_is_refused(typed, words):
    assert '"": an empty path; name a file' in typed.refuses(*words)


@pytest.mark.parametrize(
    ("option", "text"),
    [
        ("csv", "name,default\na.ply,1\n"),
        ("csv", "file,fault\na.ply,scratch\n"),
        ("csv", "file,class,fault\na.ply,rod,scratch\n"),
        ("csv", "\nfile,class\na.ply,rod\n"),
        ("csv", "scene_id,im_id,obj_id,score,R,t,time\n"),
        ("bop", "file,class\na.ply,rod\n"),
        ("bop", "scene_id,im_id,class\n1,2,rod\n"),
        ("bop", "file,class,confidence,fault\n"),
        ("json", "[1, 2]\n"),
        ("json", '[{"image_id": 4, "segmentation": []}]'),
        ("json", '[{"file": "a.ply", "class": "rod"}]'),
        ("json", '[{"file": "a.ply", "fault": ""}, {"file": "b.ply", "class": "rod"}]'),
        ("json", "[not JSON"),
        ("json", '\n{"format": 1}\n'),
    ],
)
def test_tables_of_others_are_never_replaced(tmp_path, option, text):
    file = tmp_path / ("a.json" if option == "json" else "a.csv")
    file.write_text(text)
    with pytest.raises(InputError, match=f"--{option} .*: is there already and holds no answers"):
        AnswerFiles({option: file}, [])


@pytest.mark.parametrize(
    ("option", "text"),
    [
        ("csv", "\ufefffile;class;confidence;fault\n"),
        ("csv", '\ufeff"file","class","cad","fault"\n'),
        ("json", "[]\n"),
    ],
)
def test_answers_that_a_spreadsheet_saved_or_that_are_none_are_ours(tmp_path, option, text):
    file = tmp_path / f"a.{option}"
    file.write_text(text, encoding="utf-8")
    AnswerFiles({option: file}, [])


@pytest.mark.parametrize(
    ("option", "name"), [("json", "a.csv"), ("csv", "A.JSON"), ("bop", "a.json")]
)
def test_a_table_is_not_called_as_one_of_another_kind(tmp_path, option, name):
    with pytest.raises(InputError, match=f"--{option} .*{name}: name a "):
        AnswerFiles({option: tmp_path / name}, [])


@pytest.mark.parametrize("option", ["csv", "json", "bop"])
def test_a_table_that_cannot_be_written_is_refused_at_once(tmp_path, option):
    (tmp_path / "file").touch()
    for place in (tmp_path, tmp_path / "file" / "a.csv"):
        with pytest.raises(InputError, match=f"--{option} "):
            AnswerFiles({option: place}, [])
    name = "a.json" if option == "json" else "a.csv"
    AnswerFiles({option: tmp_path / "new" / name}, [])
    AnswerFiles({option: tmp_path / "file"}, [])  # it is empty


def test_of_many_faults_that_a_table_has_few_are_printed(capfd, tmp_path):
    faults = [f"{i}.ply: is empty" for i in range(40)]
    with pytest.raises(InputError, match=r"39.ply: is empty \(40 of 50 scans\)"):
        raise_last(faults, 50, "scans", tmp_path / "answers.csv")
    lines = capfd.readouterr().err.splitlines()
    assert len(lines) == 6
    assert lines[-1].startswith("qs3: 34 more faults are in")
    with pytest.raises(InputError, match="40 of 50 scans"):
        raise_last(faults, 50, "scans")
    assert len(capfd.readouterr().err.splitlines()) == 39


def test_a_file_that_fails_does_not_take_the_printed_answers_with_it(capfd, tmp_path):
    tables = AnswerFiles({"csv": tmp_path / "a.csv", "json": Path("-")}, [])
    (tmp_path / "a.csv").mkdir()
    with pytest.raises((InputError, OSError)):
        tables.write(csv=lambda: "file\n", json=lambda: "[]\n")
    assert capfd.readouterr().out == "[]\n"


@contextlib.contextmanager
def unread(monkeypatch):
    """Print to a pipe whose reader went away, as of `qs3 … | head`."""
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as stream, monkeypatch.context() as patch:
        patch.setattr(sys, "stdout", stream)
        yield


def test_files_are_written_though_nobody_reads_the_output(monkeypatch, tmp_path):
    tables = AnswerFiles({"csv": tmp_path / "a.csv", "json": Path("-")}, [])
    with unread(monkeypatch):
        show("a row")
        tables.write(csv=lambda: "file\n", json=lambda: "[]\n")
    assert (tmp_path / "a.csv").read_text() == "file\n"


def test_output_that_nobody_reads_ends_with_the_code_of_a_closed_pipe(monkeypatch):
    with unread(monkeypatch), pytest.raises(SystemExit) as ended:
        main(["sensors"])
    assert ended.value.code == 141


def test_watch_ends_if_nobody_reads_its_output(monkeypatch, tmp_path):
    camera = Intrinsics(4.0, 4.0, 2.0, 2.0, 4, 4)

    def frames(*_):
        frame = DepthFrame(np.zeros((4, 4), np.float32), camera, "0", 0.0)
        yield watching.SeenParts(frame, None, 0.0, "no depth")
        raise AssertionError

    monkeypatch.setattr(watching, "library_of_run", lambda *_: True)
    monkeypatch.setattr(watching, "watch_parts", frames)
    with unread(monkeypatch):
        assert cli.run(["watch", str(tmp_path), "--camera", "folder:none", "--no-view"]) == 0


def test_words_that_begin_with_a_dash_are_no_options_in_printed_commands():
    path = Path("-cad ü")
    assert command("meshes", path, *options(out=path, seed=-1, name="-a b")) == (
        "qs3 meshes './-cad ü' '--out=-cad ü' --seed=-1 '--name=-a b'"
    )
    assert quoted(path) == "'./-cad ü'"


@pytest.mark.parametrize(("names", "short"), [
    (("bookshelf", "cabinet"), "bookshel  cabinet"),
    (("bracket_left", "bracket_right"), "bracket_l  bracket_r"),
])  # fmt: skip
def test_columns_of_a_confusion_matrix_tell_classes_apart(names, short):
    labels = np.array([0, 1])
    head = next(line for line in _scores(score(labels, labels, names), ()) if "predicted" in line)
    assert head.endswith(short)


def test_messages_stand_on_lines_of_their_own_beside_a_bar(capfd):
    prepare_streams()
    bar = progress_bar(9, "scans", "scan")
    notify("said")
    logging.lastResort.handle(logging.makeLogRecord({"msg": "logged", "levelno": 30}))
    bar.close()
    lines = re.split("[\r\n]", capfd.readouterr().err)
    assert {"said", "logged"} < {*lines}
