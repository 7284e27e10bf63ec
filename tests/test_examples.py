"""The furniture of ``examples/rooms.py``: three networks are scored."""

from pathlib import Path

from qs3.meshes import POINTDA10

from .scripts import load_script
from .stores import write_store

ROUNDS = {"threshold_share": 1.0, "rounds": 1, "epochs": 1, "source_loss": True}


def write_source(folder, *_, **__):
    if not folder.exists():
        write_store(folder, POINTDA10, [(row % 10, "train", 64) for row in range(20)])


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
