import importlib.metadata
import os
import subprocess

import numpy as np

from qs3.evaluation import environment


def test_versions_and_hardware_are_those_of_this_machine():
    assert environment.versions()["numpy"] == np.__version__
    assert environment.versions()["qs3"] == importlib.metadata.version("qs3")
    hardware = environment.hardware()
    assert 1 <= hardware["cores"] <= (os.cpu_count() or 1)
    assert hardware["cpu"]
    assert all(isinstance(name, str) for name in hardware["gpus"])


def test_a_package_outside_its_repository_has_no_commit(monkeypatch, tmp_path):
    (tmp_path / "lib").mkdir()
    monkeypatch.setattr(environment, "__file__", str(tmp_path / "lib" / "environment.py"))
    assert environment.git_commit() == ""
    subprocess.run(["git", "init", "-q", str(tmp_path)], check=True)  # a foreign one
    assert environment.git_commit() == ""


def test_a_commit_is_returned_and_a_change_marks_it(monkeypatch, tmp_path):
    place = tmp_path / "src" / "qs3" / "evaluation"
    place.mkdir(parents=True)
    (place / "environment.py").write_text("")
    git = ["git", "-C", str(tmp_path), "-c", "user.name=a", "-c", "user.email=a@b.c"]
    for command in (["init", "-q"], ["add", "src"], ["commit", "-q", "-m", "x"]):
        subprocess.run([*git, *command], check=True)
    monkeypatch.setattr(environment, "__file__", str(place / "environment.py"))
    commit = environment.git_commit()
    assert len(commit) == 40
    (place / "environment.py").write_text("changed")
    assert environment.git_commit() == f"{commit}-dirty"
