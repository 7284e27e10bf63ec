"""The furniture of ``examples/rooms.py``: three networks are scored, without a label of theirs."""

from pathlib import Path

import numpy as np
import pytest
import torch

from qs3.io import load_unlabelled
from qs3.meshes import POINTDA10
from qs3.training import fit, load_model
from qs3.training.config import PRESETS, changed
from qs3.training.run import train_settings
from qs3.training.shipped import find_run

from .scripts import load_script
from .stores import write_store

ROUNDS = {"threshold_share": 1.0, "rounds": 1, "epochs": 1, "source_loss": True}


def write_source(folder, *_, **__):
    if not folder.exists():
        write_store(folder, POINTDA10, [(row % 10, "train", 64) for row in range(40)])


def test_three_networks_are_scored_and_a_page_is_written(tmp_path, monkeypatch, capsys):
    rooms = load_script(Path(__file__).parents[1] / "examples" / "rooms.py")
    monkeypatch.setattr(rooms, "SURFACES", 1)
    monkeypatch.setattr(rooms, "EPOCHS", 1)
    monkeypatch.setattr(rooms, "ROUNDS", ROUNDS)
    monkeypatch.setattr(rooms, "scan", write_source)
    rooms.main(tmp_path)
    *lines, page = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines] == ["surfaces only", "rooms", "QBST"]
    assert "Rounds of self-training" in Path(page).read_text(encoding="utf-8")


@pytest.mark.filterwarnings("ignore::qs3.adaptation.selection.SingleClassWarning")
def test_poisoned_labels_do_not_reach_the_adapted_network(tmp_path):
    rng = np.random.default_rng(1)
    points = rng.normal(size=(40, 64, 3)) * rng.uniform(0.2, 2, size=(40, 1, 3))
    before, states = load_model(Path("rooms")), []
    how = train_settings(find_run("rooms"))
    rounds = changed(PRESETS["gentle"], ROUNDS | {"source_loss": False}, "")
    for case, shift in {"true": 0, "wrong": 1}.items():
        path = tmp_path / f"{case}.npz"
        labels = (np.arange(40) + shift) % 10
        np.savez(path, points=points, label=labels, class_names=np.array(POINTDA10))
        fit("qbst", None, load_unlabelled(path), how, rounds, run_dir=tmp_path / case,
            warm_up=Path("rooms"))  # fmt: skip
        states.append(load_model(tmp_path / case).model.state_dict())
    first, second = states
    assert all(torch.equal(first[name], second[name]) for name in first)
    own = before.model.state_dict()
    assert not all(torch.equal(first[name], own[name]) for name in first)
