"""Options of ``qs3 train`` that end a run, share it out or write more of it."""

import json

import pytest

QUICK = ("--model", "pointnet", "--num-points", 64, "--batch-size", 5, "--threads", 1,
         "--accelerator", "cpu")  # fmt: skip


def test_max_time_stops_with_its_own_code_and_goes_on(qs3, store, tmp_path):
    command = ("train", "--source", store, "--out", tmp_path / "run", "--epochs", 2, *QUICK,
               "--max-time")  # fmt: skip
    assert "such as 00:30:00" in qs3.refuses(*command, "10")
    assert not (tmp_path / "run").exists()
    # PyTorch alone takes longer to load than a second; one epoch is always made.
    stopped = qs3(*command[:-1], "--max-time", "00:00:01", "--epochs", 400, code=3)
    assert stopped.stdout == ""
    assert "run the same again to go on" in stopped.stderr
    done = len((tmp_path / "run" / "history.jsonl").read_text().splitlines())
    assert 1 <= done < 400


@pytest.mark.slow
def test_two_devices_write_and_say_everything_once(qs3, store, tmp_path):
    done = qs3("train", "--source", store, "--out", tmp_path / "run", "--epochs", 3, *QUICK,
               "--devices", 2)  # fmt: skip
    assert done.stdout == f"{tmp_path / 'run'}\n"
    assert done.stderr.count("Next:") == 1
    lines = (tmp_path / "run" / "history.jsonl").read_text().splitlines()
    assert [json.loads(line)["epoch"] for line in lines] == [0, 1, 2]
    names = {path.name.split("-")[0] for path in (tmp_path / "run").iterdir()}
    assert names == {"checkpoint.safetensors", "checkpoints", "history.jsonl", "model.safetensors",
                     "run.json", "settings.json", "subsample"}  # fmt: skip
    qs3("evaluate", tmp_path / "run", "--data", store)
